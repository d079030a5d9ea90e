"""Clock offset and mounting on a synthetic drive whose truth is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sensors.datasets.calibration import calibrate
from sensors.datasets.clock_offset import estimate_clock_offset, velocity_lag
from sensors.datasets.inertial_fit import fit_window, moving_windows, strapdown
from sensors.datasets.mounting import estimate_mounting
from sensors.errors import EgolocError

from .conftest import Drive, records, synthetic_drive


@pytest.mark.parametrize("late_s", [-0.31, 0.0, 0.26])
@pytest.mark.parametrize(("noise", "bound"), [(0.0, 0.002), (1.0, 0.012)])
def test_the_delay_of_positions_is_found_within_its_sigma(late_s: float, noise: float, bound: float) -> None:
    drive = synthetic_drive(90.0, late_s=late_s, noise=noise)
    windows = moving_windows(drive.t_ns, np.hypot(*drive.velocity[:, :2].T), 6.0, 1.0)
    sigma = np.full_like(drive.position, 0.01)
    found = estimate_clock_offset(strapdown(drive.imu), drive.t_ns, drive.position, sigma, windows, "position")
    assert abs(found.delay_s + late_s) < bound
    assert abs(found.delay_s + late_s) < 3 * found.sigma_s
    assert found.sigma_s < 0.008
    assert found.rms < 0.012


def test_the_delay_of_velocities_is_found_too(drive: Drive) -> None:
    windows = moving_windows(drive.t_ns, np.hypot(*drive.velocity[:, :2].T), 10.0, 1.0)
    sigma = np.full_like(drive.velocity, 0.02)
    found = estimate_clock_offset(strapdown(drive.imu), drive.t_ns, drive.velocity, sigma, windows, "velocity")
    assert abs(found.delay_s + 0.26) < 0.005


def test_too_few_windows_are_an_error(drive: Drive) -> None:
    windows = moving_windows(drive.t_ns, np.hypot(*drive.velocity[:, :2].T), 10.0, 1.0)[2:4]
    with pytest.raises(EgolocError, match="2 usable windows"):
        estimate_clock_offset(
            strapdown(drive.imu), drive.t_ns, drive.position, np.ones_like(drive.position), windows, "position"
        )


def test_velocity_lag_is_that_of_the_velocity_behind_the_position() -> None:
    drive = synthetic_drive(60.0, noise=0.0)
    t = (drive.t_ns - drive.t_ns[0]) * 1e-9
    late = np.stack([np.interp(t - 0.13, t, v) for v in drive.velocity.T], axis=1)
    assert velocity_lag(drive.t_ns, drive.position, late) == pytest.approx(0.13, abs=0.01)


def test_the_fit_returns_velocity_and_attitude(drive: Drive) -> None:
    path = strapdown(drive.imu)
    rows = np.arange(100, 140)
    fit = fit_window(path, drive.t_ns, drive.position, np.full_like(drive.position, 0.01), rows, -0.26, "position")
    assert fit is not None
    np.testing.assert_allclose(fit.vel_enu, drive.velocity[rows], atol=0.02)
    at = np.searchsorted(path.t, (drive.t_ns[rows[0]] - path.origin_ns) * 1e-9 + 0.26)
    up_imu = (fit.R_enu_s @ path.R_s_body[at])[2]
    assert np.degrees(np.arccos(up_imu @ drive.R_body_imu[2])) < 1.5  # bias 0.1 m/s^2 of the accelerometer is 0.6 deg


def test_a_window_across_an_imu_gap_is_not_fitted(drive: Drive) -> None:
    gap = (drive.imu.t_ns < drive.t_ns[110]) | (drive.imu.t_ns > drive.t_ns[112])
    rows = np.arange(100, 140)
    sigma = np.full_like(drive.position, 0.01)
    assert fit_window(strapdown(drive.imu[gap]), drive.t_ns, drive.position, sigma, rows, -0.26, "position") is None


def test_mounting_and_rear_axle_are_found(drive: Drive) -> None:
    path = strapdown(drive.imu)
    windows = moving_windows(drive.t_ns, np.hypot(*drive.velocity[:, :2].T), 8.0, 1.0, 4.0)
    sigma = np.full_like(drive.position, 0.01)
    found = (fit_window(path, drive.t_ns, drive.position, sigma, rows, -0.26, "position") for rows in windows)
    mounting = estimate_mounting(path, drive.imu.gyro, drive.t_ns, -0.26, [fit for fit in found if fit is not None])
    error = Rotation.from_matrix(mounting.R_body_imu @ drive.R_body_imu.T).as_rotvec(degrees=True)
    assert np.abs(error).max() < 0.3
    assert abs(mounting.ahead_m - drive.ahead_m) < 0.1


def test_only_the_first_half_of_a_drive_is_used(drive: Drive) -> None:
    fix, velocity = records(drive, np.radians([48.0, 11.0, 0.0]))
    whole = calibrate(drive.imu, fix, velocity, 0.01)
    half = drive.imu.t_ns < drive.imu.t_ns[len(drive.imu) // 2] + 10**9
    broken = type(drive.imu)(
        drive.imu.t_ns,
        drive.imu.arrival_ns,
        np.where(half[:, None], drive.imu.gyro, 0.0),
        np.where(half[:, None], drive.imu.accel, 0.0),
    )
    again = calibrate(broken, fix, velocity, 0.01)
    assert whole.position_delay_s == again.position_delay_s == pytest.approx(-0.26, abs=0.012)
    assert whole.velocity_delay_s == pytest.approx(-0.26, abs=0.02)
    assert whole.rear_axle[0] == pytest.approx(-1.5, abs=0.15)
