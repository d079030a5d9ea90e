"""Shared fixtures: where the real data lies."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real logs; the test is skipped, with the reason shown, where it is absent."""
    folder = Path(os.environ.get("EGOLOC_DATA", ROOT / "../shared/data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: set EGOLOC_DATA")
    return folder
