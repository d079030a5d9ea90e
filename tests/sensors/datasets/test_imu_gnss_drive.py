"""imu_gnss_fusion drives: mounting, signs and times of the real recordings, and mistakes in small ones."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sensors.datasets import imu_gnss_drive, load
from sensors.datasets.calibration import calibrate
from sensors.datasets.clock_offset import estimate_clock_offset
from sensors.datasets.inertial_fit import moving_windows, strapdown
from sensors.errors import EgolocError
from sensors.geodesy import enu_from_llh
from sensors.rotation import rpy_from_q, wrap

from .conftest import forward_correlation, yaw_rate_correlation

DRIVES = ("urban-medium-turn-loop-nominal-001", "parkinglot-maneuvers", "urban-long-turn-loop-nominal-001")


@pytest.mark.parametrize("name", DRIVES)
def test_axes_and_signs_agree_with_the_track(data: Path, name: str) -> None:
    log = load("imu-gnss-drive", data / "imu_gnss_drives" / name)
    assert log.imu is not None
    assert log.gnss_velocity is not None
    delay = log.vehicle.gnss_velocity_delay_s
    up = log.imu.accel.mean(axis=0)
    assert np.degrees(np.arccos(up[2] / np.linalg.norm(up))) < 3.0
    assert yaw_rate_correlation(log.imu, log.gnss_velocity, delay, 6.0) > 0.95
    assert forward_correlation(log.imu, log.gnss_velocity, delay) > 0.95
    assert -2.3 < log.vehicle.rear_axle[0] < -1.2
    assert log.vehicle.land_vehicle


@pytest.mark.parametrize("name", DRIVES)
def test_the_mounting_that_the_motion_shows_is_the_recorded_one(data: Path, name: str) -> None:
    src = data / "imu_gnss_drives" / name
    raw, _ = imu_gnss_drive._imu(src)
    fix, velocity, _ = imu_gnss_drive._gnss(src)
    found = calibrate(raw, fix, velocity, imu_gnss_drive.NOISE_M).mounting
    recorded = imu_gnss_drive.read_mount(src / "reference_mount.csv.gz")
    assert found is not None
    assert recorded is not None
    assert Rotation.from_matrix(found.R_body_imu @ recorded.T).magnitude() < np.radians(3.0)


def test_gnss_is_not_early_once_the_rear_axle_is_known(data: Path) -> None:
    """The course leads the gyro by 0.25 to 0.35 s in town, but it leads by distance to the rear axle over speed.

    Against the accelerations themselves the stamps are true to 0.03 s, and 0.3 s early fits far worse.
    """
    src = data / "imu_gnss_drives/urban-long-turn-loop-nominal-001"
    raw, _ = imu_gnss_drive._imu(src)
    fix, velocity, _ = imu_gnss_drive._gnss(src)
    enu = enu_from_llh(fix.llh, fix.llh[0])
    windows = moving_windows(fix.t_ns, np.hypot(*velocity.vel_enu[:, :2].T), 10.0, 1.5)
    found = estimate_clock_offset(strapdown(raw), fix.t_ns, enu, np.full_like(enu, 0.05), windows, "position")
    assert abs(found.delay_s) < 0.03
    assert found.sigma_s < 0.02
    assert found.rms < 0.04


def test_the_reference_is_a_vehicle_in_map_axes(data: Path) -> None:
    log = load("imu-gnss-drive", data / "imu_gnss_drives" / DRIVES[0])
    reference = log.reference
    assert reference is not None
    assert log.gnss is not None
    roll_pitch_yaw = rpy_from_q(reference.q_map_body)
    step = reference.p_map[20:] - reference.p_map[:-20]
    fast = np.hypot(step[:, 0], step[:, 1]) > 4
    course = np.arctan2(step[:, 1], step[:, 0])
    turn = wrap(course - roll_pitch_yaw[10:-10, 2])[fast]
    slope = np.arctan2(step[:, 2], np.hypot(step[:, 0], step[:, 1]))[fast]
    assert abs(np.degrees(np.nanmedian(turn))) < 0.3
    assert np.corrcoef(roll_pitch_yaw[10:-10, 1][fast], slope)[0, 1] < -0.4  # FLU: a climb is a negative pitch
    assert (reference.sigma[:, 0] == 1.0).all()


def drive_folder(folder: Path, gnss_header: str | None = None, bad_cell: str = "1.0") -> Path:
    header = gnss_header or ",".join(imu_gnss_drive._GNSS)
    row = "{t},48.0,11.0,500.0,1.0,0.0,0.0,0.5,0.5,1.0,0.1,0.1," + bad_cell
    with gzip.open(folder / "gnss.csv.gz", "wt") as file:
        file.write("\n".join([header, *(row.format(t=k * 0.5) for k in range(40))]))
    with gzip.open(folder / "imu.csv.gz", "wt") as file:
        rows = [f"{k * 0.01},0,0,0,0,0,9.8" for k in range(2000)]
        file.write("\n".join([",".join(imu_gnss_drive._IMU), *rows, "19.995,nan,0,0,0,0,9.8", "1.0,0,0,0,0,0,9.8"]))
    return folder


def test_a_drive_that_shows_nothing_is_taken_as_it_is(tmp_path: Path) -> None:
    log = load("imu-gnss-drive", drive_folder(tmp_path))
    assert log.imu is not None
    assert not log.vehicle.land_vehicle
    assert log.vehicle.gnss_delay_s == 0.0
    assert log.reference is None
    assert log.imu.t_ns[0] == imu_gnss_drive.ORIGIN_NS
    np.testing.assert_allclose(log.imu.accel[5], [0, 0, 9.8])
    assert {(x.reason, x.count) for x in log.left_out} == {("not finite", 1), ("stamp goes back", 1)}


def test_mistakes_name_file_and_column(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match=r"gnss.csv.gz: line 2: column vel_std_d_mps: expected a number, got 'x'"):
        load("imu-gnss-drive", drive_folder(tmp_path, bad_cell="x"))
    header = ",".join(imu_gnss_drive._GNSS).replace("height_m", "alt")
    with pytest.raises(EgolocError, match=r"gnss.csv.gz: column height_m: not there"):
        load("imu-gnss-drive", drive_folder(tmp_path, gnss_header=header))
    (tmp_path / "gnss.csv.gz").write_bytes(b"no gzip")
    with pytest.raises(EgolocError, match=r"gnss.csv.gz: expected a text file"):
        load("imu-gnss-drive", tmp_path)
