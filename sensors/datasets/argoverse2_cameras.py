"""Cameras of Argoverse 2 sensor logs: sensors/cameras/NAME/STAMP.jpg, with calibration/intrinsics.feather.

The images are undistorted: k1, k2 and k3 of the intrinsics tell what was taken out (the data set's own guide; av2-api
does not use them either). A frame has of each camera the image nearest its stamp, as ``sensors.mcap.frame_grouping``
does it: the ring cameras run at 20 Hz, the sweeps at 10 Hz.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.datasets.feather_table import columns, table
from sensors.errors import EgolocError
from sensors.images import Image, format_of, size_of
from sensors.mcap.frame_grouping import TOGETHER_NS
from sensors.rotation import matrix_from_q

Floats = NDArray[np.float64]

IMAGES = "sensors/cameras"
INTRINSICS = "calibration/intrinsics.feather"
EXTRINSICS = "calibration/egovehicle_SE3_sensor.feather"

_PINHOLE = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
_POSE = ("qx", "qy", "qz", "qw", "tx_m", "ty_m", "tz_m")


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera: K (3, 3), T_body_camera (4, 4), its images' stamps (M,) ns and files."""

    name: str
    width: int
    height: int
    K: Floats
    T_body_camera: Floats
    t_ns: NDArray[np.int64]
    paths: tuple[Path, ...]

    def image(self, number: int) -> Image:
        """An image by its number."""
        path = self.paths[number]
        try:
            data = path.read_bytes()
        except OSError as error:
            raise EgolocError(f"{path}: cannot be read: {error.strerror}") from None
        found = format_of(data)
        if found is None:
            raise EgolocError(f"{path}: expected a JPEG or PNG")
        if (size := size_of(data, str(path))) != (self.width, self.height):
            raise EgolocError(f"{path}: expected {self.width} x {self.height} pixels, got {size[0]} x {size[1]}")
        return Image(
            data, found, self.width, self.height, self.K, self.T_body_camera, int(self.t_ns[number]), self.name
        )


class CameraFolder:
    """The cameras of a log's folder; none where it has no images."""

    def __init__(self, src: Path, frame_ns: NDArray[np.int64]) -> None:
        """frame_ns: (F,) stamps of the frames, increasing."""
        folders = sorted(path for path in (src / IMAGES).glob("*") if path.is_dir())
        self._cameras = [camera for path in folders if (camera := _camera(src, path)) is not None]
        self._chosen = [nearest(frame_ns, camera.t_ns) for camera in self._cameras]

    def images(self, frame: int) -> tuple[Image, ...]:
        """The images of a frame by number."""
        chosen = zip(self._cameras, self._chosen, strict=True)
        return tuple(camera.image(int(which[frame])) for camera, which in chosen if which[frame] >= 0)


def nearest(frame_ns: NDArray[np.int64], image_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """(F,) the image that belongs to each frame, -1 where none does. Both stamps increase.

    An image belongs to the frame that is nearest it, at most TOGETHER_NS away; a frame takes the nearest of its own.
    """
    chosen = np.full(len(frame_ns), -1)
    if not len(frame_ns):
        return chosen
    after = np.clip(np.searchsorted(frame_ns, image_ns), 1, max(len(frame_ns) - 1, 1)) if len(frame_ns) > 1 else None
    frame = np.zeros(len(image_ns), np.int64)
    if after is not None:
        later = frame_ns[after] - image_ns < np.abs(image_ns - frame_ns[after - 1])
        frame = np.where(later, after, after - 1)
    apart = np.abs(frame_ns[frame] - image_ns)
    for number in np.argsort(apart, kind="stable")[::-1]:  # the nearest comes last, and stays
        if apart[number] <= TOGETHER_NS:
            chosen[frame[number]] = number
    return chosen


def _camera(src: Path, folder: Path) -> Camera | None:
    """The camera of a folder of images; None where it is empty."""
    paths = sorted((_stamp_of(path), path) for path in folder.iterdir() if path.suffix.lower() in {".jpg", ".png"})
    if not paths:
        return None
    fx, fy, cx, cy, width, height = _row(src / INTRINSICS, folder.name, _PINHOLE)
    pose = _row(src / EXTRINSICS, folder.name, _POSE)
    if abs(np.linalg.norm(pose[:4]) - 1.0) > 1e-3:
        raise EgolocError(f"{src / EXTRINSICS}: {folder.name}: expected a unit quaternion, got {pose[:4].tolist()}")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix_from_q(pose[None, :4])[0], pose[4:]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    t_ns = np.array([t for t, _ in paths], np.int64)
    return Camera(folder.name, int(width), int(height), K, T, t_ns, tuple(path for _, path in paths))


def _row(path: Path, name: str, wanted: tuple[str, ...]) -> Floats:
    """The numbers of a sensor."""
    read = table(path, ("sensor_name", *wanted))
    names = read["sensor_name"].to_pylist()
    if names.count(name) != 1:
        raise EgolocError(f"{path}: sensor_name: expected one row {name}, got {names.count(name)}")
    row: Floats = columns(path, read, wanted)[names.index(name)]
    if not np.isfinite(row).all():
        raise EgolocError(f"{path}: {name}: expected finite numbers, got {row.tolist()}")
    return row


def _stamp_of(path: Path) -> int:
    if not path.stem.isdecimal() or int(path.stem) >= 1 << 62:
        raise EgolocError(f"{path}: expected an image's stamp in ns as the file's name")
    return int(path.stem)
