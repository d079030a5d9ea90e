"""The default filter on sensors that fail: not lost, not led astray, and back if it was."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion.config import FusionConfig, Gates, HealthModel
from fusion.filter import Localizer
from fusion.result import Reason, Sensor
from fusion.run import run
from fusion.state import E_WHEEL_SCALE, WHEEL_SCALE
from sensors.records import GnssStatus, Log
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, DriveConfig, simulate_drive
from sensors.simulate.wheel import WheelSimulation
from tests.fusion.free import Floats
from tests.fusion.rough import LIMITS, fused_errors, off, rough_drive
from tests.fusion.scenes import seconds, with_outage, without

STUBBORN = FusionConfig(gates=Gates(outvoted=10**9), health=HealthModel(restart=False))
"""Nothing outvotes its state."""


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Three minutes of city, GNSS and pose fixes throughout."""
    return simulate_drive(180.0, 100_007, scenarios.load("clean"))


def moving_at(drive: Drive, least: float) -> float:
    """Seconds at which the vehicle begins to be faster than this for twenty seconds."""
    assert drive.log.imu is not None
    t = drive.log.imu.t_ns[6000:-6000:100]
    speed = np.linalg.norm(drive.truth.at(t).vel_enu, axis=1)
    for i in range(len(t) - 20):
        if (speed[i : i + 20] > least).all():
            return float(seconds(drive.log, t[i : i + 1])[0])
    raise AssertionError("this drive is meant to be faster")


def late(drive: Drive, config: FusionConfig, log: Log, after_s: float) -> tuple[Floats, Floats]:
    """Seconds and errors of the states from after_s on."""
    result = run(log, config)
    s = seconds(log, result.states.t_ns)
    return s[s > after_s], fused_errors(result, drive)[s > after_s]


@pytest.mark.parametrize("seed", [100_100, 100_114, 100_133])
def test_rough_drives_stay_within_the_limits(seed: int) -> None:
    """Ten minutes with outages, wrong fixes, multipath, aliases, bursts and blind stretches: never out of the limits,
    from two tenths of a second on, and better than the pose fixes on every axis."""
    drive, pose_errors = rough_drive(600.0, seed)
    result = run(drive.log)
    errors = fused_errors(result, drive)
    pose = np.abs(pose_errors) * [1.0, 1.0, np.degrees(1.0)]
    good = (pose < LIMITS).all(axis=1)
    fused, sensor = np.abs(errors).mean(axis=0), pose[good].mean(axis=0)
    most = np.abs(errors).max(axis=0)
    print(f"{seed}: MAE {fused.round(4)}, of the good pose fixes {sensor.round(4)}; largest {most.round(3)}")
    assert 0.0 < 1.0 - good.mean() < 0.1
    assert seconds(drive.log, result.states.t_ns[:1])[0] <= 0.2
    assert (np.abs(errors) < LIMITS).all()
    assert (fused < sensor).all()


def test_a_wrong_fix_after_an_outage_is_not_followed(drive: Drive) -> None:
    log = with_outage(drive.log, 60.0, 20.0)
    log = replace(log, pose_fixes=drive.log.pose_fixes)
    assert log.gnss is not None
    s = seconds(log, log.gnss.t_ns)
    log = replace(
        log, gnss=off(log.gnss, (s > 79.0) & (s < 120.0), np.array([0.8, -0.6, 1.0]), GnssStatus.FIXED, 0.015)
    )
    result = run(log)
    assert np.abs(fused_errors(result, drive)[:, :2]).max() < 0.25
    rows = result.decisions.sensor == Sensor.GNSS_POSITION
    s = seconds(log, result.decisions.t_ns[rows])
    assert (result.decisions.reason[rows][(s > 79.0) & (s < 120.0)] == Reason.CHI_SQUARE).mean() > 0.95
    assert (result.decisions.reason[rows][s > 125.0] == Reason.ACCEPTED).mean() > 0.95


def test_reflections_that_upset_position_and_velocity(drive: Drive) -> None:
    """The velocity alone would pass its gate, and take the state four metres away from right pose fixes."""
    log = replace(drive.log, wheel=None)
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    begin = moving_at(drive, 5.0)
    s = seconds(log, log.gnss.t_ns)
    inside = (s > begin) & (s < begin + 30.0)
    gnss = off(log.gnss, inside, np.array([2.0, -1.5, 3.0]), GnssStatus.FIXED, 0.02)
    s = seconds(log, log.gnss_velocity.t_ns)
    inside = (s > begin) & (s < begin + 30.0)
    velocity = log.gnss_velocity.vel_enu + np.where(inside[:, None], [0.12, -0.09, 0.045], 0.0)
    result = run(replace(log, gnss=gnss, gnss_velocity=replace(log.gnss_velocity, vel_enu=velocity)))
    assert np.abs(fused_errors(result, drive)[:, :2]).max() < 0.2
    decisions = result.decisions
    rows = decisions.sensor == Sensor.GNSS_VELOCITY
    s = seconds(log, decisions.t_ns[rows])
    inside = (s > begin + 0.1) & (s < begin + 30.0)
    assert (decisions.reason[rows][inside] == Reason.RECEIVER).mean() > 0.99
    assert (decisions.reason[rows][~inside] == Reason.RECEIVER).mean() < 0.01
    assert (decisions.reason[decisions.sensor == Sensor.POSE_FIX] == Reason.CHI_SQUARE).mean() < 0.01


def led_astray(drive: Drive) -> tuple[Log, float]:
    """A wheel that reads more and more, up to 0.7 m/s, without GNSS and pose fixes; when they return."""
    begin, length = moving_at(drive, 5.0), 15.0
    log = with_outage(drive.log, begin, length)
    assert log.wheel is not None
    s = seconds(log, log.wheel.t_ns)
    ramp = 0.05 * (s - begin) * ((s > begin) & (s < begin + length))
    return replace(log, wheel=replace(log.wheel, speed=log.wheel.speed + ramp)), begin + length


def test_two_sensors_that_agree_outvote_the_state(drive: Drive) -> None:
    """Metres off after a fault that the covariance knows nothing of: back within three seconds, else lost for good."""
    log, returned = led_astray(drive)
    s, errors = late(drive, FusionConfig(), log, returned)
    assert np.abs(errors[s < returned + 0.3, 0]).max() > 2.0
    assert (np.abs(errors[s > returned + 3.0]) < LIMITS).all()
    s, errors = late(drive, STUBBORN, log, returned)
    assert np.hypot(*errors[s > returned + 3.0, :2].T).min() > 1.0


@pytest.mark.parametrize("alone", ["gnss", "pose_fixes"])
def test_one_sensor_alone_outvotes_nothing(drive: Drive, alone: str) -> None:
    """Right as it is: a wrong fix or an alias would look the same."""
    log, returned = led_astray(drive)
    other = "pose_fixes" if alone == "gnss" else "gnss"
    log = replace(log, **{other: without(getattr(log, other), log, returned - 20.0, returned + 20.0)})
    s, errors = late(drive, FusionConfig(), log, returned)
    assert np.hypot(*errors[s < returned + 10.0, :2].T).min() > 1.0
    assert (np.abs(errors[s > returned + 24.0]) < LIMITS).all()


def test_wrong_sensors_that_disagree_outvote_nothing(drive: Drive) -> None:
    """A wrong fix and a lane alias at once, ten seconds long, on opposite sides."""
    log = drive.log
    assert log.gnss is not None
    assert log.pose_fixes is not None
    s = seconds(log, log.gnss.t_ns)
    gnss = off(log.gnss, (s > 70.0) & (s < 80.0), np.array([2.0, 2.0, 0.0]), GnssStatus.FIXED, 0.015)
    s = seconds(log, log.pose_fixes.t_ns)
    pose = log.pose_fixes.pose + np.where(((s > 70.0) & (s < 80.0))[:, None], [-2.5, -2.5, 0.0], 0.0)
    _, errors = late(
        drive, FusionConfig(), replace(log, gnss=gnss, pose_fixes=replace(log.pose_fixes, pose=pose)), 60.0
    )
    assert (np.abs(errors) < LIMITS).all()


@pytest.mark.parametrize(("seed", "rate", "slides_s"), [(100_007, 0.05, 12.0), (100_021, 0.08, 8.0)])
def test_a_state_that_gnss_pulled_off_and_left_holds_on_to_pose_fixes(seed: int, rate: float, slides_s: float) -> None:
    """GNSS slides aside and takes the state along, pose fixes explained by an error that lasts; then it jumps far off.
    Nothing agrees: the state stayed where it was left, for as long as that went on."""
    drive = simulate_drive(150.0, seed, scenarios.load("clean"))
    gnss = drive.log.gnss
    assert gnss is not None
    s = seconds(drive.log, gnss.t_ns)
    for step in np.arange(0.0, slides_s, 0.1):
        inside = (s >= 60.0 + step) & (s < 60.1 + step)
        gnss = off(gnss, inside, np.array([0.0, rate * step, 0.0]), GnssStatus.FIXED, 0.014)
    gone = (s >= 60.0 + slides_s) & (s < 100.0)
    gnss = off(gnss, gone, np.array([3.0, -2.5, 0.0]), GnssStatus.FIXED, 0.014)
    t, errors = late(drive, FusionConfig(), replace(drive.log, gnss=gnss), 60.0)
    far = np.hypot(errors[:, 0], errors[:, 1])
    assert far[t < 60.0 + slides_s].max() > 0.3  # it was pulled off
    assert far[t > 62.0 + slides_s].max() < 0.12


@pytest.mark.parametrize("frames", [1, 4])
def test_a_first_fix_that_gnss_contradicts_is_not_believed(drive: Drive, frames: int) -> None:
    log = drive.log
    assert log.pose_fixes is not None
    pose = log.pose_fixes.pose.copy()
    pose[1 : 1 + frames] += [2.0, -1.0, np.radians(7.0)]
    log = replace(log, pose_fixes=replace(log.pose_fixes, pose=pose))
    result = run(log)
    assert result.aligned_ns == log.pose_fixes.t_ns[1 + frames]
    assert (np.abs(fused_errors(result, drive)) < LIMITS).all()


def test_a_first_fix_that_gnss_goes_on_to_contradict_is_believed(drive: Drive) -> None:
    """Either may be wrong: the start is not put off for ever."""
    log = drive.log
    assert log.gnss is not None
    s = seconds(log, log.gnss.t_ns)
    log = replace(log, gnss=off(log.gnss, s < 30.0, np.array([3.0, 0.0, 0.0]), GnssStatus.FIXED, 0.015))
    result = run(log)
    assert result.aligned_ns is not None
    assert 1.0 < seconds(log, np.array([result.aligned_ns]))[0] < 1.5
    assert (np.abs(fused_errors(result, drive)) < LIMITS).all()


def test_a_start_from_a_long_burst_of_wrong_fixes_is_mended(drive: Drive) -> None:
    """Believed, since GNSS contradicts it for a second, and outvoted as soon as right fixes come; a yaw off by 9.6 deg
    puts the antenna and the camera a decimetre apart."""
    log = drive.log
    assert log.pose_fixes is not None
    pose = log.pose_fixes.pose.copy()
    pose[1:15] += [1.0, 1.7, np.radians(9.6)]
    log = replace(log, pose_fixes=replace(log.pose_fixes, pose=pose))
    result = run(log)
    assert result.aligned_ns is not None
    assert result.aligned_ns < log.pose_fixes.t_ns[15]
    _, errors = late(drive, FusionConfig(), log, 3.5)
    assert (np.abs(errors) < LIMITS).all()


@pytest.mark.parametrize("seed", [100_001, 100_002])
def test_the_wheels_scale_is_estimated(seed: int) -> None:
    """To a fifth of a per mille within its sigma, from GNSS and pose fixes while they are there."""
    scene: DriveConfig = scenarios.load("clean")
    scene = msgspec.structs.replace(scene, wheel=WheelSimulation(scale_sigma=0.01))
    drive = simulate_drive(240.0, seed, scene)
    log = drive.log
    assert log.wheel is not None
    forward = np.linalg.norm(drive.truth.at(log.wheel.t_ns).vel_enu, axis=1)
    fast = forward > 3.0
    true = float((log.wheel.speed[fast] / forward[fast]).mean() - 1.0)
    localizer = Localizer(log.vehicle, log.map_frame)
    for record in (log.gnss, log.gnss_velocity, log.pose_fixes, log.wheel, log.imu):
        assert record is not None
        localizer.push(record)
    assert localizer.core is not None
    sigma = float(np.sqrt(localizer.core.P[E_WHEEL_SCALE, E_WHEEL_SCALE]))
    found = float(localizer.core.nav[WHEEL_SCALE])
    print(f"wheel scale {true:.5f}, estimated {found:.5f} +- {sigma:.5f}")
    assert abs(true) > 0.001
    assert sigma < 0.0005
    assert abs(found - true) < 4 * sigma
