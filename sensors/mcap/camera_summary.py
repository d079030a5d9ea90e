"""What a log's cameras are, from an image of each: camera_topics."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sensors.images import Image
from sensors.mcap.camera_topics import Cameras, NoCameraError, is_image
from sensors.mcap.cdr import MalformedMessageError
from sensors.mcap.image_messages import IMAGES
from sensors.mcap.lidar_topics import check_names, names_of, pose_of, static_transforms
from sensors.mcap.sections import open_container
from sensors.mcap.single_messages import MessageWalk, SingleMessage
from sensors.mcap.topics import CAMERA


@dataclass(frozen=True)
class CameraTopic:
    """One topic of images.

    name: the topic; camera: its camera's name; place: of the camera in body axes, m; problem: why its images are not
    used, "" where they are. What is not known then is empty, 0 or None.
    """

    name: str
    camera: str = ""
    width: int = 0
    height: int = 0
    format: str = ""
    lens: str = ""
    place: tuple[float, float, float] | None = None
    problem: str = ""


def camera_topics(path: str | os.PathLike[str], chosen: str | Sequence[str] | None = None) -> tuple[CameraTopic, ...]:
    """The topics of images of a log, in the order of their first messages. chosen: as ``read_frames``' cameras."""
    names = names_of(chosen, CAMERA)
    walk = MessageWalk(open_container(path), is_image(names))
    firsts = _firsts(walk)
    if walk.complete or not firsts:
        check_names(Path(path), names, walk.definitions, CAMERA, IMAGES)
    static = static_transforms(Path(path)) if firsts else {}
    cameras = Cameras(Path(path), names, walk.definitions, lambda frame: pose_of(static, frame))
    return tuple(_topic(cameras, message) for message in firsts)


def _firsts(walk: MessageWalk) -> list[SingleMessage]:
    """The first message of every topic, of chunks that hold it as far as the summary tells."""
    found: dict[str, SingleMessage] = {}
    entries = [entry for entry in walk.source.summary.chunks if entry.indexes and walk.holds(entry)]
    if not entries:
        for message in walk.messages():
            found.setdefault(message.channel.topic, _kept(message))
        return list(found.values())
    for number in dict.fromkeys(number for entry in entries for number in entry.indexes):
        channel = walk.definitions.channels.get(number)
        if channel is None or channel.topic in found or not walk.wants(number):
            continue
        for entry in (entry for entry in entries if number in entry.indexes):
            mine = (message for message in walk.of_chunk(entry) if message.channel.topic == channel.topic)
            first = next(mine, None)
            if first is not None:
                found[channel.topic] = _kept(first)
                break
    return list(found.values())


def _kept(message: SingleMessage) -> SingleMessage:
    """With bytes of its own: a chunk is not held for one message."""
    return message._replace(data=memoryview(bytes(message.data)))


def _topic(cameras: Cameras, message: SingleMessage) -> CameraTopic:
    name = message.channel.topic
    if message.channel.encoding != "cdr":
        return CameraTopic(name, problem=f"expected cdr messages, got {message.channel.encoding}")
    try:
        return _found(name, cameras.image(message))
    except (NoCameraError, MalformedMessageError) as error:
        return CameraTopic(name, problem=str(error))


def _found(name: str, image: Image) -> CameraTopic:
    x, y, z = image.T_body_camera[:3, 3].tolist()
    return CameraTopic(name, image.name, image.width, image.height, image.format, image.lens, (x, y, z))
