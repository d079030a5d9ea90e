"""Points of the text forms of PLY and PCD: lines of numbers between spaces."""

import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from sensors.clouds.cloud import Floats
from sensors.errors import EgolocError


def columns_of_text(path: Path, text: memoryview, rows: int, columns: Sequence[int]) -> Floats:
    """(rows, len(columns)) float64 of the first so many lines; EgolocError where there are fewer, or no numbers."""
    if not rows:
        return np.zeros((0, len(columns)))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of empty lines, which count for nothing
            found = np.loadtxt(BytesIO(text), np.float64, comments=None, usecols=columns, max_rows=rows, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        reason = str(error).splitlines()[0]
        raise EgolocError(f"{path}: expected lines of numbers behind the header: {reason}") from None
    if len(found) != rows:
        raise EgolocError(f"{path}: the header says {rows} points, the file has {len(found)}")
    return np.asarray(found, np.float64)
