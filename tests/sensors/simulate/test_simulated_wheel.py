"""Wheel speed: drift of its scale, slip, quantization."""

import msgspec
import numpy as np
import pytest

from sensors.records import WheelSpeed
from sensors.simulate.course import Course
from sensors.simulate.drive import Drive, DriveConfig, featureless, simulate_drive
from sensors.simulate.trajectory import Truth
from sensors.simulate.wheel import WheelSensor, WheelSimulation
from sensors.vehicle import Vehicle
from tests.sensors.simulate.courses import cruise, epochs, straight

EXACT = WheelSimulation(sigma=1e-9, scale_sigma=0.0)


def wheel(truth: Truth, course: Course, config: WheelSimulation, seed: int = 0, rate_hz: float = 1.0) -> WheelSpeed:
    duration_s = (course.t_ns[-1] - truth.start_ns) * 1e-9 - 10
    sensor = WheelSensor(truth, course, Vehicle(), config, np.random.default_rng(seed))
    return sensor.sense(epochs(duration_s, rate_hz))


def test_the_scale_drifts_slowly_by_as_much_as_stated() -> None:
    truth, course = cruise(3600.0), straight(3610.0)
    config = msgspec.structs.replace(EXACT, drift_sigma=0.002, drift_s=600.0)
    scale = np.array([wheel(truth, course, config, seed).speed / 10.0 - 1.0 for seed in range(60)])
    assert scale.std() == pytest.approx(0.002, rel=0.1)
    both = np.mean(scale[:, 600:] * scale[:, :-600]) / scale.var()
    assert both == pytest.approx(np.exp(-1.0), abs=0.12)
    assert np.abs(np.diff(scale, axis=1)).max() < 2e-4


def test_the_stated_sigma_covers_scale_and_drift() -> None:
    config = WheelSimulation(sigma=0.03, scale_sigma=0.003, drift_sigma=0.004)
    np.testing.assert_allclose(wheel(cruise(60.0), straight(70.0), config).sigma, np.hypot(0.03, 0.05))


def test_speeds_come_in_steps_of_the_bus() -> None:
    found = wheel(cruise(600.0), straight(610.0), WheelSimulation(quantum=0.0625), rate_hz=50.0)
    steps = found.speed / 0.0625
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    assert found.speed.std() == pytest.approx(np.hypot(0.05, 0.0625 / np.sqrt(12)), rel=0.05)


def test_wheels_slip_under_strong_acceleration_only(drive: Drive) -> None:
    config = msgspec.structs.replace(EXACT, slip_above=1.0, slip_per_accel=0.05)
    truth, course = drive.truth, featureless(drive.truth)
    t_ns = truth.start_ns + np.arange(0, 600 * 50) * 20_000_000
    speed = truth.forward_speed(t_ns)
    accel = np.gradient(speed, 0.02)
    sensor = WheelSensor(truth, course, Vehicle(), config, np.random.default_rng(0))
    slip = sensor.sense(t_ns).speed / np.maximum(speed, 1e-3) - 1.0
    moving = speed > 2.0
    gentle, strong, braking = moving & (np.abs(accel) < 0.7), moving & (accel > 1.5), moving & (accel < -1.5)
    assert np.abs(slip[gentle]).max() < 1e-6
    assert slip[strong].mean() == pytest.approx(0.05 * (accel[strong] - 1.0).mean(), rel=0.15)
    assert slip[braking].mean() == pytest.approx(0.05 * (accel[braking] + 1.0).mean(), rel=0.15)


def test_the_bus_of_an_old_scenario_has_neither() -> None:
    drive = simulate_drive(60.0, 1, DriveConfig(wheel=EXACT))
    assert drive.log.wheel is not None
    np.testing.assert_allclose(drive.log.wheel.speed, drive.truth.forward_speed(drive.log.wheel.t_ns), atol=1e-7)
