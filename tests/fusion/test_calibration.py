"""Constants with known errors are found within their sigmas; what a drive does not excite keeps its prior."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.blocks import see_delay
from fusion.calibration import EXCITED, estimates
from fusion.config import Estimate, FusionConfig, Gates
from fusion.filter import Localizer
from fusion.innovations import joint
from fusion.result import Estimated, Sensor
from fusion.run import Session, run
from fusion.sensor_models import ImuNoise
from fusion.state import Floats
from sensors.clock import NS_PER_S
from sensors.geodesy import enu_from_llh
from sensors.records import Log
from sensors.simulate.drive import sense, simulate, simulate_drive
from sensors.simulate.imu import ImuSimulation
from sensors.simulate.imu_presets import ImuFlaws
from sensors.simulate.scenarios import load
from sensors.simulate.trajectory import KNOT_S, Profile, Truth
from sensors.vehicle import Vehicle
from tests.fusion.scenes import only, with_outage

ALL = FusionConfig(estimate=Estimate(lever_arm=True, mounting=True, gyro=True, gnss_delay=True, pose_delay=True))
LATE_S = 0.08
TURNED = 1.0
SHOWN = {
    "wheel_scale": (2.0, 0.1),
    "gyro_scale": (3000.0, 1000.0),
    "gnss_arm_x": (0.5, 0.05),
    "gnss_arm_y": (0.0, 0.05),
    "mounting_pitch": (0.0, 0.1),
    "mounting_yaw": (0.0, 0.1),
    "gnss_delay": (LATE_S, 0.002),
    "pose_delay": (LATE_S, 0.002),
}
"""What is true of a spoiled drive, and how closely five minutes of town show it."""


def spoiled(seed: int, seconds: float) -> Log:
    """A drive whose vehicle has the antenna 0.3 m off along each axis, whose GNSS and pose fixes are 80 ms older than
    their stamps, whose wheels read 2 % high, and whose gyro reads 3000 ppm high about z."""
    log = simulate(seconds, seed, load("clean"))
    assert log.imu is not None
    assert log.wheel is not None
    arm = np.add(log.vehicle.gnss_lever_arm, (0.3, -0.3, 0.3))
    return replace(
        log,
        imu=replace(log.imu, gyro=log.imu.gyro * (1.0, 1.0, 1.003)),
        wheel=replace(log.wheel, speed=1.02 * log.wheel.speed),
        vehicle=msgspec.structs.replace(log.vehicle, gnss_lever_arm=tuple(arm.tolist())),
        **{name: late(getattr(log, name)) for name in ("gnss", "gnss_velocity", "pose_fixes")},
    )


def late(record: Any) -> Any:
    ns = round(LATE_S * 1e9)
    return replace(record, t_ns=record.t_ns + ns, arrival_ns=record.arrival_ns + ns)


def turned(log: Log) -> Log:
    """The same drive by an IMU whose axes are those of the vehicle turned by -1 deg about z, then about y."""
    assert log.imu is not None
    R = Rotation.from_euler("ZY", (-TURNED, -TURNED), degrees=True).as_matrix()  # body axes in the vehicle's
    arm = np.array(log.vehicle.gnss_lever_arm) @ R
    vehicle = msgspec.structs.replace(log.vehicle, gnss_lever_arm=tuple(arm.tolist()))
    return replace(log, imu=replace(log.imu, gyro=log.imu.gyro @ R, accel=log.imu.accel @ R), vehicle=vehicle)


def steady() -> Log:
    """A minute on a straight, level line at constant speed, with GNSS alone."""
    none = np.zeros(round(60.0 / KNOT_S) + 20)
    profile = Profile(start_s=-2.0, speed=none + 15.0, yaw=none + 0.7, grade=none, roll=none)
    truth = Truth(profile, (0.84, 0.2, 560.0), 1_715_673_600_000_000_000)
    return only(sense(truth, 60.0, 42, load("clean")).log, "gnss", "gnss_velocity")


def by_name(found: tuple[Estimated, ...]) -> dict[str, Estimated]:
    return {each.name: each for each in found}


@pytest.mark.parametrize("seed", [11, 12])
def test_known_errors_are_found(seed: int) -> None:
    """Each within three of its own sigmas, and as closely as stated."""
    found = by_name(run(spoiled(seed, 300.0), ALL).estimates)
    assert set(found) == {*SHOWN, "gnss_arm_z", "pose_yaw", "gyro_misalignment_x", "gyro_misalignment_y"}
    for name, (truth, close) in SHOWN.items():
        each = found[name]
        assert each.excited, each
        assert abs(each.value - truth) < min(3.0 * each.sigma, close), each
    assert found["gnss_arm_x"].given == pytest.approx(0.8)
    height = found["gnss_arm_z"]  # a car that stays level shows it in nothing but the height, which is unknown as well
    assert not height.excited
    assert abs(height.value - 1.2) < 3.0 * height.sigma


def test_a_body_that_is_turned_in_the_vehicle_is_found() -> None:
    """Without pose fixes, whose yaw is the body's: what the rear axle cannot do shows the vehicle's axes."""
    log = only(turned(simulate(300.0, 11, load("clean"))), "gnss", "gnss_velocity", "wheel")
    config = FusionConfig(estimate=Estimate(mounting=True))
    found = by_name(run(log, config).estimates)
    assert set(found) == {"wheel_scale", "mounting_pitch", "mounting_yaw"}
    for name in ("mounting_pitch", "mounting_yaw"):
        assert found[name].excited
        assert abs(found[name].value - TURNED) < min(3.0 * found[name].sigma, 0.15), found[name]


def test_what_a_straight_drive_at_constant_speed_does_not_excite_keeps_its_prior() -> None:
    found = by_name(run(steady(), ALL).estimates)
    for name in ("gnss_arm_x", "gnss_arm_z", "gnss_delay", "gyro_scale", "mounting_yaw"):
        each = found[name]
        assert not each.excited, each
        assert each.sigma > EXCITED * each.prior_sigma
        assert abs(each.value - each.given) < each.prior_sigma
    assert "wheel_scale" not in found  # there is no wheel
    assert "pose_delay" in found  # asked for, though there are no pose fixes
    assert found["pose_delay"].sigma == found["pose_delay"].prior_sigma == ALL.estimate.delay_sigma_s
    assert found["pose_delay"].value == 0.0


def test_the_localizer_says_the_same_at_any_time() -> None:
    log = spoiled(11, 60.0)
    localizer = Localizer(log.vehicle, log.map_frame, ALL)
    before = by_name(localizer.estimates())
    assert all(each.sigma == pytest.approx(each.prior_sigma) and not each.excited for each in before.values())
    assert before["gnss_arm_x"].value == before["gnss_arm_x"].given == pytest.approx(0.8)
    session = Session(log.vehicle, log.map_frame, ALL)
    session.push(log)
    for name in ("gnss", "gnss_velocity", "pose_fixes", "wheel", "imu"):
        localizer.push(getattr(log, name))
    for a, b in zip(localizer.estimates(), session.finish().estimates, strict=True):
        assert a.name == b.name
        assert a.value == pytest.approx(b.value, rel=1e-3, abs=1e-4)


def test_nothing_is_reported_that_nobody_asked_for() -> None:
    assert estimates(None, Vehicle(), FusionConfig()) == ()
    known = msgspec.structs.replace(ALL.estimate, gyro=False, lever_arm_sigma_m=0.0)
    names = [each.name for each in estimates(None, Vehicle(), msgspec.structs.replace(ALL, estimate=known))]
    assert names == ["mounting_pitch", "mounting_yaw", "gnss_delay", "pose_delay"]


def test_the_jacobian_of_a_delay() -> None:
    """H is minus the residual's derivative, also where the delay is large."""
    change, bend, step = (9.0, -3.0, 0.5), (1.5, 0.7, -0.2), 1e-6

    def residual_at(delay: float) -> tuple[Floats, Floats]:
        nav, H, residual = np.zeros(18), np.zeros((3, 24)), np.zeros(3)
        nav[17] = delay
        see_delay(nav, H, residual, 16, change, bend)
        return residual, H[:, 16]

    ahead, behind = residual_at(0.2 + step)[0], residual_at(0.2 - step)[0]
    np.testing.assert_allclose(residual_at(0.2)[1], -(ahead - behind) / (2.0 * step), rtol=1e-7)
    np.testing.assert_allclose(residual_at(0.2)[0], 0.2 * np.array(change) - 0.02 * np.array(bend))


@pytest.mark.slow
def test_what_the_scale_of_an_accelerometer_is_worth() -> None:
    """The forward accelerometer of a consumer IMU off by 3000 ppm, which is no state: how well a drive would show it
    (curvature of the likelihood), and what it adds to the error after a minute without GNSS and pose fixes. Prints."""
    off = 3e-3
    scenario = msgspec.structs.replace(load("clean"), imu=ImuSimulation(preset="consumer", flaws=ImuFlaws()))
    config = FusionConfig(imu=ImuNoise(noise_scale=1.0))
    sigmas, ends = [], np.zeros((8, 2, 2))
    for k in range(8):
        drive = simulate_drive(360.0, 100_020 + k, scenario)
        heights = [likelihood(scaled(only(drive.log, "gnss", "gnss_velocity"), by), config) for by in (-off, 0.0, off)]
        sigmas.append(off / np.sqrt(-np.diff(heights, 2)[0]))
        for with_wheel, log in enumerate((replace(drive.log, wheel=None), drive.log)):
            for is_off, by in enumerate((0.0, off)):
                states = run(with_outage(scaled(log, by), 290.0, 60.0), config).states
                at = int(np.searchsorted(states.t_ns, log.imu.t_ns[0] + 350 * NS_PER_S)) - 1
                truth = drive.truth.at(states.t_ns[at : at + 1])
                ends[k, with_wheel, is_off] = np.linalg.norm(enu_from_llh(states.llh[at : at + 1], truth.llh[0])[0, :2])
    (without, without_off), (wheel, wheel_off) = np.median(ends, axis=0)
    print(f"six minutes show the scale to {1e6 * np.median(sigmas):.0f} ppm")
    print(f"after 60 s {without:.2f} m, scale off {without_off:.2f} m; with wheel {wheel:.2f}, {wheel_off:.2f} m")
    assert np.median(sigmas) < off / 3.0
    assert without_off < 1.5 * without
    assert wheel_off < 1.5 * wheel


def scaled(log: Log, by: float) -> Log:
    assert log.imu is not None
    return replace(log, imu=replace(log.imu, accel=log.imu.accel * (1.0 + by, 1.0, 1.0)))


def likelihood(log: Log, config: FusionConfig) -> float:
    """Logarithm, but for a constant."""
    assert log.imu is not None
    decisions = run(log, msgspec.structs.replace(config, gates=Gates(use=False))).decisions
    sensors = (Sensor.GNSS_POSITION, Sensor.GNSS_VELOCITY)
    value, variance = joint(decisions, sensors, int(log.imu.t_ns[0]) + 30 * NS_PER_S)
    return float(-0.5 * (value**2 / variance + np.log(variance)).sum())
