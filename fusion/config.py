"""Every tunable number of the filter: a default, a unit, one line of meaning."""

import math
from typing import Annotated

import msgspec

from sensors.bounds import NonNegative, Positive, RateHz
from sensors.errors import EgolocError

_NOT_ZERO = {
    "output_hz",
    "rate_hz",
    "window_s",
    "first_window_s",
    "still_window_s",
    "max_gap_s",
    "max_sigma_longitudinal_m",
    "max_sigma_lateral_m",
    "max_sigma_yaw_deg",
}


class ImuNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the datasheet figures become process noise."""

    noise_scale: NonNegative = 2.0
    """White noise of gyro and accelerometer, times the datasheet's (vibration, quantization), -."""
    max_gap_s: Positive = 0.5
    """A longer pause in the IMU is a gap: P widens, no motion updates, s."""
    max_bridge_s: Positive = 3.0
    """A gap up to this long is bridged along straight lines of rate and force, a longer one at constant velocity, s."""
    coast_accel: Positive = 3.0
    """Random walk of velocity in a gap, m/s/sqrt(s)."""
    coast_rate_deg: Positive = 20.0
    """Random walk of yaw in a gap (a tenth of it tilts), deg/sqrt(s)."""


class GnssModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """GNSS positions, velocities and dual-antenna yaw."""

    use: bool = True
    """Apply GNSS at all."""
    min_status: Annotated[int, msgspec.Meta(ge=1, le=4)] = 1
    """Lowest status that is applied: 1 single, 2 DGNSS, 3 float, 4 fixed."""
    sigma_floor_horizontal_m: NonNegative = 0.02
    """Receivers claim 3 mm; below this a correct fix would be gated for ever, m."""
    sigma_floor_vertical_m: NonNegative = 0.05
    """The same, vertical, m."""
    sigma_floor_velocity: NonNegative = 0.03
    """The same for velocity, m/s."""
    inflation: Positive = 4.0
    """Position variance is multiplied by this: RTK errors are correlated in time, -."""
    velocity_inflation: Positive = 1.0
    """Velocity variance is multiplied by this, -."""
    use_velocity: bool = True
    """Apply GNSS velocities."""
    yaw_sigma_floor_deg: Positive = 0.2
    """Smallest sigma of a dual-antenna yaw, deg."""


class PoseModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """EgoVM's pose fixes."""

    use: bool = True
    """Apply pose fixes at all."""
    inflation: Positive = 4.0
    """The fix's covariance is multiplied by this: errors of map and features last over many frames, -."""
    sigma_floor_m: NonNegative = 0.02
    """Smallest sigma along any direction of the plane, m."""
    sigma_floor_yaw_deg: NonNegative = 0.05
    """Smallest sigma of yaw, deg."""
    max_sigma_longitudinal_m: Positive = 0.47
    """Covariance gate: a direction with more than this (inflated) is not observed by the histogram, and dropped, m."""
    max_sigma_lateral_m: Positive = 0.47
    """The same, lateral, m."""
    max_sigma_yaw_deg: Positive = 0.66
    """The same, yaw (half a flat window's variance): at rest there is no other yaw to start with, deg."""


class MotionModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a land vehicle cannot do: slip sideways, fly, or move while it stands."""

    non_holonomic: bool = True
    """Apply zero lateral and vertical velocity of the rear axle."""
    zero_velocity: bool = True
    """Apply zero velocity and zero rate while the IMU shows that the vehicle stands."""
    rate_hz: RateHz = 10.0
    """How often these are applied, Hz."""
    lateral_sigma: Positive = 0.05
    """Lateral velocity of the rear axle at each update, at least, m/s."""
    vertical_sigma: Positive = 0.1
    """Vertical velocity of the rear axle at each update, at least, m/s."""
    sigma_per_speed: NonNegative = 0.0
    """Growth of both with speed, m/s per m/s."""
    unknown_sigma: Positive = 0.3
    """Both, before the drive has shown how the rear axle moves, m/s."""
    learning_s: NonNegative = 4.0
    """That is learned from means over so long while the place is known (slip lasts for a curve); 0: it is not, s."""
    min_speed: NonNegative = 2.0
    """Below this speed the non-holonomic update waits, m/s."""
    still_window_s: Positive = 1.0
    """Window over which the IMU must be quiet, s."""
    still_accel: NonNegative = 0.25
    """Largest standard deviation of the acceleration's norm at rest, m/s^2."""
    still_rate_deg: NonNegative = 0.3
    """Largest standard deviation of the yaw rate at rest (idling shakes the other two), deg/s."""
    still_drift: Positive = 0.08
    """Largest change of the horizontal force at rest, last quarter of the window against the rest (a smooth start hides
    from the norm), and largest acceleration, besides three sigmas of what is known of tilt and bias, m/s^2."""
    still_ratio: Positive = 4.0
    """And at most so many times the deviations of the quietest window so far: a queue creeps smoothly, -."""
    still_max_speed: NonNegative = 0.3
    """Above this estimated speed (plus three sigmas) the vehicle is not taken to stand, m/s."""
    zero_velocity_sigma: Positive = 0.05
    """Velocity at rest, m/s."""
    zero_rate_sigma_deg: Positive = 0.1
    """Turn rate at rest, besides the gyro's noise, deg/s."""
    wheel: bool = True
    """Apply wheel speeds."""
    wheel_scale_sigma: NonNegative = 0.01
    """Scale error of the wheel speed before anything is known of it (tyre radius); it is estimated, -."""
    wheel_scale_walk: NonNegative = 0.001
    """Random walk of that scale error (tyres warm up, loads change), 1/sqrt(h)."""


class Gates(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Chi-square gate on innovations."""

    probability: Annotated[float, msgspec.Meta(ge=0.5, lt=1.0)] = 0.9999
    """Probability that a correct measurement passes, -."""
    use: bool = True
    """Gate at all."""
    outvoted: Annotated[int, msgspec.Meta(ge=1)] = 20
    """So many GNSS positions and pose fixes, rejected in a row while they agree, outvote the state, -."""


class Alignment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the first state is found."""

    window_s: Positive = 1.0
    """IMU window that is averaged for levelling, s."""
    first_window_s: Positive = 0.08
    """While the IMU has not run for a whole window yet, so much of it will do (ten samples at least), s."""
    min_course_speed: NonNegative = 3.0
    """GNSS course becomes yaw above this speed, m/s."""
    max_course_sigma_deg: Positive = 10.0
    """A course known worse than this is no yaw, deg."""
    course_sigma_deg: NonNegative = 2.0
    """Added to the course's own sigma: side slip and mounting, deg."""
    level_sigma_deg: Positive = 1.0
    """Roll and pitch after levelling, deg."""


class FusionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole filter."""

    output_hz: RateHz = 10.0
    """Rate of the recorded states, Hz."""
    imu: ImuNoise = ImuNoise()
    gnss: GnssModel = GnssModel()
    pose: PoseModel = PoseModel()
    motion: MotionModel = MotionModel()
    gates: Gates = Gates()
    alignment: Alignment = Alignment()


def check(config: msgspec.Struct, path: str = "fusion") -> None:
    """Raise EgolocError naming the first number that the filter cannot run with."""
    for name in config.__struct_fields__:
        value, key = getattr(config, name), f"{path}.{name}"
        if isinstance(value, msgspec.Struct):
            check(value, key)
        elif name == "probability" and not 0.5 <= value < 1.0:
            raise EgolocError(f"config: {key}: expected 0.5..1, got {value}")
        elif not 0.0 <= value < math.inf or (value == 0.0 and name in _NOT_ZERO):
            raise EgolocError(f"config: {key}: expected a number above zero, got {value}")
