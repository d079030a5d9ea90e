"""What the kernel reads and writes: parameters, measurement columns, events and recorded decisions."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion._linalg import Vector
from fusion.covariance import Noise
from fusion.state import Floats

MOTION = 100
"""Event: see whether the vehicle stands, then apply zero velocity or the non-holonomic constraint."""
OUTPUT = 101
"""Event: record the state."""


class Parameters(NamedTuple):
    """The configuration in SI units, as the kernel reads it."""

    noise: Noise
    increments: bool
    max_gap_ns: int
    bridge_ns: int
    coast_accel: float
    coast_rate: float
    gate: Vector
    """Chi-square thresholds for 1, 2 and 3 degrees of freedom."""
    outvoted: int
    """So many agreeing rejections of GNSS positions and pose fixes outvote the state."""
    gnss_arm: Vector
    pose_arm: Vector
    axle: Vector
    pose_limits: Vector
    """Largest observed sigma along, left and in yaw."""
    zero_velocity: bool
    non_holonomic: bool
    lateral_var: float
    vertical_var: float
    per_speed: float
    learning_ticks: int
    unknown_var: float
    min_speed: float
    still_window_ns: int
    still_ratio: float
    still_accel_var: float
    still_rate_var: float
    still_drift_var: float
    still_max_speed: float
    zero_velocity_var: float
    zero_rate_var: float


class Measurements(NamedTuple):
    """Columns of each sensor with the covariances that the filter uses (floors and inflation applied).

    gnss_llh (N, 3), gnss_cov (N, 3, 3) ENU; vel (N, 3), vel_cov (N, 3, 3); yaw, yaw_var (N,); pose_llh (N, 3),
    pose_yaw (N,) from east, pose_tilt (N, 2), pose_cov (N, 3, 3) in (east, north, yaw); wheel, wheel_var (N,).
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
    wheel: Floats
    wheel_var: Floats


class Events(NamedTuple):
    """What happens when, sorted: t (M,) ns; kind (M,) Sensor, MOTION or OUTPUT; row (M,) into its sensor's columns;
    verdict (M,) int8: -1 to apply, else the Reason that is only recorded."""

    t: NDArray[np.int64]
    kind: NDArray[np.int8]
    row: NDArray[np.int64]
    verdict: NDArray[np.int8]


class Recorder(NamedTuple):
    """Output arrays, filled from ``filled`` = (states, decisions) on.

    States: t (N,), nav (N, 16) and sigma_state (N, 15) without the wheel scale, pose_cov (N, 6, 6). Decisions: event
    (M,) index of the event; sensor, reason, dof (M,) int8; innovation, sigma (M, 3); scores (M, 4): NIS, threshold,
    metres moved, yaw moved.
    """

    filled: NDArray[np.int64]
    t: NDArray[np.int64]
    nav: Floats
    pose_cov: Floats
    sigma_state: Floats
    event: NDArray[np.int64]
    sensor: NDArray[np.int8]
    reason: NDArray[np.int8]
    dof: NDArray[np.int8]
    innovation: Floats
    sigma: Floats
    scores: Floats


def new_recorder(states: int, decided: int) -> Recorder:
    """Empty output arrays for so many states and decisions."""
    return Recorder(
        filled=np.zeros(2, np.int64),
        t=np.zeros(states, np.int64),
        nav=np.zeros((states, 16)),
        pose_cov=np.zeros((states, 6, 6)),
        sigma_state=np.zeros((states, 15)),
        event=np.zeros(decided, np.int64),
        sensor=np.zeros(decided, np.int8),
        reason=np.zeros(decided, np.int8),
        dof=np.zeros(decided, np.int8),
        innovation=np.empty((decided, 3)),
        sigma=np.empty((decided, 3)),
        scores=np.empty((decided, 4)),
    )
