"""Feather files: tables of columns, read whole, with what is missing or of the wrong kind told by name."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import feather

from sensors.errors import EgolocError

Floats = NDArray[np.float64]


def table(path: Path, wanted: Sequence[str]) -> pa.Table:
    """A feather file's wanted columns."""
    try:
        table = feather.read_table(path, memory_map=False)
    except (OSError, pa.ArrowException) as error:
        raise EgolocError(f"{path}: expected a feather file: {str(error).splitlines()[0]}") from None
    if missing := [name for name in wanted if name not in table.column_names]:
        raise EgolocError(f"{path}: column {missing[0]}: not there, the file has {', '.join(table.column_names)}")
    return table


def column(path: Path, table: pa.Table, name: str) -> NDArray[np.generic]:
    """A column of numbers, (N,)."""
    values: NDArray[np.generic] = table[name].to_numpy()
    if values.dtype.kind not in "fiu" or table[name].null_count:
        raise EgolocError(f"{path}: column {name}: expected numbers, got {table.schema.field(name).type}")
    return values


def columns(path: Path, table: pa.Table, names: Sequence[str]) -> Floats:
    """(N, len(names)) float64."""
    return np.stack([column(path, table, name).astype(np.float64) for name in names], axis=1)


def stamps(path: Path, table: pa.Table) -> NDArray[np.int64]:
    values = column(path, table, "timestamp_ns")
    if values.dtype.kind not in "iu":
        raise EgolocError(f"{path}: column timestamp_ns: expected integers, got {values.dtype}")
    return values.astype(np.int64)
