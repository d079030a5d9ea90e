"""What is in a log and what a replay would use of it: describe."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.geodesy import MapFrame
from sensors.mcap.assembly import METADATA, Facts
from sensors.mcap.cdr import short_name
from sensors.mcap.columns import Topic
from sensors.mcap.decoded import stamps
from sensors.mcap.image_messages import CAMERA_INFO, IMAGES
from sensors.mcap.point_cloud import POINT_CLOUD
from sensors.mcap.reader import LogReader
from sensors.mcap.static_tf import TRANSFORMS
from sensors.mcap.topics import CAMERA, LIDAR, Roles, conflict
from sensors.pieces import PIECE_S, summed
from sensors.records import LeftOut, Log
from sensors.steps import Steps
from sensors.vehicle import Vehicle

_FRAMES = {POINT_CLOUD: LIDAR, TRANSFORMS: LIDAR, CAMERA_INFO: CAMERA} | dict.fromkeys(IMAGES, CAMERA)
"""Schemas that are read as frames, not as columns -> what they feed."""


@dataclass(frozen=True)
class TopicSummary:
    """One topic. Times are header stamps where the schema is read (stamped), else log times; NaN where too few.

    sensors: what it would feed; note: why it feeds nothing, "" where it feeds something.
    """

    name: str
    schema: str
    encoding: str
    count: int
    stamped: bool
    first_ns: int | None
    last_ns: int | None
    median_rate_hz: float
    longest_gap_s: float
    sensors: tuple[str, ...]
    note: str


@dataclass(frozen=True)
class LogSummary:
    """A log file: its topics in order of appearance, the facts it carries, and the state of the file itself.

    rows: sensor -> rows that a replay would use. complete: the file has its end marker; indexed: it has a summary with
    a checksum that holds; compressions: those of its chunks, empty where it is unchunked. conflict: two topics that
    could feed one sensor, for which read_pieces refuses the log, "" where there are none.
    """

    path: str
    size_bytes: int
    topics: tuple[TopicSummary, ...]
    rows: Mapping[str, int]
    vehicle: Vehicle
    map_frame: MapFrame | None
    has_metadata: bool
    complete: bool
    bytes_lost: int
    indexed: bool
    chunks: int
    compressions: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    conflict: str


def describe(
    path: str | os.PathLike[str],
    topics: Mapping[str, str] | None = None,
    visit: Callable[[Log], object] | None = None,
) -> LogSummary:
    """Summarize a log of any length; topics as in read_pieces, but two topics for one sensor are noted, not raised.

    visit: gets every piece that a replay would get.
    """
    steps: dict[Topic, Steps] = {}

    def done(topic: Topic, rows: NDArray[np.bool_]) -> None:
        times = stamps(topic)[0] if _is_stamped(topic) else topic.log_time()
        steps.setdefault(topic, Steps()).add(np.sort(times[rows]))

    reader = LogReader(path, topics, PIECE_S, strict=False, times=True, done=done)
    left_out: list[LeftOut] = []
    for piece in reader.pieces():
        left_out += piece.left_out
        if visit is not None:
            visit(piece)
    source, facts = reader.source, reader.facts or Facts()
    return LogSummary(
        path=str(source.path),
        size_bytes=len(source.data),
        topics=tuple(_topic(topic, reader, steps.get(topic, Steps())) for topic in reader.gatherer.topics),
        rows={sensor: reader.rows[sensor] for sensor in reader.roles.sensors if reader.rows[sensor]},
        vehicle=facts.vehicle,
        map_frame=facts.map_frame,
        has_metadata=METADATA in source.metadata,
        complete=source.complete,
        bytes_lost=source.bytes_lost,
        indexed=source.summary.present,
        chunks=source.chunks,
        compressions=tuple(sorted(source.compressions)),
        left_out=summed(left_out),
        conflict=conflict(reader.roles, source.path),
    )


def _is_stamped(topic: Topic) -> bool:
    return topic.has_column("sec") and topic.seen > 0


def _topic(topic: Topic, reader: LogReader, steps: Steps) -> TopicSummary:
    fed = tuple(s for s, source in reader.roles.sensors.items() if source is topic and reader.rows[s])
    kind = short_name(topic.schema.name)
    if topic.count and kind in _FRAMES:
        fed = (_FRAMES[kind],)
    return TopicSummary(
        name=topic.name,
        schema=topic.schema.name,
        encoding=topic.encoding,
        count=topic.count,
        stamped=_is_stamped(topic),
        first_ns=steps.first_ns,
        last_ns=steps.last_ns,
        median_rate_hz=steps.rate_hz() or float("nan"),
        longest_gap_s=float("nan") if steps.longest_ns is None else steps.longest_ns / NS_PER_S,
        sensors=fed,
        note="" if fed else _note(topic, reader.roles),
    )


def _note(topic: Topic, roles: Roles) -> str:
    """Why a topic feeds no sensor."""
    for sensor, candidates in roles.conflicts.items():
        if topic in candidates:
            others = ", ".join(other.name for other in candidates if other is not topic)
            return f"{sensor}: {others} could feed it too; name one under [topics]"
    return roles.ignored.get(topic.name, "no usable message")
