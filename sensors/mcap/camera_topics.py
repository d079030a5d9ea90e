"""Which topics of a log are cameras, what each one's CameraInfo says, and what its messages show.

By the custom of ROS an image's CameraInfo is its topic's neighbour: of ``/front/image_raw[/compressed]`` it is
``/front/camera_info``, which names the camera ``front`` (of ``/camera/front/...`` as well). The first CameraInfo of a
log holds for all of it. Of several topics of one camera one is read: the named one, else the first compressed one.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.images import Image
from sensors.mcap.cdr import MalformedMessageError, short_name
from sensors.mcap.container import ChannelRecord, Definitions, SchemaRecord
from sensors.mcap.image_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGES,
    ImageMessage,
    Intrinsics,
    decode_image,
    decode_info,
)
from sensors.mcap.sections import open_container
from sensors.mcap.single_messages import MessageWalk, SingleMessage

Floats = NDArray[np.float64]

_COMPRESSED = "/compressed"
_DEPTH = "/compressedDepth"
_INFO = "/camera_info"
_GROUP = "camera/"


class NoCameraError(Exception):
    """Why an image cannot be used; it is left out and counted."""


def is_image(names: tuple[str, ...]) -> Callable[[ChannelRecord, SchemaRecord], bool]:
    """Whether a channel is a camera's: of the named topics, or of any of the schemas."""

    def wanted(channel: ChannelRecord, schema: SchemaRecord) -> bool:
        return short_name(schema.name) in IMAGES and (not names or channel.topic in names)

    return wanted


def info_topics(topic: str) -> tuple[str, str]:
    """Where the CameraInfo of an image's topic may be, the likelier place first."""
    base = topic.removesuffix(_COMPRESSED)
    return base.rpartition("/")[0] + _INFO, base + _INFO


def name_of(info_topic: str) -> str:
    """The camera's name."""
    return info_topic.removesuffix(_INFO).lstrip("/").removeprefix(_GROUP) or "camera"


def is_rectified(topic: str) -> bool:
    """Whether an image's topic says that it is rectified (image_rect, image_rect_color)."""
    return "rect" in topic.removesuffix(_COMPRESSED).rpartition("/")[2]


class Shown(NamedTuple):
    """A camera of a log: its name, and what its CameraInfo says."""

    name: str
    intrinsics: Intrinsics


class Cameras:
    """The cameras of a log. pose_of: (4, 4) T_body_camera of a header frame, None where nothing tells."""

    def __init__(
        self,
        path: Path,
        names: tuple[str, ...],
        definitions: Definitions,
        pose_of: Callable[[str], Floats | None],
    ) -> None:
        """names: topics to read from, none: any. definitions: those known so far, which grow."""
        self._path, self._definitions, self._pose_of = path, definitions, pose_of
        self._is_wanted = is_image(names)
        self._infos: Mapping[str, memoryview] | None = None
        self._shown: dict[str, Shown | str] = {}
        self._topic_of: dict[str, str] = {}

    def image(self, message: SingleMessage) -> Image:
        """A message's image. NoCameraError where it has none that is known enough; MalformedMessageError."""
        topic = message.channel.topic
        shown = self.shown(topic)
        try:
            found = decode_image(message.schema.name, message.data)
        except EgolocError as error:
            raise NoCameraError(str(error)) from None
        return self._made(topic, shown, found)

    def _made(self, topic: str, shown: Shown, found: ImageMessage) -> Image:
        told = shown.intrinsics
        if (found.width, found.height) != (told.width, told.height):
            sizes = f"{told.width} x {told.height} pixels, they have {found.width} x {found.height}"
            raise NoCameraError(f"images of another size than their CameraInfo says: {sizes}")
        T = self._pose_of(found.frame)
        if T is None:
            raise NoCameraError(f"no /tf_static leads from base_link to {found.frame!r}")
        T = T.copy()
        T[:3, :3] = T[:3, :3] @ told.R.T
        try:
            return Image(
                found.data, found.format, found.width, found.height, told.K, T, found.t_ns, shown.name, told.lens,
                told.distortion,
            )  # fmt: skip
        except EgolocError as error:
            raise NoCameraError(f"its CameraInfo: {error}") from None

    def shown(self, topic: str) -> Shown:
        """The camera of a topic; NoCameraError where nothing tells, or another topic has it already."""
        if topic not in self._shown:
            self._shown[topic] = self._look(topic)
        found = self._shown[topic]
        if isinstance(found, str):
            raise NoCameraError(found)
        chosen = self._topic_of.setdefault(found.name, self._first_of(found.name, topic))
        if chosen != topic:
            raise NoCameraError(f"camera {found.name} is read from {chosen}; name another under topics.camera")
        return found

    def _look(self, topic: str) -> Shown | str:
        if self._infos is None:
            self._infos = first_infos(self._path)
        infos = self._infos
        place = next((place for place in info_topics(topic) if place in infos), None)
        if place is None:
            return f"no CameraInfo on {info_topics(topic)[0]}"
        try:
            return Shown(name_of(place), decode_info(infos[place], is_rectified=is_rectified(topic)))
        except (EgolocError, MalformedMessageError) as error:
            return f"{place}: {error}"

    def _first_of(self, name: str, topic: str) -> str:
        """The topic from which a camera is read, of those that are known by now: topic, or one that goes before it."""
        infos = self._infos or {}
        ranks = []
        for number, channel in self._definitions.channels.items():
            schema = self._definitions.schemas.get(channel.schema_id)
            if schema is None or channel.encoding != "cdr" or not self._is_wanted(channel, schema):
                continue
            place = next((place for place in info_topics(channel.topic) if place in infos), None)
            if place is not None and name_of(place) == name and not channel.topic.endswith(_DEPTH):
                ranks.append((short_name(schema.name) != COMPRESSED_IMAGE, number, channel.topic))
        return min(ranks)[2] if ranks else topic


def first_infos(path: Path) -> dict[str, memoryview]:
    """The first CameraInfo message of every topic. A file without a summary is walked for them to its end."""
    found: dict[str, memoryview] = {}
    walk = MessageWalk(open_container(path), _is_info)
    for message in walk.messages():
        if message.channel.topic not in found:
            found[message.channel.topic] = memoryview(bytes(message.data))
        if walk.complete and len(found) == _count(walk.definitions):
            break
    return found


def _is_info(channel: ChannelRecord, schema: SchemaRecord) -> bool:
    return short_name(schema.name) == CAMERA_INFO and channel.encoding == "cdr"


def _count(definitions: Definitions) -> int:
    """How many topics of CameraInfo there are."""
    none = SchemaRecord("", "", "")
    channels = definitions.channels.values()
    return len({c.topic for c in channels if _is_info(c, definitions.schemas.get(c.schema_id, none))})
