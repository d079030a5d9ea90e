"""A synthetic drive with known truth, and measures of how well an IMU fits a GNSS track."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sensors.records import GnssFix, GnssVelocity, Imu

Floats = NDArray[np.float64]
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Drive:
    """imu in its own axes on its own clock; t_ns, position, velocity: GNSS in ENU, stamped on time."""

    imu: Imu
    t_ns: NDArray[np.int64]
    position: Floats
    velocity: Floats
    R_body_imu: Floats
    ahead_m: float


def synthetic_drive(seconds: float = 150.0, late_s: float = 0.0, ahead_m: float = 1.5, noise: float = 1.0) -> Drive:
    """A car with turns and stops on flat ground; its IMU is mounted askew and stamps late_s after the fact."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, seconds, 0.001)
    speed = 9.0 + 5.0 * np.sin(0.31 * t) + 2.0 * np.sin(0.83 * t + 1)
    rate = 0.35 * np.sin(0.21 * t) * (1 + np.sin(0.047 * t))
    yaw = 0.4 + np.cumsum(rate) * 0.001
    forward = np.stack((np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)), axis=1)
    axle = np.cumsum(speed[:, None] * forward, axis=0) * 0.001
    p = axle + ahead_m * forward
    velocity = np.gradient(p, 0.001, axis=0)
    accel = np.gradient(velocity, 0.001, axis=0) + np.array([0.0, 0.0, 9.80665])
    R_body_imu = Rotation.from_euler("ZYX", [172.0, -6.0, 3.0], degrees=True).as_matrix()
    R_imu_enu = (Rotation.from_euler("z", yaw[:, None]) * Rotation.from_matrix(R_body_imu)).inv()
    f = R_imu_enu.apply(accel)
    w = np.stack((np.zeros_like(rate), np.zeros_like(rate), rate), axis=1) @ R_body_imu
    k = np.arange(500, len(t) - 500, 10)
    stamps = START_NS + np.rint((t[k] + late_s) * 1e9).astype(np.int64)
    gyro = w[k] + [0.002, -0.003, 0.001] + noise * 0.002 * rng.standard_normal((len(k), 3))
    imu = Imu(stamps, stamps, gyro, f[k] + [0.05, -0.1, 0.08] + noise * 0.05 * rng.standard_normal((len(k), 3)))
    g = np.arange(1000, len(t) - 1000, 250)
    t_ns = START_NS + np.rint(t[g] * 1e9).astype(np.int64)
    position = p[g] + noise * 0.01 * rng.standard_normal((len(g), 3))
    return Drive(imu, t_ns, position, velocity[g], R_body_imu, ahead_m)


def yaw_rate_correlation(imu: Imu, velocity: GnssVelocity, delay_s: float, min_speed: float) -> float:
    """Correlation of the body's yaw rate with the rate of the GNSS course, over steps of two fixes."""
    t = (velocity.t_ns - imu.t_ns[0]) * 1e-9 - delay_s
    t_imu = (imu.t_ns - imu.t_ns[0]) * 1e-9
    turned = np.concatenate(([0.0], np.cumsum(np.diff(t_imu) * (imu.gyro[1:, 2] + imu.gyro[:-1, 2]) / 2)))
    east, north, _ = velocity.vel_enu.T
    course = np.unwrap(np.arctan2(north, east))
    fast = np.hypot(east, north) > min_speed
    use = fast[2:] & fast[1:-1] & fast[:-2] & (t[:-2] > 0) & (t[2:] < t_imu[-1])
    seen = np.interp(t[2:], t_imu, turned) - np.interp(t[:-2], t_imu, turned)
    return float(np.corrcoef(seen[use], (course[2:] - course[:-2])[use])[0, 1])


def forward_correlation(imu: Imu, velocity: GnssVelocity, delay_s: float) -> float:
    """Correlation of the body's forward velocity increments with those of the GNSS speed, slope taken out."""
    t = (velocity.t_ns - imu.t_ns[0]) * 1e-9 - delay_s
    t_imu = (imu.t_ns - imu.t_ns[0]) * 1e-9
    gained = np.concatenate(([0.0], np.cumsum(np.diff(t_imu) * (imu.accel[1:, 0] + imu.accel[:-1, 0]) / 2)))
    step = max(round(1.0 / float(np.median(np.diff(t)))), 1)
    speed = np.hypot(*velocity.vel_enu[:, :2].T)
    use = (t[:-step] > 0) & (t[step:] < t_imu[-1]) & (speed[:-step] > 3)
    climb = 9.8 * velocity.vel_enu[:, 2] / np.maximum(speed, 1.0)
    mean_climb = np.convolve(climb, np.ones(step + 1) / (step + 1), "valid")
    seen = np.interp(t[step:], t_imu, gained) - np.interp(t[:-step], t_imu, gained)
    expected = speed[step:] - speed[:-step] + mean_climb * (t[step:] - t[:-step])
    return float(np.corrcoef(seen[use], expected[use])[0, 1])


@pytest.fixture(scope="session")
def drive() -> Drive:
    """A noisy synthetic drive whose IMU stamps 0.26 s late."""
    return synthetic_drive(late_s=0.26)


def records(drive: Drive, llh0: Floats) -> tuple[GnssFix, GnssVelocity]:
    """The drive's GNSS as records around a datum."""
    from sensors.geodesy import llh_from_enu

    n = len(drive.t_ns)
    cov = np.tile(np.eye(3) * 1e-4, (n, 1, 1))
    fix = GnssFix(drive.t_ns, drive.t_ns, llh_from_enu(drive.position, llh0), cov, np.full(n, 4, np.int8))
    return fix, GnssVelocity(drive.t_ns, drive.t_ns, drive.velocity, cov)
