"""NovAtel ASCII logs, by example lines of the OEM7 manual and lines built with its CRC."""

from pathlib import Path

import numpy as np
import pytest

from sensors.clock import utc_from_gps_week
from sensors.datasets import load
from sensors.datasets.novatel_imu import RAW_SCALES
from sensors.datasets.novatel_lines import crc32
from sensors.errors import EgolocError
from sensors.geodesy import llh_from_map
from sensors.records import GnssStatus
from sensors.rotation import rpy_from_q

MANUAL = {
    "imu": "%RAWIMUSXA,2209,491674.014;04,41,2209,491674.013699,ea59fe00,329308016,-2706935,4508389,"
    "196192,417138,-1000837*038422a7",
    "fix": "#BESTPOSA,USB1,0,58.5,FINESTEERING,2209,502061.000,02000020,cdba,16809;SOL_COMPUTED,PPP,51.15043706870,"
    '-114.03067882331,1097.3462,-17.0001,WGS84,0.0154,0.0139,0.0288,"TSTR",11.000,0.000,43,39,39,38,00,00,7f,37*52483ac5',
    "velocity": "#BESTVELA,USB1,0,57.5,FINESTEERING,2209,502223.000,02000020,10a2,16809;SOL_COMPUTED,PPP,0.250,13.000,"
    "0.0025,28.358727,0.0021,0*e9418656",
    "heading": "#DUALANTENNAHEADINGA,UNKNOWN,0,66.5,FINESTEERING,1949,575614.000,02000000,d426,32768;SOL_COMPUTED,"
    "NARROW_INT,-1.000000000,255.538528442,0.006041416,0.0,0.043859947,0.052394450,"
    '"J56X",24,18,18,17,04,01,00,33*1f082ec5',
}


def checked(content: str) -> str:
    return f"{content}*{crc32(content[1:].encode()):08x}"


def long(name: str, seconds: float, body: str) -> str:
    return checked(f"#{name},COM1,0,50.0,FINESTEERING,2209,{seconds:.3f},02000020,cdba,16809;{body}")


def fix_line(seconds: float, kind: str = "NARROW_INT", status: str = "SOL_COMPUTED") -> str:
    return long("BESTPOSA", seconds, f'{status},{kind},51.0,-114.0,1000.0,-17.0,WGS84,0.02,0.01,0.03,"A",1,0,43')


def imu_line(seconds: float, kind: int = 41, counts: str = "1000,-2000,3000,10,-20,30") -> str:
    return checked(f"%RAWIMUSXA,2209,{seconds:.3f};04,{kind},2209,{seconds:.6f},00000000,{counts}")


def ins_line(seconds: float, status: str = "INS_SOLUTION_GOOD") -> str:
    angles = "2.0,3.0,90.0"
    body = f"{status},INS_RTKFIXED,51.0,-114.0,1000.0,-17.0,0.1,5.0,0.0,{angles},0.02,0.04,0.05,0.01,0.01,0.01"
    return long("INSPVAXA", seconds, body + ",0.1,0.2,0.3,00000003,0")


def written(folder: Path, lines: list[str]) -> Path:
    path = folder / "drive.log"
    path.write_bytes("\r\n".join(lines).encode())
    return path


@pytest.mark.parametrize("name", sorted(MANUAL))
def test_the_crc_is_that_of_the_manual(name: str) -> None:
    content, _, given = MANUAL[name][1:].rpartition("*")
    assert crc32(content.encode()) == int(given, 16)


def test_the_manual_s_lines(tmp_path: Path) -> None:
    log = load("novatel", written(tmp_path, list(MANUAL.values())))
    assert log.imu is not None
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    assert log.left_out == ()
    np.testing.assert_allclose(log.gnss.llh[0, 2], 1097.3462 - 17.0001)
    np.testing.assert_allclose(np.sqrt(np.diag(log.gnss.cov_enu[0])), [0.0139, 0.0154, 0.0288])
    assert log.gnss.status[0] == GnssStatus.FLOAT
    assert log.gnss.t_ns[0] == utc_from_gps_week(np.array([2209]), np.array([502061.0]))[0]
    assert log.gnss_velocity.arrival_ns[0] - log.gnss_velocity.t_ns[0] == 250_000_000
    course = np.radians(28.358727)
    np.testing.assert_allclose(log.gnss_velocity.vel_enu[0], [0.0025 * np.sin(course), 0.0025 * np.cos(course), 0.0021])
    assert log.vehicle.imu.samples == "increment"
    assert log.vehicle.imu.name == "epson-g320"
    assert log.imu.accel[0, 2] == pytest.approx(9.855, abs=0.001)  # gravity: 329308016 * 0.2 / 65536 mg


def test_imu_axes_and_increments(tmp_path: Path) -> None:
    log = load("novatel", written(tmp_path, [fix_line(100.0), imu_line(100.0), imu_line(100.008)]))
    assert log.imu is not None
    accel, gyro = 0.2 / 65536 * 9.80665e-3, np.radians(0.008 / 65536)
    np.testing.assert_allclose(log.imu.accel[0], np.array([2000, -3000, 1000]) * accel)  # FLU of Z, -Y, X
    np.testing.assert_allclose(log.imu.gyro[0], np.array([20, -30, 10]) * gyro)
    assert log.imu.t_ns[1] - log.imu.t_ns[0] == 8_000_000


def test_scales_of_other_units() -> None:
    assert RAW_SCALES[61].rate_hz == 200
    assert RAW_SCALES[61].gyro * 200 == pytest.approx(np.radians(0.0151515 / 65536))
    assert RAW_SCALES[58].accel == 2**-29
    assert RAW_SCALES[26].gyro == 1e-9
    assert RAW_SCALES[5].accel == pytest.approx(2**-27 * 0.3048)


def test_rawimusa_takes_its_type_from_insconfig(tmp_path: Path) -> None:
    short = checked("%RAWIMUSA,2209,100.000;2209,100.000000,00000000,1000,-2000,3000,10,-20,30")
    config = long("INSCONFIGA", 99.0, "EPSON_G320,255,50,20,DEFAULT")
    log = load("novatel", written(tmp_path, [config, fix_line(100.0), short]))
    assert log.imu is not None
    assert log.imu.accel[0, 2] == pytest.approx(1000 * 0.2 / 65536 * 9.80665e-3)
    with pytest.raises(EgolocError, match="RAWIMUSA: IMU type unknown: expected RAWIMUSXA, or INSCONFIGA"):
        load("novatel", written(tmp_path, [fix_line(100.0), short]))
    with pytest.raises(EgolocError, match=r"IMU type: expected one of .*, got 99"):
        load("novatel", written(tmp_path, [fix_line(100.0), imu_line(100.0, kind=99)]))


def test_position_types_become_a_status(tmp_path: Path) -> None:
    kinds = ["NARROW_INT", "NARROW_FLOAT", "PSRDIFF", "SINGLE", "INS_RTKFIXED", "NONE"]
    lines = [fix_line(100.0 + k, kind) for k, kind in enumerate(kinds)]
    log = load("novatel", written(tmp_path, [*lines, fix_line(200.0, status="INSUFFICIENT_OBS")]))
    assert log.gnss is not None
    assert [GnssStatus(s).name for s in log.gnss.status] == ["FIXED", "FLOAT", "DGNSS", "SINGLE", "FIXED"]
    reasons = {(x.reason, x.count) for x in log.left_out}
    assert reasons == {("position type is not GNSS", 1), ("solution not computed", 1)}


def test_gnss_only_positions_are_preferred(tmp_path: Path) -> None:
    alone = fix_line(100.0).replace("#BESTPOSA", "#BESTGNSSPOSA").replace("51.0,", "52.0,").partition("*")[0]
    log = load("novatel", written(tmp_path, [fix_line(100.0), checked(alone)]))
    assert log.gnss is not None
    np.testing.assert_allclose(np.degrees(log.gnss.llh[:, 0]), [52.0])


def test_heading_joins_the_fix_of_its_epoch(tmp_path: Path) -> None:
    body = "SOL_COMPUTED,NARROW_INT,1.0,30.0,0.0,0.0,0.5,0.5"
    lines = [fix_line(100.0), fix_line(101.0), long("DUALANTENNAHEADINGA", 101.0, body)]
    log = load("novatel", written(tmp_path, lines))
    assert log.gnss is not None
    assert np.isnan(log.gnss.yaw[0])
    assert np.degrees(log.gnss.yaw[1]) == pytest.approx(60.0)
    assert np.degrees(log.gnss.yaw_sigma[1]) == pytest.approx(0.5)


def test_inspvax_is_the_reference(tmp_path: Path) -> None:
    lines = [fix_line(100.0), ins_line(100.0), ins_line(101.0, "INS_ALIGNING")]
    log = load("novatel", written(tmp_path, lines))
    assert log.reference is not None
    assert log.map_frame is not None
    np.testing.assert_allclose(llh_from_map(log.map_frame, log.reference.p_map)[0, 2], 983.0)
    roll, pitch, yaw = np.degrees(rpy_from_q(log.reference.q_map_body))[0]
    convergence = 3.0 * np.sin(np.radians(51.0))  # 3 deg east of the zone's meridian
    assert (roll, pitch) == (pytest.approx(2.0), pytest.approx(-3.0))
    assert yaw == pytest.approx(convergence, abs=0.02)  # azimuth 90 deg is east, seen from the grid
    np.testing.assert_allclose(log.reference.sigma[0], [np.sqrt((0.02**2 + 0.04**2) / 2), np.radians(0.3)])
    assert [(x.reason, x.count) for x in log.left_out] == [("INS is not aligned", 1)]


def test_bad_lines_are_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    good = fix_line(100.0)
    early = fix_line(99.0).replace("FINESTEERING", "UNKNOWN").partition("*")[0]
    lines = ["junk\x00\x01", good.replace("51.0", "52.0"), good[:80], checked(early), "garbage" + good, good + "zz"]
    log = load("novatel", written(tmp_path, lines))
    assert log.gnss is not None
    assert len(log.gnss) == 1
    found = {x.reason: x.count for x in log.left_out}
    assert found == {"CRC does not match": 1, "cut line": 2, "no GPS time yet": 1}


def test_a_foreign_file_says_what_was_expected(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match=r"drive\.log: expected NovAtel ASCII logs such as BESTPOSA"):
        load("novatel", written(tmp_path, ["hello", "#OTHERA,1;2*00000000"]))
