"""Tunable numbers of what is measured: IMU, GNSS, pose fixes, and what a land vehicle's motion shows."""

from typing import Annotated

import msgspec

from sensors.bounds import Fraction, NonNegative, Positive, RateHz


class ImuNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the datasheet figures become process noise."""

    noise_scale: NonNegative = 1.5
    """White noise of gyro and accelerometer, times the datasheet's (vibration, quantization), -."""
    temperature_walk_k: NonNegative = 0.2
    """How the IMU's temperature changes, which moves its biases: random walk, K/sqrt(s)."""
    spike_rate_deg: Positive = 30.0
    """A rate that differs by more from the sample before and the one after is a spike, and not used, deg/s."""
    spike_force: Positive = 50.0
    """The same for the specific force, m/s^2."""
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
    inflation: Positive = 1.0
    """Position variance is multiplied by this, -."""
    white_share: Fraction = 0.7
    """Share of that variance which may be white, -."""
    lasting_share: Fraction = 0.7
    """Share of it which may last (reflections, atmosphere, orbits): a state. Which of both it is nobody tells, so they
    may add up to more than 1; 0 with a white share of 1: all is white, -."""
    lasting_s: Positive = 30.0
    """Correlation time of that share, s."""
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
    inflation: Positive = 1.0
    """The fix's covariance is multiplied by this, -."""
    white_share: Fraction = 0.7
    """Share of that covariance which may be white, -."""
    lasting_share: Fraction = 0.7
    """Share of it which may be bound to the place (map and features): a state; 0: none, -."""
    lasting_m: Positive = 300.0
    """Correlation length of that share along the road, m."""
    yaw_offset_sigma_deg: NonNegative = 0.1
    """Constant yaw error of pose fixes (camera against body, as calibration leaves it): a state; 0: none, deg."""
    sigma_floor_m: NonNegative = 0.02
    """Smallest sigma along any direction of the plane, m."""
    sigma_floor_yaw_deg: NonNegative = 0.05
    """Smallest sigma of yaw, deg."""
    step_m: NonNegative = 0.0
    """Step of the finest lattice of a matcher whose fixes are not calibrated: step^2/12 adds to their variances, m."""
    step_deg: NonNegative = 0.0
    """The same, yaw, deg."""
    max_sigma_longitudinal_m: Positive = 0.33
    """Covariance gate: a direction that the fix knows no better than this (half a flat window's variance at the finest
    level) is not observed, and dropped, m."""
    max_sigma_lateral_m: Positive = 0.33
    """The same, lateral, m."""
    max_sigma_yaw_deg: Positive = 0.33
    """The same, yaw, deg."""
    partial: bool = True
    """Use the observed directions of a fix where others are not; else such a fix is rejected whole."""
    modes: bool = True
    """Where a fix tells two modes of its posterior, use only what they agree on."""


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
    still_wait_s: NonNegative = 5.0
    """So long after a start the vehicle is not taken to stand: its speed is known too badly to tell a creep, s."""
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
    wheel_inflation: Positive = 1.0
    """The variance of wheel speeds is multiplied by this: their errors last over many of them, -."""
    wheel_slip: NonNegative = 0.05
    """Slip of the wheels (one sigma, lasting errors included) for every m/s^2 of acceleration or braking, s^2/m."""
    wheel_scale_sigma: NonNegative = 0.01
    """Scale error of the wheel speed before anything is known of it (tyre radius); it is estimated, -."""
    wheel_scale_walk: NonNegative = 0.003
    """Random walk of that scale error (tyres warm up, loads change), 1/sqrt(h)."""
