"""What a log's LiDAR topics hold, from a few of their messages: lidar_topics."""

import os
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sensors.datasets.static_transforms import StaticTransforms
from sensors.errors import EgolocError
from sensors.mcap.cdr import MalformedMessageError
from sensors.mcap.lidar_topics import check_names, is_cloud, is_compensated, names_of, pose_of, static_transforms
from sensors.mcap.point_cloud import decode
from sensors.mcap.sections import Container, open_container
from sensors.mcap.single_messages import MessageWalk, SingleMessage

SAMPLES = 5
"""Messages of each topic that are looked into, spread over the log."""


@dataclass(frozen=True)
class LidarTopic:
    """One topic of point clouds.

    points: the median of the messages that were looked into, None where none could be read; place: of the LiDAR in body
    axes, m, None where /tf_static does not tell; problem: why a cloud could not be read, "" where all could.
    """

    name: str
    frame: str
    points: int | None
    fields: tuple[str, ...]
    place: tuple[float, float, float] | None
    compensated: bool
    problem: str = ""


def lidar_topics(path: str | os.PathLike[str], chosen: str | Sequence[str] | None = None) -> tuple[LidarTopic, ...]:
    """The topics that ``read_frames`` would read, in the order of their first messages. chosen: as there."""
    names = names_of(chosen)
    source = open_container(path)
    source.read_metadata()
    walk = MessageWalk(source, is_cloud(names))
    samples: dict[str, list[SingleMessage]] = {}
    for message in _samples(walk):
        found = samples.setdefault(message.channel.topic, [])
        if len(found) < SAMPLES:
            found.append(message)
    if walk.complete or not samples:
        check_names(Path(path), names, walk.definitions)
    static = static_transforms(Path(path)) if samples else {}
    return tuple(_topic(source, topic, messages, static) for topic, messages in samples.items())


def _topic(source: Container, name: str, messages: Sequence[SingleMessage], static: StaticTransforms) -> LidarTopic:
    clouds, problem, compensated = [], "", False
    for message in messages:
        try:
            clouds.append(decode(message.data))
            compensated = bool(is_compensated(source, name))
        except (MalformedMessageError, EgolocError) as error:
            problem = str(error)
    if not clouds:
        return LidarTopic(name, "", None, (), None, compensated, problem)
    T = pose_of(static, clouds[0].frame)
    return LidarTopic(
        name,
        frame=clouds[0].frame,
        points=round(statistics.median(map(len, clouds))),
        fields=clouds[0].points.dtype.names or (),
        place=None if T is None else (float(T[0, 3]), float(T[1, 3]), float(T[2, 3])),
        compensated=compensated,
        problem=problem,
    )


def _samples(walk: MessageWalk) -> Iterator[SingleMessage]:
    """Messages of every topic: of chunks spread over the log, or the first ones of a file without a summary."""
    entries = [entry for entry in walk.source.summary.chunks if entry.indexes and walk.holds(entry)]
    if not entries:
        seen: dict[str, int] = {}
        for message in walk.messages():
            seen[message.channel.topic] = seen.get(message.channel.topic, 0) + 1
            yield message
            if min(seen.values()) >= SAMPLES:
                return
    for number in sorted({number for entry in entries for number in entry.indexes}):
        mine = [entry for entry in entries if number in entry.indexes]
        step = max(len(mine) // SAMPLES, 1)
        name = walk.definitions.channels[number].topic if number in walk.definitions.channels else ""
        for entry in mine[::step][:SAMPLES]:
            yield from (message for message in walk.of_chunk(entry) if message.channel.topic == name)
