"""Every tunable number of the filter: a default, a unit, one line of meaning (of sensors: ``fusion.sensor_models``)."""

import math
from typing import Annotated, Literal

import msgspec

from fusion.sensor_models import GnssModel, ImuNoise, MotionModel, PoseModel
from sensors.bounds import NonNegative, Positive, RateHz
from sensors.errors import EgolocError

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
    lasting_sigmas: Positive = 5.0
    """Where an error that lasts would have to be so many of its own sigmas its sensor contradicts the rest, -."""
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
