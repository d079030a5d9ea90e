"""Comma-separated text with named columns (plain or .gz) as float arrays; a bad cell is named by line and column."""

import csv
import gzip
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError

Floats = NDArray[np.float64]


def read_columns(path: Path, wanted: Sequence[str] = ()) -> dict[str, Floats]:
    """Every column of a CSV with a header line, by name; empty cells become NaN.

    wanted: names that must be there. Raises EgolocError naming the file and the column or line.
    """
    header, rows = read_table(path)
    missing = [name for name in wanted if name not in header]
    if missing:
        raise EgolocError(f"{path}: column {missing[0]}: not there, the header has {', '.join(header)}")
    values = numbers(path, header, rows)
    return {name: values[:, i] for i, name in enumerate(header)}


def read_table(path: Path, delimiter: str = ",") -> tuple[list[str], list[list[str]]]:
    """Header and rows of cells."""
    rows = list(csv.reader(read_text(path).splitlines(), delimiter=delimiter))
    rows = [[cell.strip() for cell in row] for row in rows if row]
    if len(rows) < 2:
        raise EgolocError(f"{path}: expected a header line and rows, got {len(rows)} lines")
    return rows[0], rows[1:]


def read_text(path: Path) -> str:
    """Text of a plain or gzipped file."""
    try:
        if path.suffix == ".gz":
            with gzip.open(path, "rt", encoding="utf-8") as file:
                return file.read()
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise EgolocError(f"{path}: no such file") from error
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise EgolocError(f"{path}: expected a text file: {error}") from error


def numbers(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> Floats:
    """(N, C) floats of the cells; rows shorter or longer than the header or not numeric are an error."""
    try:
        return np.array([[float(cell) if cell else np.nan for cell in row] for row in rows]).reshape(-1, len(header))
    except ValueError:
        _blame(path, header, rows)
        raise


def _blame(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Raise the EgolocError that names the first bad cell."""
    for number, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise EgolocError(f"{path}: line {number}: expected {len(header)} columns, got {len(row)}")
        for name, cell in zip(header, row, strict=True):
            try:
                float(cell or "nan")
            except ValueError as error:
                raise EgolocError(f"{path}: line {number}: column {name}: expected a number, got {cell!r}") from error
