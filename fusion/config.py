"""Every tunable number of the filter: a default, a unit, one line of meaning."""

import math
from typing import Annotated, Literal

import msgspec

from sensors.bounds import NonNegative, Positive, RateHz
from sensors.errors import EgolocError

Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
KERNELS = ("none", "huber", "cauchy")
"""Robust kernels."""
_NOT_ZERO = {
    "white_share",
    "lasting_s",
    "lasting_m",
    "delay_sigma_s",
    "mounting_sigma_deg",
    "output_hz",
    "rate_hz",
    "window_s",
    "first_window_s",
    "still_window_s",
    "max_gap_s",
    "max_sigma_longitudinal_m",
    "max_sigma_lateral_m",
    "max_sigma_yaw_deg",
    "robust_sigmas",
}

LONGEST_HISTORY_S = 10.0
"""Of IMU samples and measurements to rewind over."""


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
    white_share: Share = 0.7
    """Share of that variance which may be white, -."""
    lasting_share: Share = 0.7
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
    white_share: Share = 0.7
    """Share of that covariance which may be white, -."""
    lasting_share: Share = 0.7
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


class Estimate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is estimated along with the state, each from its value in [vehicle] on (``fusion.calibration``)."""

    lever_arm: bool = False
    """The GNSS lever arm; its sigma is the vehicle's gnss_lever_arm_sigma_m."""
    lever_arm_sigma_m: NonNegative = 0.5
    """Sigma of each axis where the vehicle's is 0; 0: the arm is known then, m."""
    gyro: bool = False
    """Scale and misalignment of the gyro about the vertical axis, where the vehicle's IMU has no sigmas for them."""
    gyro_scale_sigma_ppm: NonNegative = 3000.0
    """Sigma of that scale error before anything is known of it, ppm."""
    gyro_misalignment_sigma_deg: NonNegative = 0.2
    """The same of the misalignment, deg."""
    gyro_misalignment_from_deg: NonNegative = 0.05
    """The vehicle's IMU: from here on its gyro's misalignment is estimated in any case; a smaller one harms nothing but
    roll and pitch themselves, and is added to what is stated of them, deg."""
    mounting: bool = False
    """Pitch and yaw of the vehicle's axes against the body's, which the non-holonomic constraint needs."""
    mounting_sigma_deg: Positive = 1.0
    """Sigma of both before anything is known of them, deg."""
    gnss_delay: bool = False
    """By how much GNSS is older than its corrected stamp."""
    pose_delay: bool = False
    """The same of pose fixes."""
    delay_sigma_s: Positive = 0.05
    """Sigma of both before anything is known of them, s."""


class Gates(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Chi-square gate on innovations, and how much counts what passes it."""

    probability: Annotated[float, msgspec.Meta(ge=0.5, lt=1.0)] = 0.9999
    """Probability that a correct measurement passes, -."""
    use: bool = True
    """Gate at all."""
    outvoted: Annotated[int, msgspec.Meta(ge=1)] = 20
    """So many GNSS positions and pose fixes, rejected in a row while they agree, outvote the state, -."""
    streak: Annotated[int, msgspec.Meta(ge=1)] = 10
    """After so many pose fixes that were rejected in a row and say the same, the next one like them must be explained
    well, -."""
    reentry: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.5
    """How well: this share of correct measurements has an innovation as small, -."""
    robust: Literal["none", "huber", "cauchy"] = "none"
    """Robust kernel on what passes the gate."""
    robust_sigmas: Positive = 1.0
    """Residual from which on it takes effect, root mean square over the components, standard deviations."""


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


class HealthModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When the filter counts as healthy, degraded, dead reckoning or diverged, and when it starts again."""

    gnss_stale_s: Positive = 3.0
    """GNSS without a usable measurement for longer is stale, s."""
    pose_stale_s: Positive = 1.5
    """The same for pose fixes, s."""
    wheel_stale_s: Positive = 1.0
    """The same for the wheel, s."""
    suspect_count: Annotated[int, msgspec.Meta(ge=1)] = 5
    """A sensor is suspect when so many more of its measurements were not explained by the state than were, -."""
    dead_reckoning_s: Positive = 3.0
    """Without an applied position for longer the filter is dead reckoning, s."""
    recovered_s: NonNegative = 10.0
    """So long after its return from dead reckoning or divergence the filter is recovered, not yet healthy, s."""
    max_sigma_m: Positive = 3.0
    """A larger stated horizontal sigma is degraded, m."""
    max_sigma_yaw_deg: Positive = 5.0
    """The same for yaw, deg."""
    lost_s: Positive = 10.0
    """Over so long or longer no position was explained by the state: diverged, s."""
    lost_count: Annotated[int, msgspec.Meta(ge=1)] = 10
    """And over so many positions or more, -."""
    contradicted_s: Positive = 1.5
    """Positions of two sensors need contradict the state for no longer than this to call it diverged, s."""
    settled_s: NonNegative = 30.0
    """So long after it gave way to one sensor alone, or to two again, the filter is degraded (unsettled), s."""
    max_speed: Positive = 150.0
    """A land vehicle that is faster has diverged, m/s."""
    max_tilt_deg: Positive = 60.0
    """A land vehicle that is tilted further has diverged, deg."""
    blown_sigma_m: Positive = 1000.0
    """With a larger stated horizontal sigma the filter has diverged, m."""
    blown_sigma_yaw_deg: Positive = 60.0
    """The same for yaw, deg."""
    restart: bool = True
    """Align anew when the filter has diverged and a position comes that shows it."""
    restart_pause_s: NonNegative = 10.0
    """Not within so long after a start, times the number of starts: what is wrong may be the IMU, s."""
    alone_s: Positive = 60.0
    """One sensor alone weighs more than a state that no explained position has held for so long, s."""
    wide_sigma_yaw_deg: Positive = 10.0
    """Or at once where the yaw was known worse than this just before: updates are no longer linear, deg."""
    far_m: Positive = 10.0
    """Pose fixes alone, or two sensors that agree only roughly, must contradict the state by more than this, m."""


class FusionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole filter."""

    output_hz: RateHz = 10.0
    """Rate of the recorded states, Hz."""
    order: Literal["stamp", "arrival"] = "stamp"
    """stamp: measurements are applied by when they were true; arrival: by when they came, late ones by rewinding."""
    history_s: Annotated[float, msgspec.Meta(gt=0, le=LONGEST_HISTORY_S)] = 1.0
    """Arrival order: a measurement that comes later than this is not applied, s."""
    imu: ImuNoise = ImuNoise()
    gnss: GnssModel = GnssModel()
    pose: PoseModel = PoseModel()
    motion: MotionModel = MotionModel()
    estimate: Estimate = Estimate()
    gates: Gates = Gates()
    alignment: Alignment = Alignment()
    health: HealthModel = HealthModel()


def check(config: msgspec.Struct, path: str = "fusion") -> None:
    """Raise EgolocError naming the first number that the filter cannot run with."""
    for name in config.__struct_fields__:
        value, key = getattr(config, name), f"{path}.{name}"
        if isinstance(value, msgspec.Struct):
            check(value, key)
        elif name == "order":
            if value not in ("stamp", "arrival"):
                raise EgolocError(f'config: {key}: expected "stamp" or "arrival", got {value!r}')
        elif name == "history_s" and not 0.0 < value <= LONGEST_HISTORY_S:
            raise EgolocError(f"config: {key}: expected a number above 0 and up to {LONGEST_HISTORY_S:g}, got {value}")
        elif name == "robust":
            if value not in KERNELS:
                raise EgolocError(f"config: {key}: expected {', '.join(KERNELS)}, got {value!r}")
        elif name == "probability" and not 0.5 <= value < 1.0:
            raise EgolocError(f"config: {key}: expected 0.5..1, got {value}")
        elif name == "reentry" and not 0.0 < value < 1.0:
            raise EgolocError(f"config: {key}: expected a number between 0 and 1, got {value}")
        elif not 0.0 <= value < math.inf or (value == 0.0 and name in _NOT_ZERO):
            raise EgolocError(f"config: {key}: expected a number above zero, got {value}")
