"""What a log must hold to be replayed: an IMU, and positions while it runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.records import LeftOut, Log

NO_POSITIONS = "expected GNSS fixes or pose fixes, found neither: nothing tells where the vehicle is"
SHOWN = 3
"""Reasons why rows were left out that an error repeats."""


@dataclass(slots=True)
class _Seen:
    """Rows of a record so far: first and last stamp, and the first since the IMU began."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    first_with_imu_ns: int | None = None

    def add(self, record: Any, imu_ns: int | None) -> None:
        t_ns = record.t_ns
        if not len(t_ns):
            return
        self.first_ns = self.first_ns if self.count else int(t_ns[0])
        self.count, self.last_ns = self.count + len(t_ns), int(t_ns[-1])
        if self.first_with_imu_ns is None and imu_ns is not None and self.last_ns >= imu_ns:
            self.first_with_imu_ns = int(t_ns[np.searchsorted(t_ns, imu_ns)])


class Contents:
    """What the pieces of a drive hold."""

    def __init__(self) -> None:
        self._imu = _Seen()
        self._positions = {"GNSS fixes": _Seen(), "pose fixes": _Seen()}

    def add(self, piece: Log) -> None:
        """The next piece."""
        if piece.imu is not None:
            self._imu.add(piece.imu, None)
        began_ns = self._imu.first_ns if self._imu.count else None
        for seen, record in zip(self._positions.values(), (piece.gnss, piece.pose_fixes), strict=True):
            if record is not None:
                seen.add(record, began_ns)

    def missing(self) -> str | None:
        """Why a drive of these pieces cannot be replayed; None where it can."""
        if self._imu.count < 2:
            return f"expected IMU samples (sensor_msgs/msg/Imu), found {self._imu.count or 'none'}"
        found = {name: seen for name, seen in self._positions.items() if seen.count}
        if not found:
            return NO_POSITIONS
        first_ns, last_ns = self._imu.first_ns, self._imu.last_ns
        if any(s.first_with_imu_ns is not None and s.first_with_imu_ns <= last_ns for s in found.values()):
            return None
        where = " and ".join(f"{name} {_span(seen.first_ns, seen.last_ns)}" for name, seen in found.items())
        return f"expected positions while the IMU runs ({_span(first_ns, last_ns)}), found {where}"


def what_is_missing(log: Log) -> str | None:
    """Why a whole log cannot be replayed; None where it can."""
    contents = Contents()
    contents.add(log)
    return contents.missing()


def check_replayable(contents: Contents, left_out: Sequence[LeftOut]) -> None:
    """Raise EgolocError where nothing can be fused; left_out: of the drive, for the message."""
    missing = contents.missing()
    if missing is not None:
        raise EgolocError(f"{missing}{_left_out(left_out)}")


def _span(first_ns: int, last_ns: int) -> str:
    start, end = (datetime.fromtimestamp(t / NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M:%S") for t in (first_ns, last_ns))
    return f"from {start} to {end}"


def _left_out(left_out: Sequence[LeftOut]) -> str:
    """The commonest reasons why rows were left out, as the end of an error."""
    entries = sorted(left_out, key=lambda entry: -entry.count)
    texts = [f"{f'{row.count} of ' if row.count else ''}{row.source}: {row.reason}" for row in entries[:SHOWN]]
    more = f"; and {len(entries) - SHOWN} more" if len(entries) > SHOWN else ""
    return f"; left out: {'; '.join(texts)}{more}" if texts else ""
