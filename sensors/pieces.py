"""A drive as pieces: Logs over windows of time that follow each other, so that memory does not follow its length.

In all pieces of a drive vehicle and map frame are the same, and every sensor's stamps go on increasing from piece to
piece. A piece that holds IMU samples up to a time holds every other row with a stamp up to it as well, unless that row
came late. A sensor without rows in a piece is None there; left_out counts what was left out since the piece before.
Tags hold across the ends of pieces.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from typing import Any

import numpy as np

from sensors.clock import NS_PER_S
from sensors.records import LeftOut, Log

PIECE_S = 300.0
"""Usual length of a piece, s."""
SENSORS = ("imu", "gnss", "gnss_velocity", "pose_fixes", "wheel", "reference", "scene", "mode")
"""The records of a Log."""


def cut(log: Log, length_s: float = PIECE_S) -> Iterator[Log]:
    """A whole log in pieces; what was left out of it stands in the first."""
    records = {name: record for name in SENSORS if (record := getattr(log, name)) is not None and len(record)}
    if not records:
        yield log
        return
    first = min(int(record.t_ns[0]) for record in records.values())
    last = max(int(record.t_ns[-1]) for record in records.values())
    step = round(length_s * NS_PER_S)
    for begin in range(first, last + 1, step):
        parts = {name: _between(record, begin, begin + step) for name, record in records.items()}
        here: dict[str, Any] = {name: part if len(part) else None for name, part in parts.items()}
        yield replace(log, **here, left_out=log.left_out if begin == first else ())


def join(pieces: Iterable[Log]) -> Log:
    """The whole drive."""
    given = list(pieces)
    if len(given) == 1:
        return given[0]
    parts = {name: [r for piece in given if (r := getattr(piece, name)) is not None] for name in SENSORS}
    whole: dict[str, Any] = {name: joined(records) if records else None for name, records in parts.items()}
    left_out = summed(entry for piece in given for entry in piece.left_out)
    return replace(given[0], **whole, left_out=left_out) if given else Log()


def summed(left_out: Iterable[LeftOut]) -> tuple[LeftOut, ...]:
    """One entry for each source and reason."""
    counts: Counter[tuple[str, str]] = Counter()
    for entry in left_out:
        counts[entry.source, entry.reason] += entry.count
    return tuple(LeftOut(source, reason, count) for (source, reason), count in counts.items())


def _between(record: Any, begin: int, end: int) -> Any:
    first, last = np.searchsorted(record.t_ns, (begin, end))
    return record[first:last]


def joined(records: list[Any]) -> Any:
    """Records of one kind that follow each other as one."""
    if len(records) == 1:
        return records[0]
    columns = {f.name: np.concatenate([getattr(r, f.name) for r in records]) for f in fields(records[0])}
    return type(records[0])(**columns)
