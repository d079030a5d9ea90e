"""IMU presets, scale and misalignment, temperature and vibration against their configs."""

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from sensors._kernels import STANDARD_GRAVITY
from sensors.errors import EgolocError
from sensors.simulate.drive import DriveConfig, simulate_drive
from sensors.simulate.imu import ImuSensor, ImuSimulation, Temperature, Vibration
from sensors.simulate.imu_presets import PRESETS, ImuFlaws, PresetName
from sensors.simulate.trajectory import Truth
from sensors.vehicle import ImuSpec, Vehicle
from tests.sensors.simulate.courses import QUIET, cruise, epochs, straight

Floats = NDArray[np.float64]


def errors(
    truth: Truth, config: ImuSimulation, seed: int = 0, *, speed: float = 10.0, rate_hz: float = 100.0
) -> tuple[Floats, Floats]:
    """Errors of gyro and accelerometer (N, 3) over ten minutes, of every sample or fewer."""
    sensor = ImuSensor(truth, straight(610.0, speed), 600.0, QUIET, config, np.random.default_rng(seed))
    t_ns = epochs(600.0, rate_hz)
    imu, _ = sensor.sense(t_ns)
    gyro, accel = truth.inertial(t_ns)
    return imu.gyro - gyro, imu.accel - accel


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_puts_its_datasheet_into_the_log(name: PresetName) -> None:
    drive = simulate_drive(20.0, 0, DriveConfig(imu=ImuSimulation(preset=name)))
    spec = PRESETS[name].spec
    assert drive.log.vehicle.imu == spec
    assert drive.log.vehicle.gnss_lever_arm == (0.5, 0.0, 1.2)
    assert drive.log.imu is not None
    white = drive.log.imu.gyro[:500] - drive.truth.inertial(drive.log.imu.t_ns[:500])[0] - drive.imu_biases.gyro[:500]
    # at rest: scale and misalignment act on the earth's rate only
    assert np.degrees(white.std()) * 6 == pytest.approx(spec.gyro_noise_deg_per_sqrt_h, rel=0.1)


def test_presets_are_ordered_by_grade_and_keep_to_what_is_quoted_of_their_parts() -> None:
    grades = [PRESETS[name] for name in ("tactical-fog-class", "tactical", "automotive", "consumer")]
    for column in ("gyro_noise_deg_per_sqrt_h", "gyro_turn_on_bias_deg_per_h"):
        values = [getattr(preset.spec, column) for preset in grades]
        assert values == sorted(values)
    for name, density_mdps, density_ug, turn_on_dps in (("automotive", 5.0, 60.0, None), ("consumer", 7.0, 160.0, 0.5)):
        spec = PRESETS[name].spec
        assert spec.gyro_noise_deg_per_sqrt_h == pytest.approx(density_mdps * 1e-3 * 60.0)
        assert spec.accel_noise_m_per_s_per_sqrt_h == pytest.approx(density_ug * 1e-6 * STANDARD_GRAVITY * 60, rel=0.01)
        assert turn_on_dps is None or spec.gyro_turn_on_bias_deg_per_h == turn_on_dps * 3600.0
        assert f"{density_mdps:g} mdps and {density_ug:g} ug" in PRESETS[name].source


def test_at_rest_the_accelerometers_bias_is_all_that_it_is_off() -> None:
    """What scale and misalignment make of gravity is part of it; without flaws nothing is."""
    drive = simulate_drive(5.0, 3, DriveConfig(imu=ImuSimulation(preset="consumer")))
    none = simulate_drive(5.0, 3, DriveConfig(imu=ImuSimulation(preset="consumer", flaws=ImuFlaws())))
    first = drive.log.imu
    assert first is not None
    rest = slice(0, 100)
    off = (first.accel - drive.truth.inertial(first.t_ns)[1] - drive.imu_biases.accel)[rest]
    white = PRESETS["consumer"].spec.accel_noise_m_per_s_per_sqrt_h / 60 * 10
    assert np.linalg.norm(drive.truth.at(first.t_ns[rest]).vel_enu, axis=1).max() < 1e-6
    assert np.abs(off.mean(axis=0)).max() < 4 * white / 10
    of_gravity = (drive.imu_biases.accel - none.imu_biases.accel)[0]
    assert np.abs(of_gravity).min() > 1e-3
    assert np.abs(of_gravity).max() < STANDARD_GRAVITY * 4 * np.radians(0.3)


def test_a_preset_beside_a_datasheet_is_refused() -> None:
    with pytest.raises(EgolocError, match=r"imu\.preset: expected no \[vehicle\.imu\] beside it, got both"):
        DriveConfig(imu=ImuSimulation(preset="consumer"), vehicle=Vehicle(imu=QUIET))


def test_scale_errors_grow_with_the_signal_and_are_spread_as_stated() -> None:
    truth = cruise(600.0)
    config = ImuSimulation(flaws=ImuFlaws(accel_scale_ppm=2000.0))
    force = truth.inertial(epochs(600.0, 0.01))[1][:, 2]
    gains = np.array([errors(truth, config, seed, rate_hz=0.01)[1][:, 2] / force for seed in range(200)])
    assert np.ptp(gains, axis=1).max() < 1e-12
    assert gains[:, 0].std() == pytest.approx(2000e-6, rel=0.12)


def test_misalignment_leaks_gravity_into_the_level_axes() -> None:
    truth = cruise(600.0)
    config = ImuSimulation(flaws=ImuFlaws(misalignment_deg=0.1))
    leaks = np.array([errors(truth, config, seed, rate_hz=0.01)[1][0] for seed in range(200)])
    assert leaks[:, :2].std() == pytest.approx(np.radians(0.1) * 9.81, rel=0.1)
    assert np.abs(leaks[:, 2]).max() < 1e-4


def test_biases_follow_the_warm_up() -> None:
    config = ImuSimulation(
        flaws=ImuFlaws(gyro_bias_deg_per_h_per_k=10.0, accel_bias_mg_per_k=0.1),
        temperature=Temperature(rise_k=20.0, rise_time_s=100.0),
    )
    truth, ends = cruise(600.0), []
    for seed in range(300):
        gyro, accel = errors(truth, config, seed, rate_hz=0.1)
        assert np.abs(gyro[0]).max() < 1e-12
        # one time constant: 1 - 1/e of the way
        np.testing.assert_allclose(gyro[10], (1 - np.exp(-1.0)) * gyro[-1] / (1 - np.exp(-6.0)), rtol=1e-3, atol=1e-9)
        ends.append(np.concatenate((np.degrees(gyro[-1]) * 3600, accel[-1] / STANDARD_GRAVITY * 1000)))
    spread = np.std(ends, axis=0)
    assert spread[:3].mean() == pytest.approx(200.0, rel=0.12)
    assert spread[3:].mean() == pytest.approx(2.0, rel=0.12)


def test_temperature_wanders_slowly_and_moves_the_scale() -> None:
    config = ImuSimulation(
        flaws=ImuFlaws(accel_scale_ppm_per_k=100.0), temperature=Temperature(wander_k=5.0, wander_time_s=50.0)
    )
    truth = cruise(600.0)
    drift = np.array([errors(truth, config, seed, rate_hz=0.1)[1][:, 2] / 9.81 for seed in range(700)])
    assert np.abs(drift[:, 0]).max() < 1e-9
    # against its start: twice the variance, and a random coefficient
    assert drift[:, 30:].std() == pytest.approx(100e-6 * 5.0 * np.sqrt(2.0), rel=0.1)
    steps = np.diff(drift, axis=1).std()
    assert steps == pytest.approx(100e-6 * 5.0 * np.sqrt(2 * (1 - np.exp(-10 / 50.0))), rel=0.1)


@pytest.mark.parametrize(("speed", "expected"), [(0.0, 0.05), (10.0, 0.25)])
def test_vibration_grows_with_speed_and_is_there_at_idle(speed: float, expected: float) -> None:
    config = ImuSimulation(vibration=Vibration(accel_idle=0.05, accel_per_speed=0.02, gyro_idle_deg=0.1))
    gyro, accel = errors(cruise(600.0, speed), config, speed=speed)
    assert accel.std() == pytest.approx(expected, rel=0.02)
    assert np.degrees(gyro.std()) == pytest.approx(0.1, rel=0.02)
    # the body shakes about its way: what adds up to speed and angle stays
    assert np.abs(np.cumsum(accel, axis=0)).max() * 0.01 < 0.05


@pytest.mark.parametrize(("speed", "seen_hz"), [(10.0, 5.0), (50.0, 25.0), (120.0, 40.0), (150.0, 25.0)])
def test_the_wheels_line_folds_back_as_sampled(speed: float, seen_hz: float) -> None:
    config = ImuSimulation(vibration=Vibration(accel_line=0.1, gyro_line_deg=0.2, wheel_circumference_m=2.0))
    gyro, accel = errors(cruise(600.0, speed), config, speed=speed)
    for column, rms in ((accel[:-1, 2], 0.1 * (speed / 10) ** 2), (np.degrees(gyro[:-1, 1]), 0.2 * speed / 10)):
        assert column.std() == pytest.approx(rms, rel=0.01)
        power = np.abs(np.fft.rfft(column)) ** 2
        frequency = np.fft.rfftfreq(len(column), 0.01)
        assert frequency[np.argmax(power)] == pytest.approx(seen_hz, abs=0.01)
        assert power.max() > 0.9 * power.sum()


def test_flaws_and_vibration_are_off_by_default() -> None:
    gyro, accel = errors(cruise(600.0), ImuSimulation())
    assert not gyro.any()
    assert not accel.any()


def test_exact_samples_have_no_flaws_either() -> None:
    config = ImuSimulation(errors=False, preset="consumer", vibration=Vibration(accel_idle=1.0))
    gyro, accel = errors(cruise(600.0), config)
    assert not gyro.any()
    assert not accel.any()


def test_a_scenario_chooses_a_part_by_name_and_may_change_its_flaws() -> None:
    config = msgspec.convert({"imu": {"preset": "automotive", "flaws": {"gyro_scale_ppm": 1.0}}}, DriveConfig)
    assert config.imu.part(ImuSpec()) == (PRESETS["automotive"].spec, ImuFlaws(gyro_scale_ppm=1.0))
    with pytest.raises(msgspec.ValidationError, match=r"Invalid enum value 'best' - at `\$\.imu\.preset`"):
        msgspec.convert({"imu": {"preset": "best"}}, DriveConfig)
