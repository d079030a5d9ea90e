"""Shared fixtures, and a cache of compiled kernels that is safe while kernels change."""

import hashlib
import os
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("sensors", "egovm", "fusion", "replay")


def kernel_sources() -> list[Path]:
    """Files with numba kernels and the project's files that they import functions and constants from."""
    python = [path for name in PACKAGES for path in (ROOT / name).rglob("*.py")]
    found = {path for path in python if re.search(r"^@(njit|kernel)\b", path.read_text(), re.MULTILINE)}
    for path in list(found):
        for module in re.findall(rf"^from ((?:{'|'.join(PACKAGES)})\S*) import", path.read_text(), re.MULTILINE):
            plain = ROOT / (module.replace(".", "/") + ".py")
            found.add(plain if plain.is_file() else ROOT / module.replace(".", "/") / "__init__.py")
    return sorted(found)


def kernel_cache() -> Path:
    """Where kernels of just these sources are cached.

    numba looks only at the file that holds a kernel: one that inlines a function of another file would stay as it was.
    """
    digest = hashlib.sha256()
    for path in kernel_sources():
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return ROOT / ".numba_cache" / digest.hexdigest()[:16]


os.environ["NUMBA_CACHE_DIR"] = str(kernel_cache())  # here: numba reads it when it is first imported


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real logs; the test is skipped, with the reason shown, where it is absent."""
    folder = Path(os.environ.get("EGOLOC_DATA", ROOT / "../shared/data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: set EGOLOC_DATA")
    return folder
