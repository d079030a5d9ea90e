"""JSON of maps into typed records: one line that names file and field where it is something else."""

from pathlib import Path
from typing import TypeVar

import msgspec

from sensors.errors import EgolocError

MAX_BYTES = 1 << 28
"""Some thousand kilometres of road; in memory it takes about ten times as much."""

BOM = b"\xef\xbb\xbf"
"""Which some programs write before UTF-8."""

T = TypeVar("T")


def read_json(path: Path, kind: type[T], max_bytes: int = MAX_BYTES) -> T:
    """The record in a file.

    Raises EgolocError where the file cannot be opened, is larger than max_bytes, is no JSON (NaN and Infinity are
    none), or a field is missing or of another type (with its path, ``$.features[3].geometry``).
    """
    try:
        with path.open("rb") as handle:
            text = handle.read(max_bytes + 1)  # a size that the system tells is not that of every file
        if len(text) > max_bytes:
            size = max(path.stat().st_size, len(text)) / (1 << 20)
            raise EgolocError(f"{path}: expected at most {max_bytes >> 20} MB of JSON, got {size:.0f} MB or more")
        return msgspec.json.decode(text.removeprefix(BOM), type=kind)
    except OSError as error:
        raise EgolocError(f"{path}: cannot be read: {error.strerror}") from error
    except msgspec.ValidationError as error:
        raise EgolocError(f"{path}: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise EgolocError(f"{path}: expected JSON: {error}") from error
