"""Rest against smooth motion: what the norm of the force does not show; and what is learned of the rear axle."""

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.events import Parameters
from fusion.motion import PRIOR_BLOCKS, REMEMBERED, learn, learned
from fusion.result import FusionResult, Reason, Sensor
from fusion.run import run
from fusion.timeline import parameters
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, sense
from sensors.simulate.imu_presets import PRESETS
from sensors.simulate.trajectory import KNOT_S, Profile, Truth
from tests.fusion.scenes import only, with_outage

Floats = NDArray[np.float64]
START_NS = 1_715_673_600_000_000_000


def straight(speed_at: Floats, seconds: float) -> Drive:
    """A level line at a speed given every KNOT_S, with a consumer IMU whose accelerometer has no scale errors."""
    none = np.zeros(round(seconds / KNOT_S) + 20)
    speed = np.concatenate((speed_at, np.full(max(len(none) - len(speed_at), 0), speed_at[-1])))[: len(none)]
    truth = Truth(Profile(-2.0, speed, none + 0.7, none, none), (0.84, 0.2, 560.0), START_NS)
    imu = msgspec.structs.replace(PRESETS["consumer"].spec, accel_scale_ppm=0.0, accel_misalignment_deg=0.0)
    clean = scenarios.load("clean")
    config = msgspec.structs.replace(clean, vehicle=msgspec.structs.replace(clean.vehicle, imu=imu))
    return sense(truth, seconds, 42, config)


def speed_at_rest(drive: Drive, result: FusionResult) -> Floats:
    """True speed wherever zero velocity was applied, m/s."""
    decided = result.decisions
    applied = (decided.sensor == Sensor.ZERO_VELOCITY) & (decided.reason == Reason.ACCEPTED)
    found: Floats = np.linalg.norm(drive.truth.at(decided.t_ns[applied]).vel_enu, axis=1)
    return found


def after_rest(acceleration: float) -> Drive:
    """Forty seconds at 8 m/s, a stop, ten seconds at rest, then away with an acceleration, m/s^2."""
    slow = np.maximum(8.0 - 2.0 * KNOT_S * np.arange(30), 0.0)
    away = np.minimum(acceleration * KNOT_S * np.arange(100), 8.0)
    return straight(np.concatenate((np.full(80, 8.0), slow, np.zeros(14), away)), 80.0)


@pytest.mark.parametrize("acceleration", [0.3, 0.5, 1.5])
def test_a_smooth_start_is_not_taken_for_rest(acceleration: float) -> None:
    """GNSS is hidden from before the stop on; gravity hides the start from the norm of the force."""
    drive = after_rest(acceleration)
    result = run(only(with_outage(drive.log, 38.0, 60.0), "gnss", "gnss_velocity"), FusionConfig())
    speed = speed_at_rest(drive, result)
    assert (speed == 0.0).sum() > 50
    assert speed.max() < 0.25 * max(acceleration, 0.5)


def test_steady_braking_is_not_taken_for_rest() -> None:
    """Speed known to metres per second only, and the force as steady as at rest: it is not gravity's alone."""
    slow = np.maximum(14.0 - 0.5 * KNOT_S * np.arange(80), 0.0)
    drive = straight(np.concatenate((np.full(80, 14.0), slow)), 80.0)
    log = only(with_outage(drive.log, 12.0, 75.0), "gnss", "gnss_velocity")
    default = FusionConfig()
    blind = msgspec.structs.replace(default, motion=msgspec.structs.replace(default.motion, still_drift=100.0))
    assert speed_at_rest(drive, run(log, blind)).max() > 1.0, "this drive is meant to mislead who looks at noise only"
    speed = speed_at_rest(drive, run(log, default))
    assert (speed == 0.0).sum() > 30
    assert speed.max() < 0.2


def par(**changed: float) -> Parameters:
    config = FusionConfig()
    motion = msgspec.structs.replace(config.motion, **changed)
    return parameters(scenarios.load("clean").vehicle, msgspec.structs.replace(config, motion=motion))


def taught(residuals: Floats, *, placed: bool = True) -> Floats:
    slipped, ticks = np.zeros((3, 2)), par().learning_ticks
    for residual in residuals:
        learn(slipped, residual, ticks, placed)
    return slipped


def test_what_lasts_counts_and_what_is_white_averages_out() -> None:
    """Lateral 0.2 m/s that changes sign from block to block, vertical white noise of the same size."""
    p = par(learning_s=4.0, rate_hz=10.0, unknown_sigma=0.3)
    n = 40 * 30
    lateral = 0.2 * np.sign(np.sin(np.pi * (np.arange(n) + 0.5) / 40))
    vertical = np.random.default_rng(3).normal(0.0, 0.2, n)
    slipped = taught(np.column_stack((lateral, vertical, np.zeros(n))))
    assert slipped[2].tolist() == [0.0, 30.0]
    lasting = (PRIOR_BLOCKS * 0.09 + 30 * 40 * 0.04) / (PRIOR_BLOCKS + 30)
    assert learned(slipped, 0, p) == pytest.approx(lasting, rel=1e-9)
    assert learned(slipped, 1, p) == pytest.approx((PRIOR_BLOCKS * 0.09 + 30 * 0.04) / (PRIOR_BLOCKS + 30), rel=0.3)


def test_old_blocks_are_forgotten() -> None:
    p = par(learning_s=4.0, rate_hz=10.0)
    rough, smooth = np.tile((0.4, 0.0, 0.0), (40 * 60, 1)), np.zeros((40 * 240, 3))
    before, after = (learned(taught(r), 0, p) for r in (rough, np.concatenate((rough, smooth))))
    assert after < 0.05 * before
    assert taught(np.concatenate((rough, smooth)))[2, 1] == REMEMBERED


def test_nothing_is_learned_while_the_place_is_not_known() -> None:
    assert not taught(np.ones((400, 3)), placed=False).any()
    half = taught(np.ones((39, 3)))
    learn(half, np.ones(3), 40, False)  # a block must not go on where GNSS was away
    assert half[2].tolist() == [0.0, 0.0]


def test_a_drive_that_slips_widens_the_constraint() -> None:
    """The IMU turned by two degrees against the vehicle: 0.28 m/s sideways at 8 m/s, more than unknown_sigma can be."""
    drive = after_rest(1.0)
    log = only(drive.log, "gnss", "gnss_velocity")
    assert log.imu is not None
    c, s = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = type(log.imu)(log.imu.t_ns, log.imu.arrival_ns, log.imu.gyro @ R.T, log.imu.accel @ R.T)
    sigmas = []
    for imu in (log.imu, turned):
        decided = run(type(log)(imu, log.gnss, log.gnss_velocity, vehicle=log.vehicle), FusionConfig()).decisions
        rows = np.flatnonzero(decided.sensor == Sensor.NON_HOLONOMIC)
        sigmas.append(float(decided.innovation_sigma[rows[-1], 0]))
    assert sigmas[1] > 1.5 * sigmas[0]
