"""Argoverse 2 logs: poses, sweeps of both LiDARs, their agreement with the ground, and mistakes."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from pyarrow import feather

from sensors.datasets import frames, load
from sensors.datasets.argoverse2 import POSES, SWEEPS
from sensors.errors import EgolocError
from sensors.geodesy import llh_from_map
from sensors.maps.ground_height import ground_height
from sensors.mcap.frames import read_frames
from sensors.mcap.io import read_log, write_log
from sensors.records import Frame, Trajectory
from sensors.rotation import interpolate_q, matrix_from_q

WITH_SWEEPS = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
WITHOUT = "3b3570b4-7b0b-3268-a571-b0889dbf40b6"
Floats = NDArray[np.float64]


def pose_at(reference: Trajectory, t_ns: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """(N, 3, 3) R_map_body and (N, 3) m between the reference's rows."""
    since = (reference.t_ns - reference.t_ns[0]).astype(np.float64)
    at = (t_ns - reference.t_ns[0]).astype(np.float64)
    p = np.stack([np.interp(at, since, reference.p_map[:, k]) for k in range(3)], axis=1)
    return matrix_from_q(interpolate_q(at, since, reference.q_map_body)), p


def in_map(frame: Frame, reference: Trajectory) -> Floats:
    """(N, 3) points of all sweeps, which are compensated to the frame's time, in map axes."""
    R, p = pose_at(reference, np.array([frame.t_ns]))
    return np.concatenate([sweep.in_body() for sweep in frame.sweeps]) @ R[0].T + p[0]


@pytest.mark.parametrize(
    ("name", "rows", "again", "zone", "lat", "lon"),
    [(WITH_SWEEPS, 2392, 314, 17, 40.46, -79.95), (WITHOUT, 2393, 301, 17, 25.79, -80.19)],
)
def test_poses_are_a_reference(data: Path, name: str, rows: int, again: int, zone: int, lat: float, lon: float) -> None:
    log = load("argoverse2", data / "av2" / name)
    assert log.reference is not None
    assert log.map_frame is not None
    assert (len(log.reference), log.imu, log.map_frame.zone) == (rows, None, zone)
    assert [entry.count for entry in log.left_out] == [again]
    assert np.diff(log.reference.t_ns).min() >= 1000
    llh = llh_from_map(log.map_frame, log.reference.p_map[:1])[0]
    assert np.degrees(llh[:2]) == pytest.approx((lat, lon), abs=0.02)
    moved = np.diff(log.reference.p_map[:, :2], axis=0)[::20]
    fast = np.hypot(*moved.T) > 0.01
    forward = matrix_from_q(log.reference.q_map_body)[:-1:20, :2, 0]
    course = (moved * forward).sum(axis=1) / np.hypot(*moved.T)
    assert fast.sum() > 20
    assert (course[fast] > 0.95).all()  # x is forward


def test_a_log_without_sweeps_has_no_frames(data: Path) -> None:
    assert list(frames("argoverse2", data / "av2" / WITHOUT)) == []


def test_both_lidars_of_every_sweep(data: Path) -> None:
    first, second = frames("argoverse2", data / "av2" / WITH_SWEEPS)
    assert (first.t_ns, second.t_ns) == (315966265259836000, 315966265360032000)
    assert [len(sweep) for sweep in first.sweeps] == [51785, 47444]
    assert [len(sweep) for sweep in second.sweeps] == [51807, 47659]
    assert first.arrival_ns - first.t_ns == max(int(sweep.offset_ns.max()) for sweep in first.sweeps)
    for up, down in (first.sweeps, second.sweeps):
        assert up.compensated
        assert up.T_body_lidar[2, 3] == pytest.approx(1.64042)
        assert down.T_body_lidar[2, 3] == pytest.approx(1.5254962)
        assert set(np.unique(up.ring)) <= set(range(32))
        assert np.unique(down.ring).tolist() == list(range(32))


def test_points_are_compensated_to_the_frames_time(data: Path) -> None:
    """A laser keeps its elevation where it really was: at the offset of each point, and not at the stamp."""
    folder = data / "av2" / WITH_SWEEPS
    reference = load("argoverse2", folder).reference
    assert reference is not None
    for frame in frames("argoverse2", folder):
        R0, p0 = pose_at(reference, np.array([frame.t_ns]))
        for sweep in frame.sweeps:
            then = pose_at(reference, frame.t_ns + sweep.offset_ns.astype(np.int64))
            world = sweep.in_body() @ R0[0].T + p0[0]
            spread = [_elevation_spread(world, sweep, R, p) for R, p in (then, (R0, p0))]
            assert spread[0] < 0.01
            assert spread[1] > 0.03


def _elevation_spread(world: Floats, sweep: object, R: Floats, p: Floats) -> float:
    """Median over lasers of how far the elevations of near points lie from their median, deg."""
    T = sweep.T_body_lidar  # type: ignore[attr-defined]
    body = np.einsum("nji,nj->ni", np.broadcast_to(R, (len(world), 3, 3)), world - p)
    seen = (body - T[:3, 3]) @ T[:3, :3]
    distance = np.linalg.norm(seen, axis=1)
    elevation = np.degrees(np.arcsin(seen[:, 2] / distance))
    spread = []
    for laser in range(32):
        mine = elevation[(sweep.ring == laser) & (distance > 3.0) & (distance < 10.0)]  # type: ignore[attr-defined]
        if len(mine) > 200:
            spread.append(np.percentile(np.abs(mine - np.median(mine)), 68))
    assert len(spread) >= 5
    return float(np.median(spread))


def test_sweeps_lie_on_the_ground_and_on_each_other(data: Path) -> None:
    """Points by the poses, against the log's raster of ground heights (0.3 m cells), and sweep against sweep."""
    folder = data / "av2" / WITH_SWEEPS
    reference = load("argoverse2", folder).reference
    assert reference is not None
    above = []
    for frame in frames("argoverse2", folder):
        points = in_map(frame, reference)
        near = points[np.linalg.norm(points[:, :2] - points[:, :2].mean(axis=0), axis=1) < 40.0]
        height = near[:, 2] - ground_height(folder / "map", near[:, :2])
        road = np.abs(height) < 0.3
        assert road.sum() > 10_000
        assert abs(np.median(height[road])) < 0.02
        assert np.median(np.abs(height[road])) < 0.05
        cells = np.floor(near[road] / 0.5).astype(np.int64)[:, :2]
        above.append({tuple(cell): z for cell, z in zip(cells.tolist(), near[road, 2].tolist(), strict=True)})
    both = above[0].keys() & above[1].keys()
    difference = np.array([above[0][cell] - above[1][cell] for cell in both])
    assert len(both) > 1000
    assert abs(np.median(difference)) < 0.01
    assert np.median(np.abs(difference)) < 0.03


def test_a_log_comes_back_exactly(data: Path, tmp_path: Path) -> None:
    folder = data / "av2" / WITH_SWEEPS
    log, sent = load("argoverse2", folder), list(frames("argoverse2", folder))
    write_log(tmp_path / "a.mcap", log, frames=frames("argoverse2", folder))
    found = read_log(tmp_path / "a.mcap")
    assert log.reference is not None
    assert found.reference is not None
    assert found.map_frame == log.map_frame
    np.testing.assert_array_equal(found.reference.p_map, log.reference.p_map)
    np.testing.assert_array_equal(found.reference.t_ns, log.reference.t_ns)
    for got, frame in zip(read_frames(tmp_path / "a.mcap"), sent, strict=True):
        assert (got.t_ns, got.arrival_ns) == (frame.t_ns, frame.arrival_ns)
        for a, b in zip(got.sweeps, frame.sweeps, strict=True):
            for name in ("xyz", "offset_ns", "intensity", "ring"):
                np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)
            np.testing.assert_allclose(a.T_body_lidar, b.T_body_lidar, rtol=0, atol=1e-15)
            assert a.compensated


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """A small log: three poses, one sweep of four points, no map."""
    folder = tmp_path / "log"
    (folder / SWEEPS).mkdir(parents=True)
    (folder / "calibration").mkdir()
    turn = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}
    rows = [{"timestamp_ns": 10**9 * k, **turn, "tx_m": float(k), "ty_m": 0.0, "tz_m": 0.0} for k in (1, 2, 3)]
    feather.write_feather(pa.Table.from_pylist(rows), folder / POSES)
    lidars = [
        {"sensor_name": name, **turn, "tx_m": 1.0, "ty_m": 0.0, "tz_m": 2.0} for name in ("down_lidar", "up_lidar")
    ]
    feather.write_feather(pa.Table.from_pylist(lidars), folder / "calibration/egovehicle_SE3_sensor.feather")
    write_sweep(folder)
    return folder


def write_sweep(folder: Path, **changed: object) -> None:
    columns = {
        "x": np.float16([1, 2, 3, 4]), "y": np.float16([0, 0, 0, 0]), "z": np.float16([2, 2, 2, np.nan]),
        "intensity": np.uint8([1, 2, 3, 4]), "laser_number": np.uint8([0, 32, 63, 5]),
        "offset_ns": np.int32([0, 1, 2, 3]),
    } | changed  # fmt: skip
    feather.write_feather(pa.table(columns), folder / SWEEPS / "2000000000.feather")


def test_a_small_log(made: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = load("argoverse2", made)
    assert log.map_frame is None
    assert [entry.source for entry in log.left_out] == ["map"]
    (frame,) = frames("argoverse2", made)
    up, down = frame.sweeps
    assert (frame.t_ns, frame.arrival_ns) == (2 * 10**9, 2 * 10**9 + 3)
    assert up.xyz.tolist() == [[0, 0, 0]]
    assert down.xyz.tolist() == [[1, 0, 0], [2, 0, 0]]
    assert (down.ring.tolist(), down.intensity.tolist(), down.offset_ns.tolist()) == ([0, 31], [2, 3], [1, 2])
    assert "1 points left out that are not finite" in caplog.text


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"laser_number": np.uint8([0, 64, 1, 2])}, "laser_number: expected 0 to 63, got 0 to 64"),
        ({"offset_ns": np.int64([0, 0, 0, 1 << 40])}, "offset_ns: expected less than 1.07 s"),
        ({"offset_ns": np.float32([0, 0, 0, 0])}, "expected integers, got uint8 and float32"),
        ({"x": ["a", "b", "c", "d"]}, "column x: expected numbers, got string"),
        ({"intensity": pa.array([1, None, 2, 3])}, "column intensity: expected numbers"),
    ],
)
def test_sweeps_that_are_none(made: Path, changed: dict[str, object], told: str) -> None:
    write_sweep(made, **changed)
    with pytest.raises(EgolocError, match=told) as raised:
        list(frames("argoverse2", made))
    assert "2000000000.feather" in str(raised.value)


def test_files_that_are_damaged(made: Path) -> None:
    shutil.copy(made / SWEEPS / "2000000000.feather", made / SWEEPS / "sweep.feather")
    with pytest.raises(EgolocError, match=r"sweep.feather: expected a sweep's stamp in ns as the file's name"):
        list(frames("argoverse2", made))
    (made / SWEEPS / "sweep.feather").unlink()
    (made / "calibration/egovehicle_SE3_sensor.feather").write_bytes(b"no feather")
    with pytest.raises(EgolocError, match="expected a feather file") as raised:
        list(frames("argoverse2", made))
    assert "\n" not in str(raised.value)
    feather.write_feather(pa.table({"timestamp_ns": [1]}), made / POSES)
    with pytest.raises(EgolocError, match="column qx: not there, the file has timestamp_ns"):
        load("argoverse2", made)
