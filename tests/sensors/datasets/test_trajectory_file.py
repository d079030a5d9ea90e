"""Trajectory files: TUM, CSV with named columns, Applanix."""

from pathlib import Path

import numpy as np
import pytest

from sensors.datasets.trajectory_file import read_trajectory
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, map_from_llh
from sensors.records import Trajectory
from sensors.rotation import rpy_from_q, wrap, yaw_from_q

ENU = MapFrame("enu", (48.0, 11.0, 500.0))


def read(folder: Path, text: str, frame: MapFrame | None = None) -> tuple[Trajectory, MapFrame | None]:
    path = folder / "truth.txt"
    path.write_text(text)
    return read_trajectory(path, frame)


def test_tum(tmp_path: Path) -> None:
    text = "# t x y z qx qy qz qw\n1700000000.123456789 1 2 3 0 0 0 2\n1700000001.5 4 5 6 0 0 0.70710678 0.70710678\n"
    found, frame = read(tmp_path, text)
    assert frame is None
    assert found.t_ns.tolist() == [1_700_000_000_123_456_789, 1_700_000_001_500_000_000]
    np.testing.assert_allclose(found.p_map, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(found.q_map_body[0], [0, 0, 0, 1])
    np.testing.assert_allclose(np.degrees(yaw_from_q(found.q_map_body)), [0, 90], atol=1e-6)
    assert np.isnan(found.sigma).all()


@pytest.mark.parametrize(
    ("name", "cell"),
    [
        ("t_ns", "1700000000123456789"),
        ("t_s", "1700000000.123456789"),
        ("timestamp", "1700000000123456789"),
        ("timestamp", "1700000000123456.789"),
        ("timestamp", "1700000000123.456789"),
        ("timestamp", "1700000000.123456789"),
    ],
)
def test_times_are_exact_in_every_unit(tmp_path: Path, name: str, cell: str) -> None:
    found, _ = read(tmp_path, f"{name},x,y\n{cell},1,2\n", ENU)
    assert found.t_ns.tolist() == [1_700_000_000_123_456_789]
    assert found.p_map.tolist() == [[1, 2, 0]]


@pytest.mark.parametrize(
    ("columns", "cells", "rpy_deg"),
    [
        ("yaw", "0.5", (0, 0, np.degrees(0.5))),
        ("yaw_deg", "30", (0, 0, 30)),
        ("roll,pitch,yaw", "0.1,0.2,0.3", tuple(np.degrees([0.1, 0.2, 0.3]))),
        ("roll_deg,pitch_deg,yaw_deg", "1,2,3", (1, 2, 3)),
        ("qx,qy,qz,qw", "0,0,1,0", (0, 0, 180)),
    ],
)
def test_attitudes(tmp_path: Path, columns: str, cells: str, rpy_deg: tuple[float, ...]) -> None:
    found, _ = read(tmp_path, f"t_s,x,y,z,{columns},sigma_m\n1,1,2,3,{cells},0.05\n", ENU)
    np.testing.assert_allclose(np.degrees(rpy_from_q(found.q_map_body))[0], rpy_deg, atol=1e-9)
    assert found.sigma[0, 0] == 0.05
    assert np.isnan(found.sigma[0, 1])


def test_geodetic_positions_land_in_the_map(tmp_path: Path) -> None:
    text = "t_s,lat_deg,lon_deg,height_m,yaw_deg\n1,48.01,11.02,510,90\n2,48.02,11.02,510,90\n"
    found, frame = read(tmp_path, text, ENU)
    assert frame is ENU
    expected = map_from_llh(ENU, [[np.radians(48.01), np.radians(11.02), 510.0]])
    np.testing.assert_allclose(found.p_map[:1], expected)
    own, made = read(tmp_path, text)
    assert made is not None
    assert (made.kind, made.zone) == ("utm", 32)
    north = own.p_map[1] - own.p_map[0]
    assert yaw_from_q(own.q_map_body)[0] == pytest.approx(np.arctan2(north[1], north[0]), abs=1e-5)  # convergence


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("1 2 3 4 5 6 7\n", "line 1: expected the 8 columns t x y z qx qy qz qw, got 7"),
        ("1 2 3 4 5 6 7 8\n1 2 3 four 5 6 7 8\n", "column z: expected a number, got 'four'"),
        ("time,x,y\n1,2,3\n", "column t_ns: not there"),
        ("t_s,x,z\n1,2,3\n", "column y: not there"),
        ("t_s,lat_deg\n1,2\n", "column lon_deg: not there"),
        ("t_s,x,y,qx,qy,qz\n1,2,3,0,0,0\n", "column qw: not there"),
        ("t_s,x,y,roll\n1,2,3,0\n", "column yaw: not there"),
        ("t_s,x,y\n1,2,b\n", "line 2: column y: expected a number, got 'b'"),
        ("t_s,x,y\n1,2\n", "line 2: expected 3 columns, got 2"),
        ("t_s,x,y\nnan,2,3\n", "column t_s: expected times"),
        ("t_s,x,y\n1,nan,3\n", "no usable row of 1"),
        ("GPSTime,easting,northing\n1,2,3\n", "column altitude: not there"),
    ],
)
def test_mistakes_name_the_column(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(EgolocError) as raised:
        read(tmp_path, text, ENU)
    assert message in str(raised.value)
    assert "truth.txt" in str(raised.value)


def test_rows_that_go_back_are_left_out_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    found, _ = read(tmp_path, "t_s,x,y\n1,1,1\n2,2,2\n1.5,3,3\n3,nan,4\n4,5,5\n", ENU)
    assert found.p_map[:, 0].tolist() == [1, 2, 5]
    assert "1 rows left out: stamp goes back" in caplog.text
    assert "1 rows left out: not finite" in caplog.text


def test_applanix_is_verified_by_its_own_course(data: Path) -> None:
    path = next((data / "boreas").glob("*_poses.csv"))
    found, frame = read_trajectory(path, None)
    assert frame is not None
    assert (frame.kind, frame.zone, frame.origin) == ("utm", 17, (623000.0, 4848000.0, 0.0))
    t = (found.t_ns - found.t_ns[0]) * 1e-9
    velocity = np.gradient(found.p_map, t, axis=0)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    fast = speed > 5
    roll, pitch, yaw = rpy_from_q(found.q_map_body)[fast].T
    course = np.arctan2(velocity[:, 1], velocity[:, 0])
    turn = wrap(course[fast] - yaw)
    slope = np.arctan2(velocity[:, 2], speed)[fast]
    assert abs(np.degrees(np.median(turn))) < 0.05
    assert np.percentile(np.abs(np.degrees(turn)), 90) < 1.5
    assert np.corrcoef(pitch, slope)[0, 1] < -0.9
    assert np.polyfit(slope, pitch, 1)[0] == pytest.approx(-1.0, abs=0.05)
    lateral = speed[fast] * np.gradient(np.unwrap(course), t)[fast]
    assert np.corrcoef(roll, lateral)[0, 1] > 0.1  # leans out of the turn: left turn, right side down
    assert np.linalg.norm(np.diff(found.p_map, axis=0), axis=1).sum() == pytest.approx(7940, abs=5)


def test_applanix_goes_into_a_given_frame(data: Path) -> None:
    path = next((data / "boreas").glob("*_poses.csv"))
    own, frame = read_trajectory(path, None)
    assert frame is not None
    shifted, _ = read_trajectory(path, MapFrame("utm", (0.0, 0.0, 100.0), 17))
    np.testing.assert_allclose(shifted.p_map, own.p_map + np.array([623000, 4848000, -100]), atol=1e-6)
    local, given = read_trajectory(path, MapFrame("enu", (43.78, -79.466, 153.0)))
    assert given is not None
    assert given.kind == "enu"
    assert np.linalg.norm(local.p_map[0]) < 500
