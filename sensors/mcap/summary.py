"""What is in a log and what a replay would use of it: describe."""

import os
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.geodesy import MapFrame
from sensors.mcap.assembly import METADATA, assemble
from sensors.mcap.columns import Topic
from sensors.mcap.decode import stamps
from sensors.mcap.gather import Gatherer
from sensors.mcap.sections import open_container
from sensors.mcap.topics import Roles, assign, check_choice, wanted_by
from sensors.records import LeftOut, Log
from sensors.vehicle import Vehicle


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
    a checksum that holds; compressions: those of its chunks, empty where it is unchunked.
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


def describe(path: str | os.PathLike[str], topics: Mapping[str, str] | None = None) -> LogSummary:
    """Summarize a log; topics as in read_log, but two topics for one sensor are noted, not raised."""
    chosen = dict(topics or {})
    check_choice(chosen)
    source = open_container(path)
    gatherer = Gatherer(wanted_by(chosen), times=True)
    gatherer.read(source)
    roles = assign(gatherer.topics, chosen, gatherer.definitions, source.path)
    log = assemble(source, gatherer, roles)
    return LogSummary(
        path=str(source.path),
        size_bytes=len(source.data),
        topics=tuple(_topic(topic, roles, log) for topic in gatherer.topics),
        rows={sensor: len(getattr(log, sensor)) for sensor in roles.sensors if getattr(log, sensor) is not None},
        vehicle=log.vehicle,
        map_frame=log.map_frame,
        has_metadata=METADATA in source.metadata,
        complete=source.complete,
        bytes_lost=source.bytes_lost,
        indexed=source.summary.present,
        chunks=source.chunks,
        compressions=tuple(sorted(source.compressions)),
        left_out=tuple(log.left_out),
    )


def _topic(topic: Topic, roles: Roles, log: Log) -> TopicSummary:
    stamped = topic.has_column("sec") and topic.rows > 0
    t_ns = np.sort(stamps(topic)[0] if stamped else topic.log_time())
    rate, gap = _rate_and_gap(t_ns)
    fed = tuple(s for s, source in roles.sensors.items() if source is topic and getattr(log, s) is not None)
    return TopicSummary(
        name=topic.name,
        schema=topic.schema.name,
        encoding=topic.encoding,
        count=topic.count,
        stamped=stamped,
        first_ns=int(t_ns[0]) if len(t_ns) else None,
        last_ns=int(t_ns[-1]) if len(t_ns) else None,
        median_rate_hz=rate,
        longest_gap_s=gap,
        sensors=fed,
        note="" if fed else _note(topic, roles),
    )


def _rate_and_gap(t_ns: NDArray[np.int64]) -> tuple[float, float]:
    """Median rate, Hz, and longest gap, s, of sorted times."""
    steps = np.diff(t_ns)
    if len(steps) == 0:
        return float("nan"), float("nan")
    median = float(np.median(steps))
    return (NS_PER_S / median if median > 0 else float("nan")), float(steps.max()) / NS_PER_S


def _note(topic: Topic, roles: Roles) -> str:
    """Why a topic feeds no sensor."""
    for sensor, candidates in roles.conflicts.items():
        if topic in candidates:
            others = ", ".join(other.name for other in candidates if other is not topic)
            return f"{sensor}: {others} could feed it too; name one under [topics]"
    return roles.ignored.get(topic.name, "no usable message")
