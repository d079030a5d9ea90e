"""Drives in memory as sources of a replay, cut anywhere; and the rows that come of them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from replay.config import RunConfig
from replay.drive import Drive
from replay.evaluation import Batch
from sensors.pieces import PIECE_S, SENSORS, cut
from sensors.records import Log

Columns = dict[str, Any]


@dataclass(frozen=True)
class Memory:
    """A log as a source."""

    log: Log
    name: str = "drive"
    length_s: float = PIECE_S
    length_km: float | None = None

    @property
    def where(self) -> str:
        return self.name

    def pieces(self, config: RunConfig) -> Iterator[Log]:
        return cut(self.log, self.length_s)

    def facts(self) -> dict[str, Any]:
        return {"path": self.name}


def cut_at(log: Log, edges: Sequence[int]) -> Iterator[Log]:
    """The pieces of a log between edges (increasing ns); what was left out of it stands in the first."""
    for begin, end in zip((-(2**62), *edges), (*edges, 2**62), strict=True):
        parts: Columns = {}
        for name in SENSORS:
            record = getattr(log, name)
            if record is not None:
                rows = record[slice(*np.searchsorted(record.t_ns, (begin, end)))]
                parts[name] = rows if len(rows) else None
        yield replace(log, **parts, left_out=log.left_out if begin == -(2**62) else ())


def random_edges(log: Log, count: int, rng: np.random.Generator) -> list[int]:
    """Where to cut: anywhere within the IMU's time, some of it a sample apart."""
    assert log.imu is not None
    first, last = int(log.imu.t_ns[0]), int(log.imu.t_ns[-1])
    edges = rng.integers(first, last, count)
    return sorted({*edges.tolist(), *(edges[: count // 4] + 10_000_000).tolist()})


def rows_of(pieces: Iterable[Log], config: RunConfig, **given: Any) -> tuple[Columns, Columns, Drive]:
    """All rows of both tables, and the drive at its end."""
    drive: Drive | None = None
    batches = []
    for piece in pieces:
        drive = drive or Drive(piece, config, "drive", **given)
        batches.append(drive.push(piece))
    assert drive is not None
    batches.append(drive.finish())
    return *joined(batches), drive


def joined(batches: Sequence[Batch]) -> tuple[Columns, Columns]:
    """The rows of batches, scene and mode as texts."""
    tables = []
    for table in ("states", "decisions"):
        columns = [getattr(batch, table) for batch in batches]
        whole = {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}
        for name, texts in (("scene", batches[-1].scenes), ("mode", batches[-1].modes)):
            whole[name] = np.array(texts)[whole[name]]
        tables.append(whole)
    return tables[0], tables[1]


def equal(found: Columns, wanted: Columns) -> list[str]:
    """Columns that differ in any bit."""
    assert list(found) == list(wanted)
    return [name for name in wanted if not _same(found[name], wanted[name])]


def _same(a: Any, b: Any) -> bool:
    return bool(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes())
