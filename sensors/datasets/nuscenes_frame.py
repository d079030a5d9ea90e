"""nuScenes keyframes that somebody has put aside: a folder of images, LiDAR sweeps and calibration.json.

calibration.json is an info file of mmdetection3d (version 1.1) as JSON: ``data_list`` with, for each keyframe, where
the vehicle was, its cameras, and its sweep. The tables of the nuScenes devkit itself are not read.

The body is nuScenes' ego vehicle (forward-left-up, under the middle of the rear axle on the ground). A sweep's stamp is
the end of its turn; nuScenes says that its points are compensated to it, which the images bear out (docs/datasets.md).
``cam2ego`` is the camera's place on the body. ``lidar2cam`` also holds how the vehicle moved from the camera's exposure
to the sweep's stamp, so that its poses at every exposure can be had: they are the reference, seven for each keyframe.
Its positions are those of the place's own map, which the file does not name, with heights of 0: no map frame.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.images import Image, format_of, size_of
from sensors.records import LeftOut, Log, Trajectory
from sensors.rotation import check_rigid, q_from_matrix

Floats = NDArray[np.float64]

CALIBRATION = "calibration.json"
_POINT = 5
"""float32 numbers of a point: x y z intensity ring."""
_RINGS = 32


def load(src: Path) -> Log:
    """The poses at which the keyframes were taken, as reference."""
    poses: dict[int, Floats] = {}
    for entry in _entries(src):
        T_map_body = _pose(src, entry, "ego2global")
        T_body_lidar = _pose(src, entry, "lidar_points.lidar2ego")
        poses[_stamp(src, entry, "timestamp")] = T_map_body
        for name in _cameras(src, entry):
            T_camera_body = np.linalg.inv(_pose(src, entry, f"images.{name}.cam2ego"))
            T_camera_lidar = _pose(src, entry, f"images.{name}.lidar2cam")
            # from the body at the sweep's stamp to the body at the exposure
            moved = np.linalg.inv(T_camera_body) @ T_camera_lidar @ np.linalg.inv(T_body_lidar)
            poses.setdefault(_stamp(src, entry, f"images.{name}.timestamp"), T_map_body @ np.linalg.inv(moved))
    t_ns = np.array(sorted(poses), np.int64)
    T = np.stack([poses[int(t)] for t in t_ns])
    trajectory = Trajectory(t_ns, t_ns, T[:, :3, 3], q_from_matrix(T[:, :3, :3]))
    left_out = (LeftOut("map", "the file does not name the place: positions have no map frame", 1),)
    return Log(reference=trajectory, left_out=left_out)


def frames(src: Path) -> Iterator[Frame]:
    """The keyframes by time, each read when its turn comes."""
    for entry in sorted(_entries(src), key=lambda entry: _stamp(src, entry, "timestamp")):
        t_ns = _stamp(src, entry, "timestamp")
        images = tuple(_image(src, entry, name) for name in _cameras(src, entry))
        yield Frame(t_ns, max([t_ns, *(image.t_ns for image in images)]), (_sweep(src, entry),), images)


def _sweep(src: Path, entry: Mapping[str, Any]) -> Sweep:
    path = src / _text(src, entry, "lidar_points.lidar_path")
    data = _bytes(path)
    if len(data) % (4 * _POINT):
        raise EgolocError(f"{path}: expected {_POINT} float32 numbers a point, got {len(data)} bytes")
    points = np.frombuffer(data, "<f4").reshape(-1, _POINT)
    if not np.isfinite(points).all():
        raise EgolocError(f"{path}: expected finite numbers, got NaN or Inf")
    ring = points[:, 4]
    if not ((ring >= 0) & (ring < _RINGS) & (ring == np.rint(ring))).all():
        raise EgolocError(f"{path}: ring: expected whole numbers of 0 to {_RINGS - 1}")
    T = _pose(src, entry, "lidar_points.lidar2ego")
    xyz, intensity = points[:, :3], points[:, 3]
    return Sweep(xyz, T, intensity=intensity, ring=ring.astype(np.int16), compensated=True)


def _image(src: Path, entry: Mapping[str, Any], name: str) -> Image:
    path = src / _text(src, entry, f"images.{name}.img_path")
    data = _bytes(path)
    found = format_of(data)
    if found is None:
        raise EgolocError(f"{path}: expected a JPEG or PNG")
    K = _matrix(src, entry, f"images.{name}.cam2img", 3)
    T = _pose(src, entry, f"images.{name}.cam2ego")
    t_ns = _stamp(src, entry, f"images.{name}.timestamp")
    try:
        return Image(data, found, *size_of(data, str(path)), K, T, t_ns, name)
    except EgolocError as error:
        raise EgolocError(f"{src / CALIBRATION}: images.{name}: {error}") from None


def _entries(src: Path) -> list[dict[str, Any]]:
    """The keyframes of calibration.json."""
    if not src.is_dir():
        raise EgolocError(f"{src}: expected a folder with {CALIBRATION}, images and sweeps")
    path = src / CALIBRATION
    try:
        read = json.loads(_bytes(path))
    except ValueError as error:
        raise EgolocError(f"{path}: expected JSON: {error}") from None
    entries = read.get("data_list") if isinstance(read, dict) else None
    if not (isinstance(entries, list) and entries and all(isinstance(entry, dict) for entry in entries)):
        raise EgolocError(f"{path}: data_list: expected a list of keyframes, got {type(entries).__name__}")
    return entries


def _cameras(src: Path, entry: Mapping[str, Any]) -> list[str]:
    """Names of a keyframe's cameras."""
    images = _field(src, entry, "images")
    if not isinstance(images, dict):
        raise EgolocError(f"{src / CALIBRATION}: images: expected an object, got {type(images).__name__}")
    return list(images)


def _field(src: Path, entry: Mapping[str, Any], name: str) -> Any:
    """A field of a keyframe by its path, with dots."""
    value: Any = entry
    for key in name.split("."):
        if not (isinstance(value, dict) and key in value):
            raise EgolocError(f"{src / CALIBRATION}: {name}: expected it in every keyframe, got none")
        value = value[key]
    return value


def _matrix(src: Path, entry: Mapping[str, Any], name: str, size: int) -> Floats:
    value = _field(src, entry, name)
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (size, size):
        raise EgolocError(f"{src / CALIBRATION}: {name}: expected {size} x {size} numbers, got {str(value)[:40]}")
    return matrix


def _pose(src: Path, entry: Mapping[str, Any], name: str) -> Floats:
    T = _matrix(src, entry, name, 4)
    try:
        check_rigid(name, T)
    except EgolocError as error:
        raise EgolocError(f"{src / CALIBRATION}: {error}") from None
    return T


def _stamp(src: Path, entry: Mapping[str, Any], name: str) -> int:
    """Seconds since 1970 as ns; nuScenes counts whole microseconds."""
    value = _field(src, entry, name)
    if not (isinstance(value, int | float) and 0.0 < value < 4e9):
        raise EgolocError(f"{src / CALIBRATION}: {name}: expected seconds since 1970, got {value!r}")
    return round(value * 1e6) * 1000


def _text(src: Path, entry: Mapping[str, Any], name: str) -> str:
    """The name of a file beside calibration.json."""
    value = _field(src, entry, name)
    if not (isinstance(value, str) and value and Path(value).name == value):
        raise EgolocError(f"{src / CALIBRATION}: {name}: expected a file's name, got {value!r}")
    return value


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise EgolocError(f"{path}: cannot be read: {error.strerror}") from None
