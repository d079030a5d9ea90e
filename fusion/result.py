"""What a filter run returns: states on the output grid and one decision per measurement."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.records import LeftOut

Floats = NDArray[np.float64]


class Sensor(IntEnum):
    """Kinds of measurement."""

    GNSS_POSITION = 0
    GNSS_VELOCITY = 1
    GNSS_YAW = 2
    POSE_FIX = 3
    WHEEL = 4
    ZERO_VELOCITY = 5
    NON_HOLONOMIC = 6


class Reason(IntEnum):
    """Why a measurement was applied or not."""

    ACCEPTED = 0
    PARTLY_ACCEPTED = 1
    """Pose fix: unobserved directions dropped, the rest applied."""
    CHI_SQUARE = 2
    COVARIANCE = 3
    """Pose fix: no direction is observed."""
    STATUS = 4
    """GNSS status below the configured one."""
    SWITCHED_OFF = 5
    BEFORE_ALIGNMENT = 6
    OUTSIDE_IMU = 7
    """No IMU samples at this time."""
    USED_FOR_ALIGNMENT = 8
    LATE = 9
    """Came when the state had passed its time (in arrival order: by more than the history)."""
    RECEIVER = 10
    """GNSS velocity: the receiver's position was rejected at the same time, and reflections upset both."""
    DUPLICATE = 11
    """Arrival order: the sensor's measurement of this time is there already."""
    MODES_AGREE = 12
    """Pose fix with two modes: the directions in which they differ dropped, the rest applied."""
    MULTI_MODAL = 13
    """Pose fix with two modes that agree in no observed direction."""


class Health(IntEnum):
    """State of health, worst first where several hold: diverged, dead reckoning, degraded, recovered, healthy."""

    INITIALIZING = 0
    """There is no state: before the first alignment, or between a divergence and the next."""
    HEALTHY = 1
    DEGRADED = 2
    """A sensor that the drive has is not good, or the stated sigma is large; the cause says which."""
    DEAD_RECKONING = 3
    """No position was applied for a while."""
    DIVERGED = 4
    """Not to be used; the cause says why."""
    RECOVERED = 5
    """All is well again, but only for a short time."""


class Cause(IntEnum):
    """Why the state is degraded or diverged."""

    NONE = 0
    GNSS_POSITION = 1
    GNSS_VELOCITY = 2
    GNSS_YAW = 3
    POSE_FIX = 4
    WHEEL = 5
    SIGMA = 6
    """Position or yaw is known badly."""
    UNSETTLED = 7
    """It gave way to positions that contradicted it, of one sensor alone or again and again."""
    NOT_FINITE = 8
    """The state is not finite, or a variance not a number above zero."""
    TOO_FAST = 9
    """Faster than any land vehicle."""
    COVARIANCE = 10
    """Position or yaw is not known at all."""
    REJECTED = 11
    """No position was explained by the state for long."""
    TILTED = 12
    """A land vehicle on its side: the IMU's axes are others."""
    LASTING_ERROR = 13
    """GNSS or pose fixes are applied, but only with an error that lasts and is many of its sigmas: they contradict the
    rest."""


class Level(IntEnum):
    """How far a sensor is to be trusted."""

    ABSENT = 0
    """The filter has judged none of its measurements."""
    STALE = 1
    """None that could be used for a while."""
    SUSPECT = 2
    """The state does not explain them."""
    GOOD = 3


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """States at t_ns (N,), each after all measurements up to and including its time.

    llh (N, 3); vel_enu (N, 3) m/s; q_enu_body (N, 4) xyzw; gyro_bias (N, 3) rad/s; accel_bias (N, 3) m/s^2;
    pose_cov (N, 6, 6): position ENU m, attitude (left error, ENU) rad; sigma (N, 15): standard deviation of the whole
    error state: position ENU m, velocity ENU m/s, attitude rad, gyro bias rad/s, accelerometer bias m/s^2; health,
    cause (N,) and levels (N, 5) of each sensor, int8: Health, Cause and Level.
    """

    t_ns: NDArray[np.int64]
    llh: Floats
    vel_enu: Floats
    q_enu_body: Floats
    gyro_bias: Floats
    accel_bias: Floats
    pose_cov: Floats
    sigma: Floats
    health: NDArray[np.int8]
    cause: NDArray[np.int8]
    levels: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True, slots=True, eq=False)
class Decisions:
    """One row per measurement, in the order of application.

    t_ns (M,) when it was applied (its stamp minus the vehicle's delay), arrival_ns (M,); sensor, reason (M,) int8
    (Sensor, Reason); row (M,) index into the log's record (-1: none); innovation, innovation_sigma (M, 3), NaN where
    unused: GNSS in ENU; pose fix along and left of the estimated heading m, yaw rad (partly accepted: the kept
    directions, in sigmas of the gate); wheel forward, non-holonomic lateral and vertical m/s; nis, threshold (M,),
    dof (M,) int8; moved_m, moved_yaw (M,): how far the update moved position (m) and yaw (rad); weight (M,): by what a
    robust kernel multiplied the measurement's information, 1 without one, 0 if rejected.
    """

    t_ns: NDArray[np.int64]
    arrival_ns: NDArray[np.int64]
    sensor: NDArray[np.int8]
    row: NDArray[np.int64]
    reason: NDArray[np.int8]
    innovation: Floats
    innovation_sigma: Floats
    nis: Floats
    threshold: Floats
    dof: NDArray[np.int8]
    moved_m: Floats
    moved_yaw: Floats
    weight: Floats


class Restart(NamedTuple):
    """The filter diverged (Cause) and was aligned anew from t_ns on; whether it succeeded shows in
    the decisions."""

    t_ns: int
    cause: int


@dataclass(frozen=True, slots=True)
class Estimated:
    """A constant as the filter ends up with it: value, of which given comes from the vehicle, sigma, and the sigma that
    it began with, all in unit; excited: whether the drive shows it (else it keeps its prior)."""

    name: str
    unit: str
    given: float
    value: float
    sigma: float
    prior_sigma: float
    excited: bool


@dataclass(frozen=True, slots=True, eq=False)
class FusionResult:
    """States, decisions, the time of the first state (None: never aligned, states are empty), what was left out, when
    the filter was started again, and at the end of a drive what it shows of the calibration (``fusion.calibration``).
    """

    states: States
    decisions: Decisions
    aligned_ns: int | None
    left_out: Sequence[LeftOut] = ()
    restarts: Sequence[Restart] = ()
    estimates: tuple[Estimated, ...] = ()
