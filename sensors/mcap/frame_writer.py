"""Writes frames into a log: sweeps as sensor_msgs/PointCloud2, images as they are, where sensors sit on /tf_static.

The first sweep of every frame is on /lidar/points, the second on /lidar/1/points and so on, with the header frames
lidar, lidar_1, ... on base_link. A metadata record ``egoloc:TOPIC`` in front of a topic's first sweep says what no
message can: whether the points are compensated. So neither that nor the LiDAR's pose may change within a log.

An image of the camera ``front`` is on /camera/front/image/compressed (raw ones on /camera/front/image), behind its
CameraInfo on /camera/front/camera_info, with the header frame camera/front. A camera's pose, intrinsics and format are
those of its first image throughout.
"""

from collections.abc import Iterable, Iterator

import msgspec
import numpy as np

from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.images import RAW, Image
from sensors.mcap.assembly import METADATA, sealed
from sensors.mcap.frame_grouping import TOGETHER_NS
from sensors.mcap.image_messages import CAMERA_INFO, encode_image, encode_info
from sensors.mcap.point_cloud import POINT_CLOUD, encode
from sensors.mcap.static_tf import TOPIC, TRANSFORMS, encode_transforms
from sensors.mcap.writer import ChunkWriter

_LAST_S = 1 << 31


class SweepFacts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The JSON of a LiDAR topic's metadata record."""

    compensated: bool


def metadata_name(topic: str) -> str:
    """The name of a topic's metadata record."""
    return f"{METADATA}:{topic}"


def place_of(number: int) -> tuple[str, str]:
    """Topic and header frame of a frame's sweep by number."""
    return ("/lidar/points", "lidar") if number == 0 else (f"/lidar/{number}/points", f"lidar_{number}")


def topics_of(image: Image) -> tuple[str, str, str]:
    """Topics of an image and of its CameraInfo, and its header frame."""
    space = f"/camera/{image.name}"
    return f"{space}/image" + ("" if image.format in RAW else "/compressed"), f"{space}/camera_info", space[1:]


class FrameWriter:
    """Frames that wait for their place in the file; one is held at a time."""

    def __init__(self, writer: ChunkWriter, frames: Iterable[Frame]) -> None:
        self._writer = writer
        self._frames: Iterator[Frame] = iter(frames)
        self._next = next(self._frames, None)
        self._first: list[Sweep] = []
        self._cameras: dict[str, Image] = {}

    def write_until(self, log_time: int | None) -> None:
        """Write every frame that arrived before a log time; None: all that are left."""
        while self._next is not None and (log_time is None or self._next.arrival_ns < log_time):
            self._write(self._next)
            following = next(self._frames, None)
            if following is not None and following.t_ns <= self._next.t_ns:
                raise EgolocError(
                    f"frames: t_ns: expected increasing stamps, got {following.t_ns} after {self._next.t_ns}"
                )
            self._next = following

    def _write(self, frame: Frame) -> None:
        if not (0 <= frame.t_ns // 10**9 < _LAST_S and frame.arrival_ns >= 0):
            raise EgolocError(f"frames: t_ns: expected stamps of 1970 to 2038, got {frame.t_ns}")
        for number, (sweep, first) in enumerate(zip(frame.sweeps, self._first, strict=False)):
            if sweep.compensated != first.compensated or (sweep.T_body_lidar != first.T_body_lidar).any():
                raise EgolocError(
                    f"frames: sweep {number} at {frame.t_ns}: expected T_body_lidar and compensated of the first frame"
                )
        for image in frame.images:
            self._check(image, frame)
        self._introduce(frame)
        for number, sweep in enumerate(frame.sweeps):
            topic, name = place_of(number)
            self._writer.message(topic, POINT_CLOUD, encode(sweep, frame.t_ns, name), frame.arrival_ns)
        for image in frame.images:
            topic, info, name = topics_of(image)
            self._writer.message(info, CAMERA_INFO, encode_info(image, name), frame.arrival_ns)
            self._writer.message(topic, *encode_image(image, name), frame.arrival_ns)

    def _check(self, image: Image, frame: Frame) -> None:
        """EgolocError where an image does not fit its frame, or the first image of its camera."""
        apart, label = abs(image.t_ns - frame.t_ns), f"frames: image of {image.name} at {frame.t_ns}"
        if apart > TOGETHER_NS:
            raise EgolocError(
                f"{label}: expected a stamp within {TOGETHER_NS / 1e6:g} ms of the frame's, got {apart / 1e6:g} ms"
            )
        first = self._cameras.setdefault(image.name, image)
        same = all(
            np.array_equal(getattr(image, name), getattr(first, name))
            for name in ("width", "height", "K", "lens", "distortion", "T_body_camera")
        )
        if not same or (topics_of(image) != topics_of(first)):
            raise EgolocError(f"{label}: expected T_body_camera, size, K, lens and format of the camera's first image")

    def _introduce(self, frame: Frame) -> None:
        """Say of sensors that were not seen before where they sit, and of LiDARs how they were recorded."""
        known, new = len(self._first), frame.sweeps[len(self._first) :]
        poses = {}
        for number, sweep in enumerate(new, start=known):
            topic, name = place_of(number)
            poses[name] = np.asarray(sweep.T_body_lidar)
            self._writer.metadata(metadata_name(topic), sealed(SweepFacts(sweep.compensated)))
        for image in frame.images:
            if self._cameras[image.name] is image:
                poses[topics_of(image)[2]] = image.T_body_camera
        if poses:
            self._writer.message(TOPIC, TRANSFORMS, encode_transforms(poses, frame.t_ns), frame.arrival_ns)
        self._first += new
