"""nuScenes keyframes: the real one, how well its points line up with its images, and mistakes."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from sensors.datasets import frames, load
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.mcap.frames import read_frames
from sensors.mcap.io import read_log, write_log
from sensors.motion import Motion, Standing, along, points_at

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def folder(data: Path) -> Path:
    return data / "nuscenes_frame"


@pytest.fixture(scope="module")
def frame(folder: Path) -> Frame:
    (found,) = frames("nuscenes-frame", folder)
    return found


@pytest.fixture(scope="module")
def motion(folder: Path) -> Motion:
    reference = load("nuscenes-frame", folder).reference
    assert reference is not None
    return along(reference)


def test_the_real_frame(frame: Frame) -> None:
    (sweep,) = frame.sweeps
    assert (frame.t_ns, len(sweep), sweep.compensated) == (1532402927647951000, 34688, True)
    assert (sweep.ring.min(), sweep.ring.max(), sweep.intensity.max()) == (0, 31, 255.0)
    late = {image.name: (image.t_ns - frame.t_ns) // 1000 for image in frame.images}
    assert late == {"CAM_FRONT": -35491, "CAM_FRONT_RIGHT": -27612, "CAM_FRONT_LEFT": -43107, "CAM_BACK": -10426,
                    "CAM_BACK_LEFT": -528, "CAM_BACK_RIGHT": -20058}  # fmt: skip
    for image in frame.images:
        assert image.rgb().shape == (900, 1600, 3)


def test_the_reference_is_where_the_exposures_were(folder: Path, frame: Frame, motion: Motion) -> None:
    """lidar2cam of the file, by way of the reference and the camera's place: to 0.1 mm and 1e-6."""
    log = load("nuscenes-frame", folder)
    assert log.reference is not None
    speed = np.linalg.norm(np.diff(log.reference.p_map[:, :2], axis=0), axis=1) / (np.diff(log.reference.t_ns) * 1e-9)
    assert np.ptp(speed[:-1]) < 0.3
    assert speed.mean() == pytest.approx(9.3, abs=0.2)
    entry = json.loads((folder / "calibration.json").read_text())["data_list"][0]
    for image in frame.images:
        told = np.array(entry["images"][image.name]["lidar2cam"])
        p_lidar = frame.sweeps[0].xyz[::500].astype(np.float64)
        expected = p_lidar @ told[:3, :3].T + told[:3, 3]
        body = points_at(frame.sweeps[0], frame.t_ns, motion, image.t_ns)[::500]
        found = body @ image.T_camera_body[:3, :3].T + image.T_camera_body[:3, 3]
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-4)


def edge_points(frame: Frame) -> NDArray[np.intp]:
    """Points at the near side of a jump in distance between neighbours of a ring: poles, trunks, corners, cars."""
    distance = np.linalg.norm(frame.sweeps[0].xyz, axis=1).reshape(-1, 32)  # 32 rings are fired one after the other
    jump = np.maximum(np.roll(distance, 1, 0), np.roll(distance, -1, 0)) - distance
    return np.flatnonzero((jump > np.maximum(0.5, 0.1 * distance)) & (distance > 3.0) & (distance < 40.0))


def upright_edges(frame: Frame) -> dict[str, Floats]:
    """How upright an edge is near each pixel of each image, in units of the image's mean."""
    found = {}
    for image in frame.images:
        grey = ndimage.gaussian_filter(image.rgb().mean(axis=2), 1.0)
        slope = np.abs(ndimage.sobel(grey, axis=1))
        slope = ndimage.gaussian_filter(np.minimum(slope, np.percentile(slope, 97)), 2.0)
        found[image.name] = slope / slope.mean()
    return found


@pytest.fixture(scope="module")
def edges(frame: Frame) -> dict[str, Floats]:
    return upright_edges(frame)


def agreement(
    frame: Frame, edges: Mapping[str, Floats], motion: Motion, turn_deg: tuple[str, float] = ("y", 0.0)
) -> Floats:
    """By image, how upright the edges are where LiDAR edges appear; turn_deg: of the cameras about their own axis."""
    rows, found = edge_points(frame), []
    turn = Rotation.from_euler(*turn_deg, degrees=True).as_matrix()
    for image in frame.images:
        T = image.T_body_camera.copy()
        T[:3, :3] = T[:3, :3] @ turn
        seen = replace(image, T_body_camera=T).seen(points_at(frame.sweeps[0], frame.t_ns, motion, image.t_ns)[rows])
        column, row = seen.pixels[seen.inside].T
        found.append(ndimage.map_coordinates(edges[image.name], [row, column], order=1).mean())
    return np.array(found)


def test_points_line_up_with_the_images(frame: Frame, edges: Mapping[str, Floats], motion: Motion) -> None:
    """Edges of the sweep lie on edges of the images; less so with cameras turned by 1 deg (25 pixels) to either side,
    and the most within 0.25 deg of the calibration."""
    assert len(edge_points(frame)) > 400
    best = agreement(frame, edges, motion)
    assert best.mean() > 1.8
    for turn in (-1.0, 1.0):
        turned = agreement(frame, edges, motion, ("y", turn))
        assert turned.mean() < 0.75 * best.mean()
        assert (turned < best).sum() >= 5  # of six
    for turn in (-1.0, 1.0):
        assert agreement(frame, edges, motion, ("x", turn)).mean() < 0.95 * best.mean()
    turns = np.arange(-1.5, 1.51, 0.25)
    mean = [agreement(frame, edges, motion, ("y", turn)).mean() for turn in turns]
    assert abs(turns[np.argmax(mean)]) <= 0.25


def test_the_motion_between_sweep_and_exposures_counts(
    frame: Frame, edges: Mapping[str, Floats], motion: Motion
) -> None:
    """The vehicle moved 0.4 m before the left front camera's exposure was the sweep's stamp: that camera shows it."""
    moved, stood = agreement(frame, edges, motion), agreement(frame, edges, Standing())
    left = [image.name for image in frame.images].index("CAM_FRONT_LEFT")
    assert stood[left] < 0.6 * moved[left]
    assert stood.mean() < 0.9 * moved.mean()


def test_it_comes_back_from_a_log(folder: Path, frame: Frame, tmp_path: Path) -> None:
    log = load("nuscenes-frame", folder)
    write_log(tmp_path / "a.mcap", log, frames=[frame])
    (found,) = read_frames(tmp_path / "a.mcap")
    assert [image.data for image in found.images] == [image.data for image in frame.images]
    np.testing.assert_array_equal(found.sweeps[0].xyz, frame.sweeps[0].xyz)
    back = read_log(tmp_path / "a.mcap").reference
    assert back is not None
    assert log.reference is not None
    np.testing.assert_array_equal(back.p_map, log.reference.p_map)


@pytest.fixture
def copied(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "frame", copy_function=shutil.copyfile))


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        (("images", "CAM_BACK", "cam2ego"), None, r"images\.CAM_BACK\.cam2ego: expected it in every keyframe"),
        (("images", "CAM_BACK", "cam2ego"), [[1, 2], [3, 4]], r"cam2ego: expected 4 x 4 numbers, got \[\[1, 2\]"),
        (("images", "CAM_BACK", "cam2ego"), np.zeros((4, 4)).tolist(), "cam2ego: expected a rigid transform"),
        (("images", "CAM_BACK", "cam2img"), np.eye(4).tolist(), "cam2img: expected 3 x 3 numbers"),
        (("images", "CAM_BACK", "cam2img"), (-np.eye(3)).tolist(), "CAM_BACK: Image.K: expected fx, fy > 0"),
        (("images", "CAM_BACK", "timestamp"), "now", r"CAM_BACK\.timestamp: expected seconds since 1970, got 'now'"),
        (("images", "CAM_BACK", "img_path"), "../a.jpg", r"img_path: expected a file's name, got '\.\./a\.jpg'"),
        (("images", "CAM_BACK", "img_path"), "a.jpg", "a.jpg: cannot be read: No such file"),
        (("images", "CAM_BACK", "img_path"), "calibration.json", "calibration.json: expected a JPEG or PNG"),
        (("lidar_points", "lidar_path"), "calibration.json", "calibration.json: expected"),
        (("images",), [], "images: expected an object, got list"),
    ],
)
def test_calibrations_that_are_none(copied: Path, path: tuple[str, ...], value: Any, told: str) -> None:
    file = copied / "calibration.json"
    content = json.loads(file.read_text())
    at = content["data_list"][0]
    for key in path[:-1]:
        at = at[key]
    if value is None:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    file.write_text(json.dumps(content))
    with pytest.raises(EgolocError, match=told) as raised:
        (load("nuscenes-frame", copied), list(frames("nuscenes-frame", copied)))
    assert "\n" not in str(raised.value)


def test_sweeps_and_files_that_are_none(copied: Path) -> None:
    (sweep,) = copied.glob("*LIDAR_TOP*")
    points = np.fromfile(sweep, "<f4").reshape(-1, 5)
    points[7, 4] = 32.0
    sweep.write_bytes(points.tobytes())
    with pytest.raises(EgolocError, match="ring: expected whole numbers of 0 to 31"):
        list(frames("nuscenes-frame", copied))
    sweep.write_bytes(points.tobytes()[:-3])
    with pytest.raises(EgolocError, match="expected 5 float32 numbers a point"):
        list(frames("nuscenes-frame", copied))
    (copied / "calibration.json").write_text("{}")
    with pytest.raises(EgolocError, match="data_list: expected a list of keyframes, got NoneType"):
        load("nuscenes-frame", copied)
    (copied / "calibration.json").write_text("{")
    with pytest.raises(EgolocError, match=r"calibration\.json: expected JSON"):
        load("nuscenes-frame", copied)
    with pytest.raises(EgolocError, match=r"expected a folder with calibration\.json"):
        load("nuscenes-frame", copied / "calibration.json")
