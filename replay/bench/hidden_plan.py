"""Which stretches of a log are hidden, and what their ends are judged by.

Stretches begin every so many seconds from the first GNSS position on, in true time (stamp less the vehicle's delay).
The end of one is judged by the log's reference where that has headings (simulated drives: the truth, exactly at the
end), else by the first withheld position of status fixed at or after the end, and its yaw by the RTK course there.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.baselines import enu_between
from replay.hiding import delay_ns
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import llh_from_map, rotation_map_enu
from sensors.records import GnssFix, GnssStatus, Log, Trajectory
from sensors.rotation import wrap, yaw_from_q

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Window = tuple[float, float]

REFERENCE, FIXES = "the reference", "the withheld fixes"
"""What ends are judged by."""
AFTER_S = 0.3
"""A filter is run so far past an end, to have states on both sides of it."""
BASELINE_S = 1.0
"""A course is the direction from the position so long before a time to the one so long after it, s."""
MIN_COURSE_SPEED = 5.0
"""Slower than this the course is no yaw, m/s."""
MAX_TURN_DEG = 3.0
"""Where the courses before and after differ by more than this the vehicle turns, and slips."""
SLIP_DEG = 0.5
"""Course against heading of a car that drives straight: side slip, road bank and mounting, deg (its part of the
course's sigma)."""


@dataclass(frozen=True, slots=True, eq=False)
class End:
    """Where the vehicle was at the end of a stretch.

    t_ns; llh (3,) of the plan's point; cov (2, 2) east, north m^2; yaw from east and its sigma, rad, NaN where unknown.
    """

    t_ns: int
    llh: Floats
    cov: Floats
    yaw: float
    yaw_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """GNSS is hidden from start_ns on; ends: by length in s, those that are judged."""

    start_ns: int
    ends: dict[float, End]

    @property
    def last_ns(self) -> int:
        return max(end.t_ns for end in self.ends.values())


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """stretches: in order; point (3,): what is judged, body frame m; judge: its name; unused: ends that are not judged,
    by length and reason; middle_ns: half of the time that IMU and GNSS share."""

    stretches: list[Stretch]
    point: Floats
    judge: str
    unused: dict[float, Counter[str]]
    middle_ns: int


def plan(log: Log, lengths_s: Sequence[float], every_s: float, windows: Sequence[Window]) -> Plan:
    """Stretches of each length that lie within one of the windows (s since the first position).

    Raises EgolocError for a log without IMU or positions, and for lengths or an interval that make no stretch.
    """
    for name, values in (("--lengths", lengths_s), ("--every", (every_s,))):
        for value in values:
            if not 0.1 <= value <= 86_400.0:
                raise EgolocError(f"{name}: expected seconds from 0.1 to a day, got {value:g}")
    if not lengths_s:
        raise EgolocError("--lengths: expected at least one length in s, got none")
    if log.imu is None or len(log.imu) < 2:
        raise EgolocError("bench hidden: expected a log with an IMU")
    if log.gnss is None or not len(log.gnss):
        raise EgolocError("bench hidden: expected a log with GNSS positions to hide")
    fix_ns = log.gnss.t_ns - delay_ns(log.vehicle.gnss_delay_s)
    first, last = max(int(fix_ns[0]), int(log.imu.t_ns[0])), min(int(fix_ns[-1]), int(log.imu.t_ns[-1]))
    judge = _Reference(log) if _has_headings(log.reference) else _Fixes(log.gnss, fix_ns)
    unused: dict[float, Counter[str]] = {length: Counter() for length in lengths_s}
    stretches = []
    origin, every = int(fix_ns[0]), round(every_s * NS_PER_S)
    for start in range(origin + every, last, every):
        ends = {}
        for length in lengths_s:
            since = (start - origin) / NS_PER_S
            found = judge.at(start + round(length * NS_PER_S))
            if not any(begin <= since and since + length <= end for begin, end in windows):
                unused[length]["outside the windows"] += 1
            elif found is None or found.t_ns + AFTER_S * NS_PER_S > log.imu.t_ns[-1]:
                unused[length][judge.missing if found is None else "the IMU ends before"] += 1
            else:
                ends[length] = found
        if ends:
            stretches.append(Stretch(start, ends))
    if not stretches:
        raise EgolocError("bench hidden: expected at least one stretch within the windows and the log, found none")
    arm = log.vehicle.reference_lever_arm if isinstance(judge, _Reference) else log.vehicle.gnss_lever_arm
    return Plan(stretches, np.array(arm), judge.name, unused, first + (last - first) // 2)


def _has_headings(reference: Trajectory | None) -> bool:
    return reference is not None and len(reference) > 1 and bool(np.isfinite(reference.q_map_body).all())


class _Reference:
    """A reference with headings."""

    name = REFERENCE
    missing = "no reference at the end"

    def __init__(self, log: Log) -> None:
        if log.map_frame is None or log.reference is None:
            raise EgolocError("bench hidden: expected a map frame with the reference")
        self._reference, self._frame = log.reference, log.map_frame

    def at(self, t_ns: int) -> End | None:
        """The pose at a time, on the line between its neighbours."""
        known = self._reference
        i = int(np.searchsorted(known.t_ns, t_ns, side="right")) - 1
        if i < 0 or i + 1 >= len(known) or known.t_ns[i + 1] - known.t_ns[i] > NS_PER_S:
            return None
        weight = float(t_ns - known.t_ns[i]) / float(known.t_ns[i + 1] - known.t_ns[i])
        between = (1.0 - weight) * known.p_map[i] + weight * known.p_map[i + 1]
        llh = llh_from_map(self._frame, between[None])
        yaws = yaw_from_q(known.q_map_body[i : i + 2])
        R_map_enu = rotation_map_enu(self._frame, llh)[0][0]
        turned = float(np.arctan2(R_map_enu[1, 0], R_map_enu[0, 0]))
        yaw = float(wrap(yaws[0] + weight * wrap(yaws[1] - yaws[0]) - turned))
        sigma, yaw_sigma = np.nan_to_num(known.sigma[i])
        return End(t_ns, llh[0], np.eye(2) * sigma**2, yaw, float(yaw_sigma))


class _Fixes:
    """Positions of status fixed, and their course."""

    name = FIXES
    missing = "no fixed position at the end"

    def __init__(self, gnss: GnssFix, t_ns: Nanoseconds) -> None:
        fixed = gnss.status == GnssStatus.FIXED
        self._fixes, self._t_ns = gnss[fixed], t_ns[fixed]
        self._late_ns = int(1.5 * np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0

    def at(self, t_ns: int) -> End | None:
        """The first position from a time on, no later than 1.5 periods."""
        i = int(np.searchsorted(self._t_ns, t_ns))
        if i == len(self._t_ns) or self._t_ns[i] - t_ns > self._late_ns:
            return None
        yaw, sigma = self._course(i)
        return End(int(self._t_ns[i]), self._fixes.llh[i], self._fixes.cov_enu[i, :2, :2], yaw, sigma)

    def _course(self, i: int) -> tuple[float, float]:
        """Direction of motion at position i and its sigma, rad; NaN where it says nothing of the yaw."""
        before, after = (self._nearest(int(self._t_ns[i]) + sign * round(BASELINE_S * NS_PER_S)) for sign in (-1, 1))
        if before is None or after is None:
            return np.nan, np.nan
        legs = [enu_between(self._fixes.llh[a], self._fixes.llh[b])[:2] for a, b in ((before, i), (i, after))]
        first, second = (np.arctan2(leg[1], leg[0]) for leg in legs)
        way = legs[0] + legs[1]
        length, seconds = float(np.hypot(*way)), float(self._t_ns[after] - self._t_ns[before]) / NS_PER_S
        if length < MIN_COURSE_SPEED * seconds or abs(wrap(second - first)) > np.radians(MAX_TURN_DEG):
            return np.nan, np.nan
        sigma = np.sqrt(self._fixes.cov_enu[i, :2, :2].trace()) / length
        return float(np.arctan2(way[1], way[0])), float(np.hypot(sigma, np.radians(SLIP_DEG)))

    def _nearest(self, t_ns: int) -> int | None:
        """The position nearest to a time, if it is within a fifth of BASELINE_S."""
        i = int(np.argmin(np.abs(self._t_ns - t_ns)))
        return i if abs(int(self._t_ns[i]) - t_ns) <= 0.2 * BASELINE_S * NS_PER_S else None
