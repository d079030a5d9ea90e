"""Fixtures: a log with every record, and foreign files to read."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from sensors.records import Log
from tests.sensors.mcap.messages import Sent, full_log, mcap_bytes


@pytest.fixture
def log() -> Log:
    return full_log()


@pytest.fixture
def save(tmp_path: Path) -> Callable[..., Path]:
    """Writes messages to a file (options: see mcap_bytes) and gives its path."""

    def write(messages: Iterable[Sent], **options: Any) -> Path:
        path = tmp_path / "foreign.mcap"
        path.write_bytes(mcap_bytes(messages, **options))
        return path

    return write
