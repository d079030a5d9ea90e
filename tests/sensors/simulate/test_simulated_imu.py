"""Samples against the truth; noise and biases against the datasheet, at two rates."""

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from sensors._kernels import STANDARD_GRAVITY
from sensors.simulate.drive import Drive, DriveConfig, city_truth
from sensors.simulate.imu import simulate_imu
from sensors.simulate.noise import stamps
from sensors.simulate.trajectory import Truth
from sensors.vehicle import ImuSpec
from tests.sensors.simulate.courses import QUIET


@pytest.fixture(scope="module")
def hour() -> Truth:
    return city_truth(3600.0, 0, DriveConfig())


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def per_second(noise: NDArray[np.float64], rate_hz: int) -> NDArray[np.float64]:
    """Integral of the noise over each second."""
    seconds = len(noise) // rate_hz
    return noise[: seconds * rate_hz].reshape(seconds, rate_hz, 3).sum(axis=1) / rate_hz


def test_rate_samples_without_errors_are_the_truth(truth: Truth) -> None:
    t_ns = stamps(truth.start_ns, 100.0, 100.0)
    imu, biases = simulate_imu(truth, t_ns, ImuSpec(), None)
    motion = truth.at(t_ns)
    np.testing.assert_array_equal(imu.gyro, motion.rate)
    np.testing.assert_array_equal(imu.accel, motion.specific_force)
    assert not biases.gyro.any()
    assert not biases.accel.any()


def test_increment_samples_are_means_over_the_interval_that_ends_at_the_stamp(truth: Truth) -> None:
    t_ns = stamps(truth.start_ns, 60.0, 100.0)
    imu, _ = simulate_imu(truth, t_ns, ImuSpec(samples="increment"), None)
    inside = np.arange(-10_000_000, 1, 250_000)
    fine = truth.at((t_ns[:, None] + inside).ravel())
    simpson = np.where(np.arange(len(inside)) % 2, 4.0, 2.0)
    simpson[[0, -1]] = 1.0
    simpson /= simpson.sum()
    for column, dense in ((imu.gyro, fine.rate), (imu.accel, fine.specific_force)):
        expected = np.einsum("g,ngk->nk", simpson, dense.reshape(len(t_ns), len(inside), 3))
        np.testing.assert_allclose(column, expected, rtol=0, atol=2e-9)
    assert np.abs(imu.gyro - truth.inertial(t_ns)[0]).max() > 1e-3


@pytest.mark.parametrize("rate_hz", [100, 200])
def test_white_noise_has_the_datasheets_density_at_any_rate(hour: Truth, rate_hz: int) -> None:
    spec = msgspec.structs.replace(QUIET, gyro_noise_deg_per_sqrt_h=0.3, accel_noise_m_per_s_per_sqrt_h=0.06)
    t_ns = stamps(hour.start_ns, 3600.0, rate_hz)
    imu, _ = simulate_imu(hour, t_ns, spec, rng())
    exact_gyro, exact_accel = hour.inertial(t_ns)
    angle, speed = per_second(imu.gyro - exact_gyro, rate_hz), per_second(imu.accel - exact_accel, rate_hz)
    # random walk after an hour = 60 times that after a second; 10,800 draws: 0.7 % standard error
    assert np.degrees(angle.std()) * 60 == pytest.approx(0.3, rel=0.03)
    assert speed.std() * 60 == pytest.approx(0.06, rel=0.03)
    neighbours = np.mean(angle[1:] * angle[:-1]) / angle.var()
    assert abs(neighbours) < 0.04


@pytest.mark.parametrize("rate_hz", [100, 200])
def test_drifting_bias_is_gauss_markov_at_any_rate(hour: Truth, rate_hz: int) -> None:
    spec = msgspec.structs.replace(
        QUIET, gyro_bias_instability_deg_per_h=5.0, accel_bias_instability_mg=0.2, bias_time_constant_s=2.0
    )
    t_ns = stamps(hour.start_ns, 3600.0, rate_hz)
    imu, biases = simulate_imu(hour, t_ns, spec, rng())
    np.testing.assert_allclose(imu.gyro - hour.inertial(t_ns)[0], biases.gyro, rtol=0, atol=1e-12)
    gyro, accel = np.degrees(biases.gyro) * 3600, biases.accel / STANDARD_GRAVITY * 1000
    assert gyro.std() == pytest.approx(5.0, rel=0.05)
    assert accel.std() == pytest.approx(0.2, rel=0.05)
    for lag_s in (1, 2, 4):
        shifted = np.mean(gyro[lag_s * rate_hz :] * gyro[: -lag_s * rate_hz]) / gyro.var()
        assert shifted == pytest.approx(np.exp(-lag_s / 2.0), abs=0.05)


def test_turn_on_bias_is_constant_and_spread_as_the_datasheet_says(truth: Truth) -> None:
    spec = msgspec.structs.replace(QUIET, gyro_turn_on_bias_deg_per_h=360.0, accel_turn_on_bias_mg=5.0)
    t_ns = stamps(truth.start_ns, 1.0, 100.0)
    runs = [simulate_imu(truth, t_ns, spec, rng(seed))[1] for seed in range(400)]
    assert all((r.gyro == r.gyro[0]).all() and (r.accel == r.accel[0]).all() for r in runs)
    gyro = np.degrees([r.gyro[0] for r in runs]) * 3600
    accel = np.array([r.accel[0] for r in runs]) / STANDARD_GRAVITY * 1000
    assert gyro.std() == pytest.approx(360.0, rel=0.07)
    assert accel.std() == pytest.approx(5.0, rel=0.07)
    assert abs(gyro.mean()) < 36.0


def test_drive_states_the_biases_of_its_own_samples(drive: Drive) -> None:
    imu = drive.log.imu
    assert imu is not None
    gyro, accel = drive.truth.inertial(imu.t_ns)
    spec = drive.log.vehicle.imu
    white = imu.gyro - gyro - drive.imu_biases.gyro
    assert white.std() == pytest.approx(np.radians(spec.gyro_noise_deg_per_sqrt_h) / 60 * 10, rel=0.02)
    white = imu.accel - accel - drive.imu_biases.accel
    assert white.std() == pytest.approx(spec.accel_noise_m_per_s_per_sqrt_h / 60 * 10, rel=0.02)
    assert ((imu.arrival_ns - imu.t_ns) == 1_000_000).all()
