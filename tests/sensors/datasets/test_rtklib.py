"""RTKLIB: solution text, time tags, and the axes, signs and times of a real drive."""

import struct
from pathlib import Path

import numpy as np
import pytest

from sensors.datasets import load
from sensors.datasets.calibration import calibrate
from sensors.datasets.rtklib_imu import read_imu, read_tag, stamps_from_arrivals
from sensors.datasets.rtklib_solution import read_solution, signed_covariance
from sensors.errors import EgolocError
from sensors.records import GnssStatus, Log

from .conftest import forward_correlation, yaw_rate_correlation

HEADER = (
    "%  GPST            latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) "
    "age(s) ratio vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun"
)
ROW = "40.0 -105.0 1600.0 {q} 21 0.02 0.01 0.03 {ne} 0 0 0 0 1.0 2.0 3.0 0.05 0.06 0.07 0 0 0"


def solution(folder: Path, rows: list[str], header: str = HEADER) -> Path:
    path = folder / "drive.pos"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_a_solution_row(tmp_path: Path) -> None:
    rows = [f"2025/07/08 19:34:{18 + k}.499 " + ROW.format(q=q, ne="-0.005") for k, q in enumerate((1, 2, 4, 5, 3, 6))]
    fix, velocity, left_out = read_solution(solution(tmp_path, rows))
    assert left_out == ()
    assert fix.t_ns[0] == int(np.datetime64("2025-07-08T19:34:00.499", "ns").astype(np.int64))  # GPST is 18 s ahead
    assert [GnssStatus(s).name for s in fix.status] == ["FIXED", "FLOAT", "DGNSS", "SINGLE", "DGNSS", "FLOAT"]
    np.testing.assert_allclose(fix.cov_enu[0], [[1e-4, -2.5e-5, 0], [-2.5e-5, 4e-4, 0], [0, 0, 9e-4]])
    np.testing.assert_allclose(velocity.vel_enu[0], [2.0, 1.0, 3.0])
    np.testing.assert_allclose(np.sqrt(np.diag(velocity.cov_enu[0])), [0.06, 0.05, 0.07])


def test_utc_and_week_seconds_stamps_agree(tmp_path: Path) -> None:
    row = ROW.format(q=1, ne="0")
    gps, _, _ = read_solution(solution(tmp_path, [f"2025/07/08 19:34:18.500 {row}"]))
    utc, _, _ = read_solution(solution(tmp_path, [f"2025/07/08 19:34:00.500 {row}"], HEADER.replace("GPST", "UTC")))
    week, _, _ = read_solution(solution(tmp_path, [f"2374 243258.500 {row}"]))
    assert gps.t_ns[0] == utc.t_ns[0] == week.t_ns[0]


def test_signed_covariances() -> None:
    one = np.array([0.1])
    cov = signed_covariance(one * 3, one * 2, one * 4, -one, one, one * 0)[0]
    np.testing.assert_allclose(cov, [[0.04, -0.01, 0.01], [-0.01, 0.09, 0.0], [0.01, 0.0, 0.16]])


def test_bad_solutions_name_the_fault(tmp_path: Path) -> None:
    row = f"2025/07/08 19:34:18.499 {ROW.format(q=1, ne='0')}"
    with pytest.raises(EgolocError, match=r"drive.pos: column sdne\(m\)"):
        read_solution(solution(tmp_path, [row], HEADER.replace("sdne(m) ", "")))
    with pytest.raises(EgolocError, match="solution row 2: expected 24 columns, got 23"):
        read_solution(solution(tmp_path, [row, row[:-2]]))
    with pytest.raises(EgolocError, match="no solution rows"):
        read_solution(solution(tmp_path, []))
    with pytest.raises(EgolocError, match="RTKLIB header"):
        read_solution(solution(tmp_path, [row], "nothing"))


def test_unusable_rows_are_counted(tmp_path: Path) -> None:
    rows = [f"2025/07/08 19:34:{s}.000 " for s in ("18", "19", "19", "20", "21")]
    cells = [ROW.format(q=q, ne=ne) for q, ne in ((1, 0), (1, 0), (1, 0), (0, 0), (1, 0.05))]
    fix, _, left_out = read_solution(solution(tmp_path, [a + b for a, b in zip(rows, cells, strict=True)]))
    assert len(fix) == 2
    assert {(x.reason, x.count) for x in left_out} == {
        ("stamp repeats", 1),
        ("no solution (Q)", 1),
        ("covariance is not positive definite", 1),
    }


def imu_files(folder: Path, newline: str, stored: str) -> Path:
    """100 rows at 100 Hz logged 30 ms late in bursts of 5; the counter starts at 7 s and gains 100 ppm."""
    path = folder / "imu.csv"
    rows = [f"0.1,0.2,1.0,1,2,3,{7000 + 10 * k}" for k in range(100)]
    path.write_bytes("".join(row + stored for row in rows).encode())
    sizes = np.cumsum([len(row) + len(newline) for row in rows])
    entries = [(30 + 10 * (k + 4 - k % 5), int(sizes[min(k + 4 - k % 5, 99)])) for k in range(0, 100, 5)]
    head = b"TIMETAG RTKLIB demo5".ljust(60, b"\0") + struct.pack("<IId", 99, 1_752_003_261, 0.5)
    path.with_name("imu.csv.tag").write_bytes(head + b"".join(struct.pack("<II", *entry) for entry in entries))
    return path


@pytest.mark.parametrize(("newline", "stored"), [("\n", "\n"), ("\r\n", "\r\n"), ("\r\n", "\n")])
def test_rows_are_stamped_by_the_earliest_arrivals(tmp_path: Path, newline: str, stored: str) -> None:
    imu, left_out = read_imu(imu_files(tmp_path, newline, stored))
    start = int(np.datetime64("2025-07-08T19:34:03.5", "ns").astype(np.int64))  # GPS time less 18 s
    assert read_tag(tmp_path / "imu.csv.tag").start_ns == start
    assert [(x.reason, x.count) for x in left_out] == [("first or last row of the file", 2)]
    np.testing.assert_allclose(imu.t_ns - start, (30 + 10 * np.arange(1, 99)) * 1e6, atol=1)
    assert (imu.arrival_ns >= imu.t_ns).all()
    np.testing.assert_allclose(imu.accel[0], np.array([0.1, 0.2, 1.0]) * 9.80665)
    np.testing.assert_allclose(imu.gyro[0], np.radians([1, 2, 3]))


def test_a_drifting_counter_follows_the_clock() -> None:
    rng = np.random.default_rng(1)
    true = np.arange(0, 600_000, 10.0)
    arrival = np.floor(true + 25 + rng.exponential(5, len(true))).astype(np.int64)
    stamps = stamps_from_arrivals(np.rint(true * (1 - 1e-5)), arrival)
    assert np.abs(stamps - true - 25).max() < 2.0  # ms; the counter alone would be 6 ms off


def test_a_foreign_tag_and_csv_are_named(tmp_path: Path) -> None:
    path = imu_files(tmp_path, "\n", "\n")
    path.with_name("imu.csv.tag").write_bytes(b"something else" * 10)
    with pytest.raises(EgolocError, match=r"imu.csv.tag: expected an RTKLIB time tag"):
        read_imu(path)
    path = imu_files(tmp_path, "\n", "\n")
    path.write_text("a,b,c\n" * 20)
    with pytest.raises(EgolocError, match=r"imu.csv: expected rows ax,ay,az,gx,gy,gz,ms"):
        read_imu(path)


def test_two_solutions_in_a_folder_are_a_mistake(tmp_path: Path) -> None:
    (tmp_path / "a.pos").touch()
    (tmp_path / "b.pos").touch()
    with pytest.raises(EgolocError, match=r"expected one \.pos file, got 2"):
        load("rtklib", tmp_path)


@pytest.fixture(scope="module")
def log(data: Path) -> Log:
    return load("rtklib", data / "rtk_drive")


def test_rtk_drive_is_complete(log: Log) -> None:
    assert log.imu is not None
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    assert (len(log.imu), len(log.gnss), len(log.gnss_velocity)) == (54_858, 2197, 2197)
    assert np.bincount(log.gnss.status).tolist() == [0, 0, 0, 8, 2189]
    shared = min(log.imu.t_ns[-1], log.gnss.t_ns[-1]) - max(log.imu.t_ns[0], log.gnss.t_ns[0])
    assert shared * 1e-9 > 545
    assert log.map_frame is not None
    assert log.map_frame.zone == 13


def test_rtk_drive_has_gravity_up_at_rest(log: Log) -> None:
    assert log.imu is not None
    still = log.imu.accel[100:1000].mean(axis=0)
    assert np.linalg.norm(still) == pytest.approx(9.8, abs=0.15)
    assert still[2] > 9.7


def test_rtk_drive_axes_signs_and_times_agree_with_the_track(log: Log) -> None:
    """Yaw rate and forward acceleration follow the RTK track in the half that no estimate used."""
    assert log.imu is not None
    assert log.gnss_velocity is not None
    late = log.gnss_velocity[len(log.gnss_velocity) // 2 :]
    delay = log.vehicle.gnss_velocity_delay_s
    assert yaw_rate_correlation(log.imu, late, delay, 4.0) > 0.99
    assert forward_correlation(log.imu, late, delay) > 0.97
    worse = [yaw_rate_correlation(log.imu, late, delay + shift, 4.0) for shift in (-0.1, 0.1)]
    assert yaw_rate_correlation(log.imu, late, delay, 4.0) > max(worse)


def test_rtk_drive_clock_offset_holds_in_both_halves(log: Log, data: Path) -> None:
    """The logging latency is 0.26 s (of it 0.13 s by the first tick of the tag); velocity lags position by 0.13 s."""
    vehicle = log.vehicle
    assert vehicle.gnss_delay_s == pytest.approx(-0.263, abs=0.01)
    assert vehicle.gnss_velocity_delay_s - vehicle.gnss_delay_s == pytest.approx(0.13, abs=0.01)
    raw, _ = read_imu(data / "rtk_drive/imu_1934.csv")
    fix, velocity, _ = read_solution(data / "rtk_drive/gnss_1934_sf.pos")
    late = slice(len(fix) // 2, None)
    second = calibrate(raw[raw.t_ns > fix.t_ns[late][0]], *doubled(fix[late], velocity[late]), 0.01)
    assert second.position_clock is not None
    assert second.position_delay_s == pytest.approx(vehicle.gnss_delay_s, abs=0.015)


def doubled(fix, velocity):  # type: ignore[no-untyped-def]
    """Rows whose first half (all that calibrate uses) is the whole, by a last row far ahead."""
    far = np.append(fix.t_ns, fix.t_ns[-1] + (fix.t_ns[-1] - fix.t_ns[0]))
    columns = {"llh": fix.llh, "cov_enu": fix.cov_enu, "status": fix.status}
    more = {name: np.concatenate((column, column[-1:])) for name, column in columns.items()}
    vel = {
        name: np.concatenate((c, c[-1:])) for name, c in (("vel_enu", velocity.vel_enu), ("cov_enu", velocity.cov_enu))
    }
    return type(fix)(far, far, **more), type(velocity)(far, far, **vel)


def test_rtk_drive_mounting_is_the_authors(log: Log, data: Path) -> None:
    """rtklibexplorer's configuration turns the sensor by 180 deg and -0.29, -6.60, 5.35 deg (roll, pitch, yaw, FRD)."""
    raw, _ = read_imu(data / "rtk_drive/imu_1934.csv")
    assert log.imu is not None
    R = np.linalg.lstsq(raw.gyro, log.imu.gyro, rcond=None)[0].T
    yaw = np.degrees(np.arctan2(R[1, 0], R[0, 0]))
    pitch = -np.degrees(np.arcsin(R[2, 0]))
    assert yaw == pytest.approx(180 - 5.35, abs=1.0)
    assert pitch == pytest.approx(-6.60, abs=0.5)
