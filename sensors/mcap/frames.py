"""Frames of a log, one at a time: read_frames. Any driver's PointCloud2 topics (``point_cloud``, ``point_time``), and
its cameras (``camera_topics``, ``image_messages``). ``frame_grouping`` says which sweeps and images make one frame.

T_body_lidar and T_body_camera are the chain of /tf_static from a base frame (base_link, base_footprint, body, vehicle)
to a message's frame_id. A LiDAR's is the identity where there is none, with a warning; an image without is left out,
for no camera looks along the body's z, as is one without a CameraInfo that fits.
"""

import logging
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.mcap.camera_topics import Cameras, NoCameraError, is_image
from sensors.mcap.cdr import MalformedMessageError, short_name
from sensors.mcap.container import ChannelRecord, ChunkEntry, SchemaRecord
from sensors.mcap.frame_grouping import Seen, grouped, in_order
from sensors.mcap.image_messages import IMAGES, frame_of, stamp_of
from sensors.mcap.lidar_topics import (
    WORLD_FRAMES,
    check_encoding,
    check_names,
    is_cloud,
    is_compensated,
    names_of,
    pose_of,
    static_transforms,
)
from sensors.mcap.point_cloud import columns_of, decode
from sensors.mcap.sections import open_container
from sensors.mcap.single_messages import MessageWalk, SingleMessage
from sensors.mcap.topics import CAMERA
from sensors.records import LeftOut

SLACK_NS = 2 * NS_PER_S
"""Chunks are read that begin or end so far outside the time asked for, for stamps and log times do not go alike."""

Topics = str | Sequence[str] | None
log = logging.getLogger(__name__)


def read_frames(
    path: str | os.PathLike[str],
    topic: Topics = None,
    begin_ns: int | None = None,
    end_ns: int | None = None,
    *,
    images: bool = True,
    cameras: Topics = None,
) -> Iterator[Frame]:
    """The frames of a log with begin_ns <= t_ns < end_ns in order of t_ns, in bounded memory.

    topic: the LiDARs' topics (one, several, or several with commas between them); None: every PointCloud2 topic but
    those in world axes; (): none, so that images make frames by themselves, as in a log without LiDARs. images: False:
    no images, whose chunks are then not unpacked where the log has an index; cameras: their topics, None: all. What was
    left out is warned of at the end. EgolocError where the file is no MCAP log, a named topic is not there, or a
    cloud's fields cannot be understood.
    """
    reader = FrameReader(path, topic, begin_ns, end_ns, images=images, cameras=cameras)
    yield from reader.frames()
    for entry in reader.left_out:
        log.warning("%s: %s: %d left out: %s", reader.path, entry.source, entry.count, entry.reason)


class FrameReader:
    """A log whose frames are read; frames() once. left_out tells what was not used so far."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        topic: Topics = None,
        begin_ns: int | None = None,
        end_ns: int | None = None,
        *,
        images: bool = True,
        cameras: Topics = None,
    ) -> None:
        self.lidars = topic is None or len(topic) > 0
        self.names = names_of(topic) if self.lidars else ()
        self.camera_names = names_of(cameras, CAMERA) if images else ()
        self.images = images
        self.path = Path(path)
        self.source = open_container(path)
        self.begin_ns, self.end_ns = begin_ns, end_ns
        self.walk = MessageWalk(self.source, self._is_wanted)
        if self.walk.complete:
            self._check_names()
        self._left_out: Counter[tuple[str, str]] = Counter()
        self._poses: dict[str, NDArray[np.float64] | None] = {}
        self._static: Any = None
        self._cameras = Cameras(self.path, self.camera_names, self.walk.definitions, self._pose)

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Messages and points that were not used, and damage of the file."""
        damage = {(self.path.name, reason): count for reason, count in self.source.damage.items()}
        counts = Counter(damage) + self._left_out
        return tuple(LeftOut(source, reason, count) for (source, reason), count in counts.items())

    def frames(self) -> Iterator[Frame]:
        """Every frame in order of time."""
        self.source.read_metadata()
        last_ns = None
        seen = in_order(self._seen(self._outside()), self._leave_out)
        for group in grouped(seen, self._leave_out, lidars=self.lidars and self._has_lidar()):
            t_ns = group.t_ns
            if self.end_ns is not None and t_ns >= self.end_ns:
                return
            if t_ns == last_ns:
                self._left_out[group.topic, "sweeps with the stamp of another"] += len(group.sweeps)
            elif self.begin_ns is None or t_ns >= self.begin_ns:
                yield group.frame()
            last_ns = t_ns
        self._check_names()  # by now all are known

    def _is_wanted(self, channel: ChannelRecord, schema: SchemaRecord) -> bool:
        cloud = self.lidars and is_cloud(self.names)(channel, schema)
        return cloud or (self.images and is_image(self.camera_names)(channel, schema))

    def _check_names(self) -> None:
        check_names(self.path, self.names, self.walk.definitions)
        check_names(self.path, self.camera_names, self.walk.definitions, CAMERA, IMAGES)

    def _has_lidar(self) -> bool:
        """Whether there is a sweep in the file, by the first cloud of each topic. Without images nobody asks."""
        if not self.images:
            return True
        in_world: set[str] = set()
        for message in MessageWalk(open_container(self.path), is_cloud(self.names)).messages():
            if message.channel.topic not in in_world:
                if self.names or frame_of(message.data) not in WORLD_FRAMES:
                    return True
                in_world.add(message.channel.topic)
        return False

    def _leave_out(self, topic: str, reason: str) -> None:
        self._left_out[topic, reason] += 1

    def _outside(self) -> "_Outside":
        """Which chunks need not be read for the time asked for."""
        first = next((m for entry in self._entries() for m in self.walk.of_chunk(entry)), None)
        if first is None or (self.begin_ns is None and self.end_ns is None):
            return _Outside(None, None)
        try:
            shift = first.log_time - stamp_of(first.data)
        except MalformedMessageError:
            return _Outside(None, None)
        begin = None if self.begin_ns is None else self.begin_ns + shift - SLACK_NS
        end = None if self.end_ns is None else self.end_ns + shift + SLACK_NS
        return _Outside(begin, end)

    def _entries(self) -> Iterator[ChunkEntry]:
        return (entry for entry in self.source.summary.chunks if entry.indexes and self.walk.holds(entry))

    def _seen(self, skip: "_Outside") -> Iterator[Seen]:
        """Every usable sweep and image as it comes."""
        for message in self.walk.messages(skip):
            check_encoding(self.path, message.channel)
            is_camera = short_name(message.schema.name) in IMAGES
            try:
                seen = self._image(message) if is_camera else self._sweep(message)
            except (MalformedMessageError, NoCameraError) as error:
                self._leave_out(message.channel.topic, str(error))
            except EgolocError as error:
                raise EgolocError(f"{self.path}: {message.channel.topic}: {error}") from None
            else:
                if seen is not None:
                    yield seen

    def _image(self, message: SingleMessage) -> Seen:
        image, topic = self._cameras.image(message), message.channel.topic
        return Seen(topic, self._rank(topic, self.camera_names), image.t_ns, message.log_time, image)

    def _sweep(self, message: SingleMessage) -> Seen | None:
        topic = message.channel.topic
        cloud = decode(message.data)
        if not self.names and cloud.frame in WORLD_FRAMES:
            self._leave_out(topic, f"clouds in {cloud.frame} axes are no LiDAR's; name the topic if they are")
            return None
        compensated = is_compensated(self.source, topic)
        found = columns_of(cloud, zeros=compensated is not None)
        self._left_out[topic, "points that are not finite"] += found.not_finite
        self._left_out[topic, "points at the LiDAR's own place: no return"] += found.at_origin
        T = self._lidar_pose(topic, cloud.frame)
        sweep = Sweep(**found.columns, T_body_lidar=T, compensated=bool(compensated))
        return Seen(topic, self._rank(topic, self.names), cloud.t_ns, message.log_time, sweep)

    def _rank(self, topic: str, names: Sequence[str]) -> int:
        """Sensors go in the order in which they were named, else in that of the log's channels."""
        if names:
            return names.index(topic)
        return min(number for number, channel in self.walk.definitions.channels.items() if channel.topic == topic)

    def _pose(self, frame: str) -> NDArray[np.float64] | None:
        """(4, 4) pose on the body of a header frame; None where no transform tells."""
        if frame not in self._poses:
            if self._static is None:
                self._static = static_transforms(self.path)
            self._poses[frame] = pose_of(self._static, frame)
        return self._poses[frame]

    def _lidar_pose(self, topic: str, frame: str) -> NDArray[np.float64]:
        T = self._pose(frame)
        if T is None:
            log.warning("%s: %s: no /tf_static leads from base_link to %r: taken as base_link", self.path, topic, frame)
            self._poses[frame] = T = np.eye(4)
        return T


@dataclass(frozen=True)
class _Outside:
    """Whether a chunk's log times lie outside a span; None: it is open on that side."""

    begin: int | None
    end: int | None

    def __call__(self, entry: ChunkEntry) -> bool:
        early = self.begin is not None and entry.last_ns < self.begin
        return early or (self.end is not None and entry.first_ns > self.end)
