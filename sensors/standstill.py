"""Where an IMU rests: the longest stretch of even samples in which nothing moves.

Seconds are judged one by one, as the filter's zero-velocity update does: by the spread of the specific force's norm and
of the yaw rate (an idling engine shakes the other two), against fixed limits and against the quietest ten seconds of
the log; a steady turn by its mean rate; and by GNSS or wheel speeds, where the log has them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.records import GnssVelocity, Imu, WheelSpeed

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

FORCE = 0.25
"""Largest standard deviation of the specific force's norm within a second of rest, m/s^2."""
TURN_DEG = 0.3
"""The same of the yaw rate, and of its mean against that of the other seconds, deg/s."""
QUIET_RATIO = 4.0
"""And at most so many times that of the quietest seconds."""
QUIET_SECONDS = 10
SPEED = 0.5
"""A speed above this and three of its sigmas is no rest, m/s."""
LEAST_SECONDS = 12
"""Of rest, with the one at each end that is left out."""
LONGEST_FILLED = 10
"""So many lost samples in a row are filled by a line; more of them end a stretch."""
UNEVEN = 0.25
"""A sample this far from its place on the grid (in intervals) is out of step, and so may be one in a hundred."""
UNEVEN_SHARE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Even samples of a stretch at rest.

    t_ns: its first and last stamp; interval_s; gyro, accel: (N, 3) rad/s, m/s^2; filled: samples that were lost and lie
    on a line now; whole: it is the whole log, but for a second at each end; seconds: how many of the log are at rest.
    """

    t_ns: tuple[int, int]
    interval_s: float
    gyro: Floats
    accel: Floats
    filled: int
    whole: bool
    seconds: int


def longest_rest(imu: Imu, speeds: Sequence[GnssVelocity | WheelSpeed] = ()) -> Rest:
    """The longest stretch at rest, without the second at each of its ends.

    Raises EgolocError for samples that are not even, and where the vehicle never rests for LEAST_SECONDS.
    """
    interval_ns = sampling_interval(imu.t_ns)
    first_s = int(imu.t_ns[0]) // NS_PER_S
    second = imu.t_ns // NS_PER_S - first_s
    quiet = _quiet_seconds(imu, second, round(NS_PER_S / interval_ns))
    for record in speeds:
        moving = record.t_ns[_moving(record)] // NS_PER_S - first_s
        quiet[moving[(moving >= 0) & (moving < len(quiet))]] = False
    seconds = int(quiet.sum())
    steps = np.rint(np.diff(imu.t_ns) / interval_ns)
    quiet[second[1:][steps > LONGEST_FILLED + 1]] = False  # a gap
    begin, end = _longest_run(quiet)
    if end - begin < LEAST_SECONDS:
        raise EgolocError(
            f"expected the vehicle at rest for {LEAST_SECONDS} s on end, got {end - begin} s at most "
            f"({seconds} of {len(quiet)} s are quiet): record it standing"
        )
    rows = np.flatnonzero((second > begin) & (second < end - 1))
    whole = bool(begin <= 1 and end >= len(quiet) - 1)
    return _even(imu[rows], interval_ns, whole, seconds)


def sampling_interval(t_ns: Nanoseconds) -> float:
    """The interval between samples, ns. Raises EgolocError where they are not evenly spaced but for lost ones."""
    if len(t_ns) < 2:
        raise EgolocError(f"expected IMU samples, got {len(t_ns)}")
    steps = np.diff(t_ns).astype(np.float64)
    interval = float(np.median(steps))
    near = steps[np.abs(steps / interval - 1.0) < UNEVEN]
    places = steps / interval
    uneven = np.abs(places - np.maximum(np.rint(places), 1.0)) > UNEVEN
    if uneven.mean() > UNEVEN_SHARE:
        raise EgolocError(
            f"expected IMU samples at an even rate, got {100 * uneven.mean():.0f} % of the intervals "
            f"{100 * UNEVEN:.0f} % off the median of {interval * 1e-6:.3f} ms"
        )
    return float(near.mean())


def _quiet_seconds(imu: Imu, second: NDArray[np.int64], expected: int) -> NDArray[np.bool_]:
    """(S,) whether each second is quiet; one with less than half of its samples is not."""
    size = int(second[-1]) + 1
    count = np.bincount(second, minlength=size)
    force, force_var = _spread(np.linalg.norm(imu.accel, axis=1), second, count)
    turn, turn_var = _spread(imu.gyro[:, 2], second, count)
    full = count >= max(0.5 * expected, 5)
    if not full.any():
        raise EgolocError(f"expected an IMU with five samples a second at least, got {len(imu) / size:.1f}")
    quiet = full & (force_var < _limit(force_var, full, FORCE**2))
    quiet &= turn_var < _limit(turn_var, full, np.radians(TURN_DEG) ** 2)
    if quiet.any():
        quiet &= np.abs(turn - np.median(turn[quiet])) < np.radians(TURN_DEG)
        quiet &= np.abs(force - np.median(force[quiet])) < FORCE
    return quiet


def _spread(values: Floats, second: NDArray[np.int64], count: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """(S,) mean and variance of each second's values."""
    centre = values.mean()
    some = np.maximum(count, 1)
    mean = np.bincount(second, values - centre, len(count)) / some
    square = np.bincount(second, (values - centre) ** 2, len(count)) / some
    return mean + centre, np.maximum(square - mean**2, 0.0)


def _limit(variance: Floats, full: NDArray[np.bool_], largest: float) -> float:
    """The largest variance of a quiet second."""
    given = variance[full]
    width = min(QUIET_SECONDS, len(given))
    running = np.convolve(given, np.full(width, 1.0 / width), "valid")
    return float(min(largest, QUIET_RATIO**2 * running.min() + 1e-30))


def _moving(record: GnssVelocity | WheelSpeed) -> NDArray[np.bool_]:
    """(N,) rows that are surely no rest."""
    if isinstance(record, WheelSpeed):
        return np.abs(record.speed) > SPEED + 3.0 * record.sigma
    sigma = np.sqrt(record.cov_enu[:, 0, 0] + record.cov_enu[:, 1, 1])
    result: NDArray[np.bool_] = np.hypot(record.vel_enu[:, 0], record.vel_enu[:, 1]) > SPEED + 3.0 * sigma
    return result


def _longest_run(flags: NDArray[np.bool_]) -> tuple[int, int]:
    """First and end of the longest run of True; (0, 0) without one."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False]))))
    if not len(edges):
        return 0, 0
    begin, end = edges[::2], edges[1::2]
    longest = int(np.argmax(end - begin))
    return int(begin[longest]), int(end[longest])


def _even(imu: Imu, interval_ns: float, whole: bool, seconds: int) -> Rest:
    """The samples on an even grid; those that were lost lie on a line between their neighbours."""
    steps = np.maximum(np.rint(np.diff(imu.t_ns) / interval_ns), 1.0)
    place = np.concatenate(([0.0], np.cumsum(steps)))
    grid = np.arange(int(place[-1]) + 1)
    gyro, accel = (np.stack([np.interp(grid, place, axis) for axis in x.T], axis=-1) for x in (imu.gyro, imu.accel))
    span = (int(imu.t_ns[0]), int(imu.t_ns[-1]))
    return Rest(span, interval_ns * 1e-9, gyro, accel, len(grid) - len(imu), whole, seconds)
