"""comma2k19: conventions proved on a real segment, and damaged ones."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sensors.datasets import load
from sensors.errors import EgolocError
from sensors.geodesy import map_from_llh
from sensors.records import Log
from sensors.rotation import matrix_from_q, rpy_from_q, wrap


@pytest.fixture(scope="module")
def log(data: Path) -> Log:
    return load("comma2k19", data / "comma2k19")


def test_every_sensor_is_there_in_utc(log: Log) -> None:
    assert log.imu is not None
    assert log.gnss is not None
    assert log.wheel is not None
    assert log.reference is not None
    assert (len(log.imu), len(log.gnss), len(log.wheel), len(log.reference)) == (6256, 579, 4974, 1200)
    for record in (log.imu, log.gnss, log.wheel, log.reference):
        assert str(record.t_ns[:1].view("datetime64[ns]")[0]).startswith("2018-08-02T16:14:")
    arrival = (log.gnss.arrival_ns - log.gnss.t_ns) * 1e-9
    assert 0.15 < arrival.min() < arrival.max() < 0.3


def test_gyro_axes_are_those_of_the_pose(log: Log) -> None:
    """Each body rate correlates with that of the reference attitude, at no lag: axes, signs and clock are right."""
    assert log.imu is not None
    assert log.reference is not None
    t, q = (log.reference.t_ns - log.imu.t_ns[0]) * 1e-9, matrix_from_q(log.reference.q_map_body)
    t_imu = (log.imu.t_ns - log.imu.t_ns[0]) * 1e-9
    turned = np.concatenate((np.zeros((1, 3)), np.cumsum(np.diff(t_imu)[:, None] * log.imu.gyro[1:], axis=0)))
    relative = np.einsum("nji,njk->nik", q[:-10], q[10:])
    axes = ((2, 1), (0, 2), (1, 0))
    for axis, (i, j) in enumerate(axes):
        expected = (relative[:, i, j] - relative[:, j, i]) / 2
        use = (t[:-10] > 0.5) & (t[10:] < t_imu[-1] - 0.5)

        def seen(lag: float, axis: int = axis) -> np.ndarray:
            both = [np.interp(x + lag, t_imu, turned[:, axis]) for x in (t[10:], t[:-10])]
            return both[0] - both[1]

        found = [np.corrcoef(seen(lag)[use], expected[use])[0, 1] for lag in (-0.1, 0.0, 0.1)]
        assert found[1] > 0.95
        assert found[1] == max(found)


def test_the_body_looks_where_it_goes(log: Log) -> None:
    assert log.imu is not None
    assert log.reference is not None
    angles = rpy_from_q(log.reference.q_map_body)
    velocity = np.gradient(log.reference.p_map, log.reference.t_ns * 1e-9, axis=0)
    course = np.arctan2(velocity[:, 1], velocity[:, 0])
    slope = np.arctan2(velocity[:, 2], np.hypot(velocity[:, 0], velocity[:, 1]))
    assert abs(np.degrees(np.median(wrap(course - angles[:, 2])))) < 0.1
    assert abs(np.degrees(np.median(slope + angles[:, 1]))) < 0.2  # FLU: a climb is a negative pitch
    assert np.corrcoef(slope, angles[:, 1])[0, 1] < -0.95
    assert log.imu.accel[:, 2].mean() == pytest.approx(9.8, abs=0.3)


def test_gnss_agrees_with_the_pose_at_its_delay(log: Log) -> None:
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    assert log.reference is not None
    assert log.map_frame is not None
    origin = log.reference.t_ns[0]
    path = CubicSpline((log.reference.t_ns - origin) * 1e-9, log.reference.p_map)
    t = (log.gnss.t_ns - origin) * 1e-9 - log.vehicle.gnss_delay_s
    inside = (t > 1) & (t < 59)
    error = map_from_llh(log.map_frame, log.gnss.llh)[inside] - path(t[inside])
    assert np.median(np.hypot(error[:, 0], error[:, 1])) < 0.5
    assert abs(np.median(error[:, 2])) < 2.0
    t = (log.gnss_velocity.t_ns - origin) * 1e-9 - log.vehicle.gnss_velocity_delay_s
    inside = (t > 1) & (t < 59)
    speed = np.hypot(*log.gnss_velocity.vel_enu[inside, :2].T) - np.linalg.norm(path(t[inside], 1)[:, :2], axis=1)
    assert np.std(speed) < 0.1


def test_wheels_are_scaled_to_the_gnss_speed(log: Log) -> None:
    assert log.wheel is not None
    assert log.reference is not None
    origin = log.reference.t_ns[0]
    path = CubicSpline((log.reference.t_ns - origin) * 1e-9, log.reference.p_map)
    t = (log.wheel.t_ns - origin) * 1e-9
    inside = (t > 1) & (t < 59)
    true = np.linalg.norm(path(t[inside], 1), axis=1)
    assert np.sum(log.wheel.speed[inside]) / np.sum(true) == pytest.approx(1.0, abs=0.004)
    assert np.std(log.wheel.speed[inside] - true) < log.wheel.sigma[0] * 1.5


@pytest.fixture
def segment(data: Path, tmp_path: Path) -> Path:
    """A writable copy of the segment, outside the project."""
    folder = tmp_path / "segment"
    shutil.copytree(data / "comma2k19", folder)
    for path in folder.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    folder.chmod(0o755)
    return folder


def test_damaged_segments_are_named(segment: Path) -> None:
    gyro = segment / "processed_log/IMU/gyro_uncalibrated/value"
    gyro.write_bytes(gyro.read_bytes()[:1000])
    with pytest.raises(EgolocError, match="gyro_uncalibrated/value: expected a numpy array"):
        load("comma2k19", segment)
    with gyro.open("wb") as file:
        np.save(file, np.zeros((10, 2)))
    with pytest.raises(EgolocError, match=r"gyro_uncalibrated/value: expected shape \(N, 3\), got \(10, 2\)"):
        load("comma2k19", segment)
    gyro.unlink()
    with pytest.raises(EgolocError, match="gyro_uncalibrated/value: no such file"):
        load("comma2k19", segment)


def test_rows_that_are_not_finite_are_counted(segment: Path) -> None:
    path = segment / "processed_log/GNSS/live_gnss_ublox/value"
    value = np.load(path)
    value[7, 0] = np.nan
    with path.open("wb") as file:
        np.save(file, value)
    log = load("comma2k19", segment)
    assert log.gnss is not None
    assert len(log.gnss) == 578
    assert [(x.reason, x.count) for x in log.left_out] == [("not finite", 1)]
