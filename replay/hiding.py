"""GNSS hidden on purpose: the filter goes without it, the hidden RTK fixes become the reference."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.result import Sensor
from replay.config import HideGnss
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import map_from_llh
from sensors.records import GnssFix, GnssStatus, Log, Trajectory

Stretches = NDArray[np.int64]
Rows = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """A log without GNSS in the stretches.

    log: what the filter gets, its reference the antenna at all fixed fixes; stretches: (S, 2) int64, start and end,
    true time of the fixes; rows: for each thinned record, the rows (N,) of the original that were kept.
    """

    log: Log
    stretches: Stretches
    rows: Mapping[Sensor, Rows]


def plan_stretches(first_ns: int, end_ns: int, hide: HideGnss) -> Stretches:
    """(S, 2) int64 [start, end): one at every multiple of EVERY after the first fix, the last complete by end_ns."""
    every, length = round(hide.every_s * NS_PER_S), round(hide.length_s * NS_PER_S)
    starts = np.arange(first_ns + every, max(end_ns - length + 1, first_ns), every, dtype=np.int64)
    return np.stack((starts, starts + length), axis=-1)


def hide_gnss(log: Log, hide: HideGnss) -> Hidden:
    """A log without the GNSS positions, velocities and yaw that were true within the stretches.

    Its fixed fixes become the reference. Stretches count from the first fix, in true time (stamp less the vehicle's
    delay), so that no velocity of another delay reaches into one. The log must know its map frame.
    """
    gnss = log.gnss
    if gnss is None or not len(gnss) or not (gnss.status == GnssStatus.FIXED).any():
        raise EgolocError("--hide-gnss: expected GNSS fixes of status fixed in the log to compare with, found none")
    true_ns = gnss.t_ns - delay_ns(log.vehicle.gnss_delay_s)
    end_ns = int(true_ns[-1]) if log.imu is None else int(min(true_ns[-1], log.imu.t_ns[-1]))
    stretches = plan_stretches(int(true_ns[0]), end_ns, hide)
    if not len(stretches):
        seconds = (end_ns - int(true_ns[0])) / NS_PER_S
        raise EgolocError(
            f"--hide-gnss: expected at least {hide.every_s + hide.length_s:g} s of GNSS and IMU for one stretch, "
            f"found {max(seconds, 0):.1f} s"
        )
    rows = {Sensor.GNSS_POSITION: _outside(true_ns, stretches)}
    rows[Sensor.GNSS_YAW] = rows[Sensor.GNSS_POSITION]
    thinned = replace(log, gnss=gnss[rows[Sensor.GNSS_POSITION]], reference=antenna_track(log))
    if log.gnss_velocity is not None:
        velocity_ns = log.gnss_velocity.t_ns - delay_ns(log.vehicle.gnss_velocity_delay_s)
        rows[Sensor.GNSS_VELOCITY] = _outside(velocity_ns, stretches)
        thinned = replace(thinned, gnss_velocity=log.gnss_velocity[rows[Sensor.GNSS_VELOCITY]])
    return Hidden(thinned, stretches, rows)


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


def stretch_index(t_ns: NDArray[np.int64], stretches: Stretches) -> NDArray[np.int32]:
    """(N,) which stretch holds each time; -1: none."""
    if not len(stretches):
        return np.full(len(t_ns), -1, np.int32)
    index = np.searchsorted(stretches[:, 0], t_ns, side="right") - 1
    inside = (index >= 0) & (t_ns < stretches[np.maximum(index, 0), 1])
    return np.where(inside, index, -1).astype(np.int32)


def _outside(t_ns: NDArray[np.int64], stretches: Stretches) -> Rows:
    return np.flatnonzero(stretch_index(t_ns, stretches) < 0)
