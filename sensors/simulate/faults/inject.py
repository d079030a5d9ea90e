"""Puts faults into a drive that comes piece by piece; the same bits come out however it is cut.

What a fault leaves of a sensor's rows is judged by the rules for a log's messages (``sensors.mcap``): rows without
numbers, with a covariance that is none or with a stamp that goes back are left out and counted; one that is at most
LATE_NS late by its stamp is put in order. The reference and tags are never touched.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.pieces import SENSORS, joined
from sensors.records import LeftOut, Log
from sensors.simulate.faults.door import Door
from sensors.simulate.faults.fault import During, Rows
from sensors.simulate.faults.spec import Injection
from sensors.simulate.noise import stream


class Injector:
    """Faults for one drive, in the order in which they are given. What is random in them is drawn by the seed."""

    def __init__(self, injections: Sequence[Injection], seed: int = 0, where: str = "--inject") -> None:
        """where: how messages begin."""
        self.injections, self._where = tuple(injections), where
        self.met: list[Counter[str]] = [Counter() for _ in injections]
        """How many rows of each record each fault met."""
        self._back_ns = sum(round(one.fault.size(one.severity) * NS_PER_S) for one in injections if one.fault.back)
        names = {name: None for one in injections for name in one.fault.acts}
        self._doors = {name: Door(name) for name in names}
        self._troubles = {
            name: [_Trouble(k, one, name, seed) for k, one in enumerate(injections) if name in one.fault.acts]
            for name in names
        }
        self._untouched: dict[str, Any] = {}
        self._kinds: dict[str, type[Any]] = {}
        self._told: Counter[tuple[str, str]] = Counter()
        self._origin_ns: int | None = None

    def pieces(self, drive: Iterable[Log]) -> Iterator[Log]:
        """The drive with its faults. Without faults: the pieces as they are.

        Raises EgolocError at its end where a fault met no row at all.
        """
        if not self.injections:
            yield from drive
            return
        piece = Log()
        for piece in drive:
            self._take(piece)
            yield self._given(piece, _complete_ns(piece) - self._back_ns)
        yield self._given(replace(piece, left_out=()), None)
        self._check()

    def _take(self, piece: Log) -> None:
        if self._origin_ns is None and piece.imu is not None and len(piece.imu):
            self._origin_ns = int(piece.imu.t_ns[0])
        for name in SENSORS:
            record = getattr(piece, name)
            if record is None or not len(record):
                continue
            if name in self._doors:
                self._kinds[name] = type(record)
                self._doors[name].admit(self._faulty(name, record))
            else:
                held = self._untouched.get(name)
                self._untouched[name] = record if held is None else joined([held, record])

    def _faulty(self, name: str, record: Any) -> Rows:
        """The rows of a record after its faults."""
        rows = Rows(record.t_ns, {f.name: getattr(record, f.name) for f in fields(record)})
        if self._origin_ns is not None:
            for trouble in self._troubles[name]:
                rows, met = trouble.act(rows, self._origin_ns)
                self.met[trouble.index][name] += met
        return rows

    def _given(self, piece: Log, until_ns: int | None) -> Log:
        """What waits with stamps up to a time (None: all), in place of the piece's rows."""
        out: dict[str, Any] = dict.fromkeys(SENSORS)
        for name, kind in self._kinds.items():
            out[name] = self._doors[name].take(until_ns, kind)
        for name, record in list(self._untouched.items()):
            count = len(record) if until_ns is None else int(np.searchsorted(record.t_ns, until_ns, side="right"))
            out[name] = record[:count] if count else None
            if count < len(record):
                self._untouched[name] = record[count:]
            else:
                del self._untouched[name]
        return replace(piece, **out, left_out=(*piece.left_out, *self._left_out()))

    def _left_out(self) -> Iterator[LeftOut]:
        """What the doors left out since it was told last."""
        now = {(name, reason): n for name, door in self._doors.items() for reason, n in door.left_out.items()}
        for (name, reason), count in now.items():
            if count > self._told[name, reason]:
                yield LeftOut(name, reason, count - self._told[name, reason])
                self._told[name, reason] = count

    def _check(self) -> None:
        for one, met in zip(self.injections, self.met, strict=True):
            if not met.total():
                wanted = " or ".join(name.replace("_", " ") for name in one.fault.acts)
                raise EgolocError(f"{self._where}: {one.spec}: expected {wanted} in that time of the drive, found none")


def _complete_ns(piece: Log) -> int:
    """Up to which stamp nothing follows: that of the last IMU sample, where there is none of any sensor."""
    records = [r for name in SENSORS if (r := getattr(piece, name)) is not None and len(r)]
    clock = [piece.imu] if piece.imu is not None and len(piece.imu) else records
    return max((int(record.t_ns[-1]) for record in clock), default=-(2**62))


class _Trouble:
    """A fault on its way through one record."""

    def __init__(self, index: int, injection: Injection, name: str, seed: int) -> None:
        self.index, self._injection, self._act = index, injection, injection.fault.acts[name]
        key = f"fault {index} {injection.fault.name}"
        self._azimuth = float(stream(seed, key).uniform(-np.pi, np.pi))
        self._rng = stream(seed, f"{key} {name}")
        self._count = 0
        self._first: Rows | None = None

    def act(self, rows: Rows, origin_ns: int) -> tuple[Rows, int]:
        """Rows that follow those before, and how many of them the fault met. origin_ns: of the first IMU sample."""
        begin = origin_ns + round(self._injection.begin_s * NS_PER_S)
        since = rows.true_ns - begin
        inside = (since >= 0) & (since < round(self._injection.length_s * NS_PER_S))
        met = np.flatnonzero(inside)
        if not len(met):
            return rows, 0
        mine = rows.chosen(met)
        if self._first is None:
            self._first = rows.chosen(met[:1])
        number = self._count + np.arange(len(met))
        self._count += len(met)
        size = self._injection.fault.size(self._injection.severity)
        during = During(since[met] / NS_PER_S, number, size, self._first, self._azimuth, self._rng)
        acted = self._act(mine, during)
        parts = (rows.chosen(slice(int(met[0]))), acted, rows.chosen(slice(int(met[-1]) + 1, None)))
        return _stacked(parts), len(met)


def _stacked(parts: Sequence[Rows]) -> Rows:
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns}
    return Rows(np.concatenate([part.true_ns for part in parts]), columns)
