"""states.parquet, decisions.parquet and smoothed.parquet, written as their rows come and read back piece by piece.

Row groups hold ROWS rows whatever the batches: the bytes depend on the rows alone. Columns that are codes in memory are
dictionary strings there. `log` is the same in all rows, so that the tables of many logs are one dataset.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from replay.arrow import text_codes
from replay.decisions import no_rows
from replay.evaluation import Batch
from replay.run_files import CODES, TEXTS, read_groups
from replay.scoring import DECISIONS, STATES
from replay.store import Keep
from sensors.clock import NS_PER_S
from sensors.datasets.run_trajectory import RUN_KEY
from sensors.geodesy import MapFrame

if TYPE_CHECKING:
    import pyarrow

Columns = dict[str, NDArray[Any]]
Texts = Mapping[str, Sequence[str]]

ROWS = 32_768
"""Of a row group: 55 minutes of states."""
SMOOTHED = "smoothed.parquet"
NAMES = {name: tuple(member.name.lower() for member in codes) for name, codes in CODES.items()}
OPTIONS = {"compression": "lz4", "write_statistics": False, "write_page_checksum": True}


class Tables:
    """The tables in a run folder, as far as they are kept. To be used as a context."""

    def __init__(self, folder: Path, log: str, keep: Keep) -> None:
        self._folder, self._log, self._keep = folder, log, keep
        self._smoothed: Table | None = None
        self._states, self._decisions = (Table(folder / f"{name}.parquet", log) for name in ("states", "decisions"))

    @property
    def holds_decisions(self) -> bool:
        """Whether any decision is written: else their columns may be those of scoring alone."""
        return self._keep.decisions != "none"

    def add(self, batch: Batch) -> None:
        """Write the rows that are kept of a batch."""
        texts = {"scene": batch.scenes, "mode": batch.modes}
        self._states.add(_chosen(batch.states, kept_states(batch.states["t_ns"], self._keep)), texts)
        decisions = batch.decisions
        if not self.holds_decisions:
            decisions = no_rows() | {name: decisions[name][:0] for name in TEXTS}
        self._decisions.add(_chosen(decisions, kept_decisions(decisions["accepted"], self._keep)), texts)

    def add_smoothed(self, states: Columns, batch: Batch, frame: MapFrame | None) -> None:
        """Write the rows that are kept of smoothed states. batch: the drive's last; frame: of their coordinates."""
        if self._smoothed is None:
            said = {} if frame is None else {RUN_KEY: msgspec.json.encode({"map_frame": frame})}
            self._smoothed = Table(self._folder / SMOOTHED, self._log, said)
        texts = {"scene": batch.scenes, "mode": batch.modes}
        self._smoothed.add(_chosen(states, kept_states(states["t_ns"], self._keep)), texts)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        for table in filter(None, (self._states, self._decisions, self._smoothed)):
            if kind is None:
                table.close()
            else:
                with suppress(OSError):
                    table.abandon()


def kept_states(t_ns: NDArray[np.int64], keep: Keep) -> NDArray[np.bool_] | None:
    """(N,) which states are kept; None: all."""
    if keep.states_hz is None:
        return None
    if keep.states_hz == 0:
        return np.zeros(len(t_ns), np.bool_)
    kept: NDArray[np.bool_] = t_ns % round(NS_PER_S / keep.states_hz) == 0
    return kept


def kept_decisions(accepted: NDArray[np.bool_], keep: Keep) -> NDArray[np.bool_] | None:
    """(M,) which of the decisions are kept; None: all."""
    return ~accepted if keep.decisions == "rejected" else None


class Table:
    """One Parquet file that grows by row groups."""

    def __init__(self, path: Path, log: str, said: Mapping[bytes, bytes] | None = None) -> None:
        """said: of the whole, for the file's metadata."""
        self._path, self._log, self._said = path, log, said
        self._writer: Any = None
        self._waiting: list[Columns] = []
        self._rows = 0
        self._texts: Texts = {}
        self._codes = dict.fromkeys(TEXTS, 0)

    def add(self, columns: Columns, texts: Texts) -> None:
        """Take the next rows; texts: what the codes of scene and mode mean, those before unchanged."""
        self._texts = texts
        self._waiting.append(columns)
        self._rows += len(columns["t_ns"])
        if self._rows >= ROWS:
            self._write(self._rows - self._rows % ROWS)

    def close(self) -> None:
        """Write what waits, and the end of the file."""
        if self._rows or self._writer is None:
            self._write(self._rows)
        self._writer.close()

    def abandon(self) -> None:
        """Let go of a file that is not to be finished."""
        if self._writer is not None:
            self._writer.close()

    def _write(self, count: int) -> None:
        """Write the first count rows of those that wait."""
        whole = {name: np.concatenate([part[name] for part in self._waiting]) for name in self._waiting[0]}
        for first in range(0, max(count, 1), ROWS):
            self._write_group({name: column[first : min(first + ROWS, count)] for name, column in whole.items()})
        self._waiting = [{name: column[count:].copy() for name, column in whole.items()}]
        self._rows -= count

    def _write_group(self, columns: Columns) -> None:
        import pyarrow.parquet as pq

        for name in self._codes:  # only texts that have occurred: what is still to come must not show
            self._codes[name] = max(self._codes[name], int(columns[name].max(initial=0)))
        seen = {name: self._texts[name][: code + 1] for name, code in self._codes.items()}
        table = _arrow_table(columns, seen, self._log).replace_schema_metadata(self._said)
        if self._writer is None:
            coded = [field.name for field in table.schema if str(field.type).startswith("dictionary")]
            self._writer = pq.ParquetWriter(self._path, table.schema, use_dictionary=coded, **OPTIONS)
        self._writer.write_table(table, row_group_size=ROWS)


def stored_batches(folder: Path) -> Iterator[Batch]:
    """The rows of both tables again, with the columns that scoring reads, by row groups in the order of time."""
    texts: dict[str, list[str]] = {name: [""] for name in TEXTS}
    states, decisions = (
        _Reader(folder / f"{name}.parquet", columns, texts)
        for name, columns in (("states", STATES), ("decisions", DECISIONS))
    )
    while states.rows is not None or decisions.rows is not None:
        ahead = decisions.first_ns < states.first_ns
        yield Batch(
            states.empty if ahead else states.take(),
            decisions.take() if ahead else decisions.empty,
            tuple(texts["scene"]),
            tuple(texts["mode"]),
        )


def stored_smoothed(folder: Path) -> Iterator[Columns]:
    """The rows of the smoothed states again, with the columns that scoring reads, by row groups."""
    texts: dict[str, list[str]] = {name: [""] for name in TEXTS}
    rows = _Reader(folder / SMOOTHED, STATES, texts)
    while rows.rows is not None:
        yield rows.take()


class _Reader:
    """The row groups of a table. rows: the next one, None at the end; empty: one without rows."""

    def __init__(self, path: Path, columns: Sequence[str], texts: dict[str, list[str]]) -> None:
        self._groups, self._texts = read_groups(path, columns), texts
        self.rows: Columns | None = self._next()
        assert self.rows is not None
        self.empty = {name: column[:0] for name, column in self.rows.items()}

    @property
    def first_ns(self) -> float:
        """First stamp of the next row group; infinite at the end."""
        if self.rows is None:
            return np.inf
        return int(self.rows["t_ns"][0]) if len(self.rows["t_ns"]) else -np.inf

    def take(self) -> Columns:
        """The next row group."""
        assert self.rows is not None
        taken, self.rows = self.rows, self._next()
        return taken

    def _next(self) -> Columns | None:
        table = next(self._groups, None)
        return None if table is None else {name: self._array(name, table[name]) for name in table.column_names}

    def _array(self, name: str, column: "pyarrow.ChunkedArray") -> NDArray[Any]:
        if name not in NAMES and name not in self._texts:
            found: NDArray[Any] = column.to_numpy()
            return found
        codes, names = text_codes(column)
        known = NAMES[name] if name in NAMES else self._texts[name]
        if name in self._texts:
            self._texts[name] += [text for text in names if text not in known]
        return np.array([known.index(text) for text in names], np.int16)[codes]


def _arrow_table(columns: Columns, texts: Texts, log: str) -> "pyarrow.Table":
    import pyarrow as pa

    arrays = {}
    for name, column in columns.items():
        if name in NAMES or name in texts:
            names = pa.array(NAMES[name] if name in NAMES else texts[name], pa.string())
            arrays[name] = pa.DictionaryArray.from_arrays(pa.array(column), names)
        elif column.ndim == 2:
            flat = pa.array(np.ascontiguousarray(column).ravel())
            arrays[name] = pa.FixedSizeListArray.from_arrays(flat, column.shape[1])
        else:
            arrays[name] = pa.array(np.ascontiguousarray(column))
    count = len(columns["t_ns"])
    arrays["log"] = pa.DictionaryArray.from_arrays(pa.array(np.zeros(count, np.int8)), pa.array([log]))
    return pa.table(arrays)


def _chosen(columns: Columns, rows: NDArray[np.bool_] | None) -> Columns:
    return columns if rows is None else {name: column[rows] for name, column in columns.items()}
