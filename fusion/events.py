"""What the kernel reads and writes: parameters, measurement columns, events and recorded decisions."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion._linalg import Vector
from fusion.covariance import Noise
from fusion.divergence import HealthLimits
from fusion.layout import Layout
from fusion.state import Floats

MOTION = 100
"""Event: see whether the vehicle stands, then apply zero velocity or the non-holonomic constraint."""
OUTPUT = 101
"""Event: record the state."""
AGAIN = -2
"""Verdict on an event that was applied and recorded before, and is applied once more after a rewind."""


class Parameters(NamedTuple):
    """The configuration in SI units, as the kernel reads it."""

    noise: Noise
    layout: Layout
    axes_var: float
    """Of the gyro's vertical axis against the body's, each way, rad^2 (``fusion.axes``)."""
    gnss_shares: tuple[float, float]
    """Of a position's variance, which may be white and which may last."""
    pose_shares: tuple[float, float]
    gnss_rate: float
    """How fast what lasts is forgotten, 1/s."""
    pose_per_m: float
    """The same of pose fixes along the road, 1/m."""
    increments: bool
    max_gap_ns: int
    bridge_ns: int
    coast_accel: float
    coast_rate: float
    gate: Vector
    """Chi-square thresholds for 1, 2 and 3 degrees of freedom."""
    outvoted: int
    """So many agreeing rejections of GNSS positions and pose fixes outvote the state."""
    streak: int
    """So many rejected pose fixes that say the same are a streak."""
    reentry: Vector
    """Thresholds for a pose fix that goes on with a streak."""
    robust: int
    """Robust kernel: its place in config.KERNELS."""
    robust_sigmas: float
    gnss_arm: Vector
    pose_arm: Vector
    axle: Vector
    pose_limits: Vector
    """Largest observed sigma along, left and in yaw, of the inflated covariance."""
    pose_partial: bool
    """Use the observed directions where others are not."""
    zero_velocity: bool
    non_holonomic: bool
    wheel_slip: float
    """Slip for every m/s^2 of acceleration, s^2/m."""
    lateral_var: float
    vertical_var: float
    per_speed: float
    learning_ticks: int
    unknown_var: float
    min_speed: float
    still_window_ns: int
    still_wait_ns: int
    still_ratio: float
    still_accel_var: float
    still_rate_var: float
    still_drift_var: float
    still_max_speed: float
    zero_velocity_var: float
    zero_rate_var: float
    health: HealthLimits
    level: bool
    """A land vehicle, which hardly tilts."""


class Measurements(NamedTuple):
    """Columns of each sensor with the covariances that the filter uses (floors and inflation applied).

    gnss_llh (N, 3), gnss_cov (N, 3, 3) ENU; vel (N, 3), vel_cov (N, 3, 3); yaw, yaw_var (N,); pose_llh (N, 3),
    pose_yaw (N,) from east, pose_tilt (N, 2), pose_cov (N, 3, 3) in (east, north, yaw), pose_spread (N, 3) the part
    s s' of it that stands for two modes (``fusion.modes``); wheel, wheel_var (N,).
    """

    gnss_llh: Floats
    gnss_cov: Floats
    vel: Floats
    vel_cov: Floats
    yaw: Floats
    yaw_var: Floats
    pose_llh: Floats
    pose_yaw: Floats
    pose_tilt: Floats
    pose_cov: Floats
    pose_spread: Floats
    wheel: Floats
    wheel_var: Floats


class Events(NamedTuple):
    """What happens when, sorted: t (M,) ns; kind (M,) Sensor, MOTION or OUTPUT; row (M,) into its sensor's columns;
    verdict (M,) int8: -1 to apply, AGAIN, or the Reason that is only recorded."""

    t: NDArray[np.int64]
    kind: NDArray[np.int8]
    row: NDArray[np.int64]
    verdict: NDArray[np.int8]


class Recorder(NamedTuple):
    """Output arrays, filled from ``filled`` = (states, decisions) on; an event met AGAIN needs a row of them to itself.

    States: t (N,), nav (N, 16) and sigma_state (N, 15) without the wheel scale, pose_cov (N, 6, 6), health (N, 2) int8:
    Health and Cause, levels (N, 5) int8. Decisions: event (M,) index of the event; sensor, reason, dof (M,) int8;
    innovation, sigma (M, 3); scores (M, 5): NIS, threshold, metres moved, yaw moved, weight. axes_var: of
    Parameters.
    """

    filled: NDArray[np.int64]
    t: NDArray[np.int64]
    nav: Floats
    pose_cov: Floats
    sigma_state: Floats
    health: NDArray[np.int8]
    levels: NDArray[np.int8]
    event: NDArray[np.int64]
    sensor: NDArray[np.int8]
    reason: NDArray[np.int8]
    dof: NDArray[np.int8]
    innovation: Floats
    sigma: Floats
    scores: Floats
    axes_var: float


def new_recorder(states: int, decided: int, axes_var: float = 0.0) -> Recorder:
    """Empty output arrays for so many states and decisions."""
    return Recorder(
        filled=np.zeros(2, np.int64),
        t=np.zeros(states, np.int64),
        nav=np.zeros((states, 16)),
        pose_cov=np.zeros((states, 6, 6)),
        sigma_state=np.zeros((states, 15)),
        health=np.zeros((states, 2), np.int8),
        levels=np.zeros((states, 5), np.int8),
        event=np.zeros(decided, np.int64),
        sensor=np.zeros(decided, np.int8),
        reason=np.zeros(decided, np.int8),
        dof=np.zeros(decided, np.int8),
        innovation=np.empty((decided, 3)),
        sigma=np.empty((decided, 3)),
        scores=np.empty((decided, 5)),
        axes_var=axes_var,
    )
