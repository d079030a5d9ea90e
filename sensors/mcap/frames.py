"""LiDAR frames of a log, one at a time: read_frames. Any driver's PointCloud2 topics (``point_cloud``, ``point_time``).

Sweeps of several topics make one frame if their stamps lie at most TOGETHER_NS apart, at most one of each topic (a
compensated sweep only with those of its own stamp: its points hold for that). The frame's t_ns is the first of their
stamps, its arrival the last of their log times. T_body_lidar is the chain of /tf_static from a base frame (base_link,
base_footprint, body, vehicle) to the cloud's frame_id; where there is none, the identity, with a warning.
"""

import heapq
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
from sensors.mcap.cdr import MalformedMessageError
from sensors.mcap.container import ChunkEntry
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
from sensors.records import LeftOut

TOGETHER_NS = 50_000_000
"""Sweeps of several LiDARs with stamps this close are one frame: half a turn at 10 Hz."""
LATE_NS = 200_000_000
"""A sweep may come so much later (by stamp) than a newer one; what comes later still is left out."""
SLACK_NS = 2 * NS_PER_S
"""Chunks are read that begin or end so far outside the time asked for, for stamps and log times do not go alike."""

log = logging.getLogger(__name__)


def read_frames(
    path: str | os.PathLike[str],
    topic: str | Sequence[str] | None = None,
    begin_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[Frame]:
    """The LiDAR frames of a log with begin_ns <= t_ns < end_ns in order of t_ns, in bounded memory.

    topic: the LiDARs' topics (one, several, or several with commas between them); None: every PointCloud2 topic but
    those in world axes; a log without any has no frames. What was left out is warned of at the end. EgolocError where
    the file is no MCAP log, a named topic is not there, or a cloud's fields cannot be understood.
    """
    reader = FrameReader(path, topic, begin_ns, end_ns)
    yield from reader.frames()
    for entry in reader.left_out:
        log.warning("%s: %s: %d left out: %s", reader.path, entry.source, entry.count, entry.reason)


@dataclass(frozen=True, eq=False)
class _Seen:
    """A sweep with its topic, stamp and log time. rank: the place of its topic among the LiDARs."""

    topic: str
    rank: int
    t_ns: int
    log_time: int
    sweep: Sweep


class FrameReader:
    """A log whose frames are read; frames() once. left_out tells what was not used so far."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        topic: str | Sequence[str] | None = None,
        begin_ns: int | None = None,
        end_ns: int | None = None,
    ) -> None:
        self.names = names_of(topic)
        self.path = Path(path)
        self.source = open_container(path)
        self.begin_ns, self.end_ns = begin_ns, end_ns
        self.walk = MessageWalk(self.source, is_cloud(self.names))
        if self.walk.complete:
            check_names(self.path, self.names, self.walk.definitions)
        self._left_out: Counter[tuple[str, str]] = Counter()
        self._poses: dict[str, NDArray[np.float64]] = {}
        self._static: Any = None

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
        for group in _grouped(self._in_order(self._sweeps(self._outside()))):
            t_ns = group[0].t_ns
            if self.end_ns is not None and t_ns >= self.end_ns:
                return
            if t_ns == last_ns:
                self._left_out[group[0].topic, "sweeps with the stamp of another"] += len(group)
            elif self.begin_ns is None or t_ns >= self.begin_ns:
                yield _frame(group)
            last_ns = t_ns
        check_names(self.path, self.names, self.walk.definitions)  # by now all are known

    def _outside(self) -> "_Outside":
        """Which chunks need not be read for the time asked for."""
        first = next((m for entry in self._entries() for m in self.walk.of_chunk(entry)), None)
        if first is None or (self.begin_ns is None and self.end_ns is None):
            return _Outside(None, None)
        shift = 0
        try:
            shift = first.log_time - decode(first.data).t_ns
        except (MalformedMessageError, EgolocError):
            return _Outside(None, None)
        begin = None if self.begin_ns is None else self.begin_ns + shift - SLACK_NS
        end = None if self.end_ns is None else self.end_ns + shift + SLACK_NS
        return _Outside(begin, end)

    def _entries(self) -> Iterator[ChunkEntry]:
        return (entry for entry in self.source.summary.chunks if entry.indexes and self.walk.holds(entry))

    def _sweeps(self, skip: "_Outside") -> Iterator[_Seen]:
        """Every usable sweep as it comes."""
        for message in self.walk.messages(skip):
            check_encoding(self.path, message.channel)
            try:
                seen = self._sweep(message)
            except MalformedMessageError as error:
                self._left_out[message.channel.topic, str(error)] += 1
            except EgolocError as error:
                raise EgolocError(f"{self.path}: {message.channel.topic}: {error}") from None
            else:
                if seen is not None:
                    yield seen

    def _sweep(self, message: SingleMessage) -> _Seen | None:
        topic = message.channel.topic
        cloud = decode(message.data)
        if not self.names and cloud.frame in WORLD_FRAMES:
            self._left_out[topic, f"clouds in {cloud.frame} axes are no LiDAR's; name the topic if they are"] += 1
            return None
        compensated = is_compensated(self.source, topic)
        found = columns_of(cloud, zeros=compensated is not None)
        self._left_out[topic, "points that are not finite"] += found.not_finite
        self._left_out[topic, "points at the LiDAR's own place: no return"] += found.at_origin
        sweep = Sweep(**found.columns, T_body_lidar=self._pose(topic, cloud.frame), compensated=bool(compensated))
        return _Seen(topic, self._rank(topic), cloud.t_ns, message.log_time, sweep)

    def _rank(self, topic: str) -> int:
        """LiDARs go in the order in which they were named, else in that of the log's channels."""
        if self.names:
            return self.names.index(topic)
        return min(number for number, channel in self.walk.definitions.channels.items() if channel.topic == topic)

    def _pose(self, topic: str, frame: str) -> NDArray[np.float64]:
        """T_body_lidar of a header frame."""
        if frame not in self._poses:
            if self._static is None:
                self._static = static_transforms(self.path)
            T = pose_of(self._static, frame)
            if T is None:
                log.warning(
                    "%s: %s: no /tf_static leads from base_link to %r: taken as base_link", self.path, topic, frame
                )
                T = np.eye(4)
            self._poses[frame] = T
        return self._poses[frame]

    def _in_order(self, sweeps: Iterator[_Seen]) -> Iterator[_Seen]:
        """Sweeps by stamp; they are held until one is LATE_NS newer."""
        waiting: list[tuple[int, int, int, _Seen]] = []
        newest = last = np.iinfo(np.int64).min
        for number, seen in enumerate(sweeps):
            if seen.t_ns < last:
                self._left_out[seen.topic, f"sweeps that came over {LATE_NS / NS_PER_S:g} s late"] += 1
                continue
            heapq.heappush(waiting, (seen.t_ns, seen.rank, number, seen))
            newest = max(newest, seen.t_ns)
            while waiting and waiting[0][0] < newest - LATE_NS:
                last = waiting[0][0]
                yield heapq.heappop(waiting)[-1]
        while waiting:
            yield heapq.heappop(waiting)[-1]


@dataclass(frozen=True)
class _Outside:
    """Whether a chunk's log times lie outside a span; None: it is open on that side."""

    begin: int | None
    end: int | None

    def __call__(self, entry: ChunkEntry) -> bool:
        early = self.begin is not None and entry.last_ns < self.begin
        return early or (self.end is not None and entry.first_ns > self.end)


def _grouped(sweeps: Iterator[_Seen]) -> Iterator[list[_Seen]]:
    """Sweeps in order of stamp, those of a frame together."""
    group: list[_Seen] = []
    for seen in sweeps:
        if group and not _belongs(seen, group):
            yield group
            group = []
        group.append(seen)
    if group:
        yield group


def _belongs(seen: _Seen, group: Sequence[_Seen]) -> bool:
    """Whether a sweep is of the same frame as those before it."""
    rigid = seen.sweep.compensated or group[0].sweep.compensated
    apart = seen.t_ns - group[0].t_ns
    return apart <= (0 if rigid else TOGETHER_NS) and all(other.topic != seen.topic for other in group)


def _frame(group: Sequence[_Seen]) -> Frame:
    """The frame of sweeps, by rank; offsets are from the first stamp."""
    t_ns = group[0].t_ns
    ordered = sorted(group, key=lambda seen: seen.rank)
    return Frame(t_ns, max(seen.log_time for seen in group), tuple(_moved(seen, t_ns) for seen in ordered))


def _moved(seen: _Seen, t_ns: int) -> Sweep:
    """A sweep whose offsets are from another stamp."""
    sweep, later = seen.sweep, seen.t_ns - t_ns
    if not later:
        return sweep
    offset_ns = sweep.offset_ns + np.int32(later)
    return Sweep(sweep.xyz, sweep.T_body_lidar, offset_ns, sweep.intensity, sweep.ring, sweep.compensated)
