"""GNSS hidden on purpose: the filter goes without it, the hidden RTK fixes become the reference."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.result import Decisions, Sensor
from replay.config import HideGnss
from replay.references import FOREVER_NS, LATE_NS, PAUSE_NS
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import map_from_llh
from sensors.records import GnssFix, GnssStatus, Log, Trajectory
from sensors.vehicle import Vehicle

Nanoseconds = NDArray[np.int64]
Stretches = NDArray[np.int64]

RECORDS = {Sensor.GNSS_POSITION: "gnss", Sensor.GNSS_YAW: "gnss", Sensor.GNSS_VELOCITY: "gnss_velocity"}
"""Of whose measurements rows are hidden."""


class Hider:
    """Takes GNSS out of a drive that comes piece by piece, and keeps the books.

    Stretches count from the first fix, in true time (stamp less the vehicle's delay), so that no velocity of another
    delay reaches into one. All are hidden; one is used for scoring if the IMU goes on to its end and a fix comes then
    or within PAUSE_NS: the stretch that the log's end cuts off is not used.
    """

    def __init__(self, hide: HideGnss, vehicle: Vehicle) -> None:
        self._hide, self._vehicle = hide, vehicle
        self._every, self._length = round(hide.every_s * NS_PER_S), round(hide.length_s * NS_PER_S)
        self._first_ns: int | None = None
        self._imu_ns = -FOREVER_NS
        self._last_fix_ns = -FOREVER_NS
        self._fixed = 0
        self._fixes: Nanoseconds = np.empty(0, np.int64)
        self._decided = 0
        self._used: list[int] = []
        self._closed = False
        self._rows = {name: _Rows() for name in ("gnss", "gnss_velocity")}

    def hide(self, piece: Log) -> Log:
        """What the filter gets of a piece that knows its map frame; its reference: the antenna at all fixed fixes."""
        if piece.imu is not None:
            self._imu_ns = int(piece.imu.t_ns[-1])
        track = None
        if piece.gnss is not None and len(piece.gnss):
            true_ns = piece.gnss.t_ns - delay_ns(self._vehicle.gnss_delay_s)
            self._first_ns = int(true_ns[0]) if self._first_ns is None else self._first_ns
            self._last_fix_ns = int(true_ns[-1])
            self._fixes = np.concatenate((self._fixes, true_ns))
            track = antenna_track(piece)
            self._fixed += len(track)
        self._decide()
        given = self._without(piece, "gnss", self._vehicle.gnss_delay_s)
        given = self._without(given, "gnss_velocity", self._vehicle.gnss_velocity_delay_s)
        return replace(given, reference=track)

    def settled_ns(self, now_ns: int) -> int:
        """Up to when it is known which stretches are used. now_ns: the latest IMU sample."""
        if self._closed:
            return FOREVER_NS
        return now_ns - LATE_NS if self._first_ns is None else self._stretch(self._decided)[0] - 1

    def close(self) -> None:
        """Nothing follows. Raises EgolocError where there is nothing to compare with."""
        self._closed = True
        if not self._fixed or self._first_ns is None:
            raise EgolocError("--hide-gnss: expected GNSS fixes of status fixed in the log to compare with, found none")
        if not self._used:
            seconds = (min(self._last_fix_ns, self._imu_ns) - self._first_ns) / NS_PER_S
            raise EgolocError(
                f"--hide-gnss: expected at least {self._hide.every_s + self._hide.length_s:g} s of GNSS and IMU "
                f"for one stretch, found {max(seconds, 0):.1f} s"
            )

    def stretches(self) -> Stretches:
        """(S, 2) int64, start and end of those used so far."""
        return np.array([self._stretch(index) for index in self._used], np.int64).reshape(-1, 2)

    def original_rows(self, decisions: Decisions) -> NDArray[np.int64]:
        """(M,) rows of the records as the log holds them."""
        rows = decisions.row.astype(np.int64)
        for sensor, name in RECORDS.items():
            here = decisions.sensor == sensor
            rows[here] = self._rows[name].original(rows[here])
        return rows

    def _stretch(self, index: int) -> tuple[int, int]:
        assert self._first_ns is not None
        start = self._first_ns + (index + 1) * self._every
        return start, start + self._length

    def _decide(self) -> None:
        """Decide which stretches are used, one after the other, as far as can be known."""
        while self._first_ns is not None:
            _, end = self._stretch(self._decided)
            later = self._fixes[np.searchsorted(self._fixes, end) :]
            returned = len(later) > 0 and int(later[0]) <= end + PAUSE_NS
            if returned and self._imu_ns >= end:
                self._used.append(self._decided)
            elif returned or (not len(later) and self._imu_ns < end + PAUSE_NS + LATE_NS):
                self._fixes = later
                return
            self._decided += 1

    def _without(self, piece: Log, name: str, delay_s: float) -> Log:
        """A piece with the rows of a record that were true outside the stretches."""
        record = getattr(piece, name)
        if record is None:
            return piece
        outside = ~self._hides(record.t_ns - delay_ns(delay_s))
        self._rows[name].add(outside)
        kept: dict[str, Any] = {name: record[outside] if outside.any() else None}
        return replace(piece, **kept)

    def _hides(self, t_ns: Nanoseconds) -> NDArray[np.bool_]:
        if self._first_ns is None:
            return np.zeros(len(t_ns), np.bool_)
        since = t_ns - self._first_ns
        hidden: NDArray[np.bool_] = (since >= self._every) & (since % self._every < self._length)
        return hidden


class _Rows:
    """Row numbers of a record in the log, from those of its rows that were kept."""

    def __init__(self) -> None:
        self._seen = self._kept = 0
        self._starts, self._shifts = [0], [0]

    def add(self, kept: NDArray[np.bool_]) -> None:
        """Take the next rows, of which some are kept."""
        shift = self._seen + np.flatnonzero(kept) - (self._kept + np.arange(kept.sum()))
        new = np.flatnonzero(np.diff(shift, prepend=self._shifts[-1]))
        self._starts += (self._kept + new).tolist()
        self._shifts += shift[new].tolist()
        self._seen += len(kept)
        self._kept += len(shift)

    def original(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        found: NDArray[np.int64] = rows + np.array(self._shifts)[np.searchsorted(self._starts, rows, side="right") - 1]
        return found


def delay_ns(delay_s: float) -> int:
    """A vehicle's delay in whole nanoseconds."""
    return round(delay_s * NS_PER_S)


def antenna_track(log: Log) -> Trajectory:
    """The antenna at the log's fixed fixes, at the times when these were true; no attitude."""
    if log.gnss is None or log.map_frame is None:
        raise EgolocError("--hide-gnss: expected GNSS and a map frame")
    fixed: GnssFix = log.gnss[log.gnss.status == GnssStatus.FIXED]
    sigma = np.stack((horizontal_sigma(fixed.cov_enu), np.full(len(fixed), np.nan)), axis=-1)
    t_ns = fixed.t_ns - delay_ns(log.vehicle.gnss_delay_s)
    return Trajectory(t_ns, fixed.arrival_ns, map_from_llh(log.map_frame, fixed.llh), sigma=sigma)


def horizontal_sigma(cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) m, standard deviation along the worst horizontal direction of covariances (N, 3, 3)."""
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    result: NDArray[np.float64] = np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b))
    return result


def stretch_index(t_ns: Nanoseconds, stretches: Stretches) -> NDArray[np.int32]:
    """(N,) which stretch holds each time; -1: none."""
    if not len(stretches):
        return np.full(len(t_ns), -1, np.int32)
    index = np.searchsorted(stretches[:, 0], t_ns, side="right") - 1
    inside = (index >= 0) & (t_ns < stretches[np.maximum(index, 0), 1])
    return np.where(inside, index, -1).astype(np.int32)
