"""Argoverse 2 sensor and LiDAR logs: a folder with city_SE3_egovehicle.feather, calibration/, sensors/ and map/.

The ego vehicle's axes are forward-left-up with the origin in the middle of the rear axle; they become the body. Its
poses in city coordinates become the reference, in the city's UTM frame (``sensors.maps.argoverse2``); heights keep the
data set's own datum, which is not published. There is no IMU.

A sweep holds the points of two LiDARs of 32 beams, one above the other: lasers 0 to 31 are up_lidar, the others
down_lidar. av2-api says of sweeps (``av2.structures.sweep``): the points are in ego axes and compensated to the stamp
of the file's name, the sweep's start, and offset_ns counts from there. A real log shows the same: within 10 m the
elevations of each laser's points differ by 0.004 deg if they are seen from where the LiDAR was at their offset, by 0.04
to 0.1 deg if they are seen from where it was at the stamp; and lasers 32 to 63 have a VLP-32C's elevations in the axes
of down_lidar. Coordinates have half precision: steps of 3 cm from 32 m on, 6 cm from 64 m on.
"""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.datasets.argoverse2_cameras import CameraFolder
from sensors.datasets.feather_table import column, columns, stamps, table
from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.geodesy import MapFrame
from sensors.images import Image
from sensors.maps.argoverse2 import city_frame
from sensors.records import LeftOut, Log, Trajectory
from sensors.rotation import matrix_from_q
from sensors.screening import screen

Floats = NDArray[np.float64]

POSES = "city_SE3_egovehicle.feather"
CALIBRATION = "calibration/egovehicle_SE3_sensor.feather"
SWEEPS = "sensors/lidar"
LIDARS = ("up_lidar", "down_lidar")
"""In the order of their lasers."""
LASERS = 32
"""Of each LiDAR."""
SAME_POSE_NS = 1000
"""A pose this short after another is the same again: the file repeats some of them, up to 15 ns later."""

_QUATERNION = ("qx", "qy", "qz", "qw")
_PLACE = ("tx_m", "ty_m", "tz_m")
_POINT = ("x", "y", "z", "intensity", "laser_number", "offset_ns")

log = logging.getLogger(__name__)


def load(src: Path) -> Log:
    """The poses of a log's folder as reference."""
    if not src.is_dir():
        raise EgolocError(f"{src}: expected the folder of an Argoverse 2 log")
    path = src / POSES
    read = table(path, ("timestamp_ns", *_QUATERNION, *_PLACE))
    t_ns, q, p = stamps(path, read), columns(path, read, _QUATERNION), columns(path, read, _PLACE)
    again = np.zeros(len(t_ns), bool)
    again[1:] = (np.diff(t_ns) >= 0) & (np.diff(t_ns) < SAME_POSE_NS)
    sound = {"not finite": np.isfinite(p).all(axis=1), "no rotation": np.abs(np.linalg.norm(q, axis=1) - 1.0) < 1e-3}
    keep, left_out = screen(path.name, t_ns, t_ns, sound | {f"the same pose within {SAME_POSE_NS} ns": ~again})
    if not keep.any():
        raise EgolocError(f"{path}: no usable pose of {len(t_ns)}")
    frame = _map_frame(src)
    if frame is None:
        left_out = (*left_out, LeftOut("map", "no file names a known city: positions have no map frame", 1))
    return Log(reference=Trajectory(t_ns[keep], t_ns[keep], p[keep], q[keep]), map_frame=frame, left_out=left_out)


def frames(src: Path) -> Iterator[Frame]:
    """The LiDAR sweeps of a log's folder by time, with the images near each, read when its turn comes.

    A frame arrives with its last point or image.
    """
    paths = sorted((_stamp_of(path), path) for path in (src / SWEEPS).glob("*.feather"))
    if not paths:
        return
    mounted = _extrinsics(src / CALIBRATION)
    cameras = CameraFolder(src, np.array([t_ns for t_ns, _ in paths], np.int64))
    for number, (t_ns, path) in enumerate(paths):
        yield _frame(path, t_ns, mounted, cameras.images(number))


def _frame(path: Path, t_ns: int, mounted: Sequence[Floats], images: tuple[Image, ...]) -> Frame:
    read = table(path, _POINT)
    xyz = columns(path, read, ("x", "y", "z"))
    intensity, laser, offset_ns = (column(path, read, name) for name in _POINT[3:])
    if laser.dtype.kind not in "iu" or offset_ns.dtype.kind not in "iu":
        raise EgolocError(
            f"{path}: laser_number, offset_ns: expected integers, got {laser.dtype} and {offset_ns.dtype}"
        )
    if len(laser) and not (laser.min() >= 0 and laser.max() < len(LIDARS) * LASERS):
        raise EgolocError(f"{path}: laser_number: expected 0 to 63, got {laser.min()} to {laser.max()}")
    if len(offset_ns) and np.abs(offset_ns.astype(np.int64)).max() > 1 << 30:
        raise EgolocError(f"{path}: offset_ns: expected less than 1.07 s, got up to {offset_ns.max()} ns")
    usable = np.isfinite(xyz).all(axis=1)
    if not usable.all():
        log.warning("%s: %d points left out that are not finite", path, int((~usable).sum()))
    sweeps = []
    for number, T in enumerate(mounted):
        mine = usable & (laser // LASERS == number)
        seen = ((xyz[mine] - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
        sweeps.append(Sweep(seen, T, offset_ns[mine], intensity[mine], laser[mine] % LASERS, compensated=True))
    arrival_ns = max([t_ns + int(offset_ns.max(initial=0)), *(image.t_ns for image in images)])
    return Frame(t_ns, arrival_ns, tuple(sweeps), images)


def _stamp_of(path: Path) -> int:
    if not path.stem.isdecimal() or int(path.stem) >= 1 << 62:
        raise EgolocError(f"{path}: expected a sweep's stamp in ns as the file's name")
    return int(path.stem)


def _extrinsics(path: Path) -> list[Floats]:
    """(4, 4) T_body_lidar of both LiDARs."""
    read = table(path, ("sensor_name", *_QUATERNION, *_PLACE))
    names = read["sensor_name"].to_pylist()
    q, p = columns(path, read, _QUATERNION), columns(path, read, _PLACE)
    found = []
    for name in LIDARS:
        if names.count(name) != 1:
            raise EgolocError(f"{path}: sensor_name: expected one row {name}, got {names.count(name)}")
        row = names.index(name)
        if not (np.isfinite(p[row]).all() and abs(np.linalg.norm(q[row]) - 1.0) < 1e-3):
            raise EgolocError(f"{path}: {name}: expected a unit quaternion and a place, got {[*q[row], *p[row]]}")
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = matrix_from_q(q[None, row])[0], p[row]
        found.append(T)
    return found


def _map_frame(src: Path) -> MapFrame | None:
    """The frame of the city that a map's file names."""
    named = (city_frame(path) for path in sorted((src / "map").glob("*")))
    return next((frame for frame in named if frame is not None), None)
