"""Logs for tests: simulated drives with parts taken out or altered."""

from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sensors.records import GnssFix, GnssVelocity, Imu, Log, PoseFix, WheelSpeed

Record = TypeVar("Record", Imu, GnssFix, GnssVelocity, PoseFix, WheelSpeed)


def seconds(log: Log, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Seconds since the first IMU sample."""
    assert log.imu is not None
    result: NDArray[np.float64] = (t_ns - log.imu.t_ns[0]) * 1e-9
    return result


def without(record: Record | None, log: Log, begin_s: float, end_s: float) -> Record:
    """The record without the rows in [begin, end) seconds of the log."""
    assert record is not None
    s = seconds(log, record.t_ns)
    return record[(s < begin_s) | (s >= end_s)]


def with_gap(log: Log, begin_s: float, length_s: float) -> Log:
    """The log with IMU samples missing."""
    return replace(log, imu=without(log.imu, log, begin_s, begin_s + length_s))


def with_outage(log: Log, begin_s: float, length_s: float) -> Log:
    """The log without GNSS and pose fixes for a while."""
    end_s = begin_s + length_s
    return replace(
        log,
        gnss=without(log.gnss, log, begin_s, end_s),
        gnss_velocity=without(log.gnss_velocity, log, begin_s, end_s),
        pose_fixes=without(log.pose_fixes, log, begin_s, end_s),
    )


def later(log: Log, begin_s: float) -> Log:
    """The log from begin_s on, as if recording had started there."""
    names = ("imu", "gnss", "gnss_velocity", "pose_fixes", "wheel")
    return replace(log, **{name: without(getattr(log, name), log, -1e9, begin_s) for name in names})


def only(log: Log, *names: str) -> Log:
    """The log with the IMU and these records alone."""
    others = {"gnss", "gnss_velocity", "pose_fixes", "wheel"} - set(names)
    return replace(log, reference=None, **dict.fromkeys(others))


def without_yaw(log: Log) -> Log:
    """The log without a second antenna."""
    assert log.gnss is not None
    return replace(log, gnss=replace(log.gnss, yaw=None, yaw_sigma=None))
