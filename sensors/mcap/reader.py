"""Reads a log of any length piece by piece: rows are gathered until a window of stamps is complete, then given out.

A window is complete when the log's clock (that of the IMU, else of the first sensor that has rows) has passed its end
by HOLD_NS, in messages that were surely read. Log times only say how far reading has come: they may be on any clock.
"""

import itertools
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.mcap.assembly import METADATA, Facts, News, damage, read_facts, unused
from sensors.mcap.columns import Topic
from sensors.mcap.feeds import Feed, Judged, settle
from sensors.mcap.gather import Gatherer
from sensors.mcap.modes import join_modes
from sensors.mcap.pace import HOLD_NS, Pace
from sensors.mcap.sections import open_container
from sensors.mcap.topics import FRAMES, PARTS, Roles, assign, check_choice, conflict, wanted_by
from sensors.pieces import PIECE_S, SENSORS
from sensors.records import LeftOut, Log

Mask = NDArray[np.bool_]

SLACK_NS = HOLD_NS // 10
"""Windows are looked at so much later than they may be complete, for stamps and log times do not go alike."""
MAX_ROWS = 1 << 19
"""Rows of one topic (in a window of PIECE_S or less) after which windows are looked at, whatever the log times say."""

_FED = (*SENSORS, *PARTS)
"""Sensors that have topics."""
NOTHING_DUE = int(np.iinfo(np.int64).min)
"""Before every stamp."""


class LogReader:
    """A log being read; pieces() once. See io.read_pieces.

    strict: two topics for one sensor are an error, otherwise neither is read. times: the messages of all topics are
    counted. done(topic, rows): called with rows (N,) of a topic, as read, that are about to be discarded.
    """

    def __init__(
        self, path: str | os.PathLike[str], topics: Mapping[str, str] | None, length_s: float, *,
        strict: bool = True, times: bool = False, done: Callable[[Topic, Mask], None] | None = None,
    ) -> None:  # fmt: skip
        check_choice(topics or {})
        self.chosen = {sensor: topic for sensor, topic in (topics or {}).items() if sensor not in FRAMES}
        if not round(length_s * NS_PER_S) > 0:
            raise EgolocError(f"length of a piece: expected more than 0 s, got {length_s:g}")
        self.length_ns = round(length_s * NS_PER_S)
        self.source = open_container(path)
        self.gatherer = Gatherer(wanted_by(self.chosen), times=times)
        self.strict, self.done = strict, done
        self.roles = Roles()
        self.facts: Facts | None = None
        self.rows: Counter[str] = Counter()
        self._feeds: dict[str, Feed] = {}
        self._old: dict[Topic, int] = {}
        self._first_ns: int | None = None
        self._windows = 0
        self._news = News()
        self._metadata: dict[str, str] | None = None
        self._problem: tuple[LeftOut, ...] = ()
        self._left_out: list[LeftOut] = []
        self._peeked = False

    def pieces(self) -> Iterator[Log]:
        """Every window that holds rows; the last piece says what is known only at the end of the file."""
        self.source.read_metadata()
        pace = Pace(self.length_ns + HOLD_NS, round(MAX_ROWS * max(self.length_ns / (PIECE_S * NS_PER_S), 1)))
        for read_up_to in self.gatherer.read(self.source):
            if read_up_to is None:
                continue
            pace.read(read_up_to)
            for feed in self._feeds.values():
                feed.note_activity(pace.active_ns)
            if pace.is_due(self.gatherer.topics):
                yield from self._complete(pace)
        yield from self._rest()

    def _complete(self, pace: Pace) -> Iterator[Log]:
        """The windows that are complete by now."""
        if not self._peeked:
            self._peeked = True
            self.gatherer.peek(self.source)
        self._assign(at_end=False)
        for feed in self._feeds.values():
            feed.note_activity(pace.active_ns)
        judged = self._judge(pace.up_to)
        missing_ns = self._advance(self._reached(pace), self._begin(judged))
        end_ns = self._end_ns()
        yield from self._give(judged, NOTHING_DUE if end_ns is None else end_ns)
        if pace.is_stale(self.gatherer.topics):
            self._old = {topic: topic.rows for topic in self.gatherer.topics}
        pace.wait(max(missing_ns + SLACK_NS, self.length_ns // 16), self.gatherer.topics)

    def _reached(self, pace: Pace) -> int | None:
        """The stamp that the log's clock shows; None before the first good row."""
        clocks = (feed.reached(pace.up_to, pace.active_ns) for feed in self._feeds.values())
        return next((t_ns for t_ns in clocks if t_ns is not None), None)

    def _advance(self, reached_ns: int | None, begin_ns: int | None) -> int:
        """Count the windows that are complete; returns the time that the next one still takes."""
        if reached_ns is None or begin_ns is None:
            return self.length_ns
        windows = max((reached_ns - HOLD_NS - begin_ns) // self.length_ns, self._windows)
        if windows > self._windows:
            self._first_ns, self._windows = begin_ns, windows
        return begin_ns + (windows + 1) * self.length_ns + HOLD_NS - reached_ns

    def _end_ns(self) -> int | None:
        """Where the last complete window ends; None before there is one."""
        return None if self._first_ns is None else self._first_ns + self._windows * self.length_ns

    def _rest(self) -> Iterator[Log]:
        """Everything that is left at the end of the file."""
        self._assign(at_end=True)
        yield from self._give(self._judge(None), None)

    def _begin(self, judged: Sequence[Judged]) -> int | None:
        """Where the first window starts: at the first good stamp of all sensors; None before there is one."""
        if self._first_ns is not None:
            return self._first_ns
        return min((int(j.t_ns[np.argmax(j.good)]) for j in judged if j.good.any()), default=None)

    def _assign(self, *, at_end: bool) -> None:
        """Give every sensor its topic, as far as topics are known."""
        complete = at_end or self.gatherer.complete
        topics, definitions = self.gatherer.topics, self.gatherer.definitions
        self.roles = assign(topics, self.chosen, definitions, self.source.path, complete=complete)
        if self.strict and (problem := conflict(self.roles, self.source.path)):
            raise EgolocError(problem)
        for sensor, feed in self._feeds.items():
            topic = self.roles.sensors.get(sensor)
            if topic is not None and topic is not feed.topic and feed.carry.last_ns is not None:
                self.roles.sensors[sensor] = feed.topic
                self.roles.ignored[topic.name] = f"{sensor} came from {feed.topic.name} before its first message"
        for sensor in _FED:
            topic = self.roles.sensors.get(sensor)
            if topic is None:
                self._feeds.pop(sensor, None)
            elif sensor not in self._feeds or self._feeds[sensor].topic is not topic:
                self._feeds[sensor] = Feed(sensor, topic)
        self._feeds = {sensor: self._feeds[sensor] for sensor in _FED if sensor in self._feeds}

    def _judge(self, read_up_to: int | None) -> list[Judged]:
        """All rows of all sensors."""
        floor_ns = self._end_ns()
        last = [feed.carry.last_ns for feed in self._feeds.values() if feed.carry.last_ns is not None]
        judged = []
        with np.errstate(all="ignore"):
            for feed in self._feeds.values():
                feed.carry = replace(feed.carry, floor_ns=floor_ns, alive_ns=max(last, default=None))
                if (one := feed.judge(read_up_to)) is not None:
                    judged.append(one)
        return judged

    def _give(self, judged: Sequence[Judged], end_ns: int | None) -> Iterator[Log]:
        """The rows with stamps before the end (None: all) as Logs over windows, with what was left out by now."""
        windows = self._windows_of(judged, end_ns)
        at_end = end_ns is None
        damaged = list(self._news.since(damage(self.source, self.gatherer, at_end=at_end)))
        self._settle(judged, end_ns)
        if not windows and not at_end:
            self._left_out = [*damaged, *self._left_out]
            return
        facts = self._facts_now()
        unread = (*unused(self.gatherer, self.roles), *self._late_metadata()) if at_end else ()
        if not windows and (damaged or unread or self._left_out or not self.rows.total()):
            windows[0] = {}
        for number in sorted(windows):
            rows, told = windows.pop(number), self._left_out
            if not windows:  # what concerns the whole file stands in the last piece
                told = [*damaged, *told, *unread]
            self._left_out = []
            yield Log(**rows, vehicle=facts.vehicle, map_frame=facts.map_frame, left_out=tuple(told))

    def _windows_of(self, judged: Sequence[Judged], end_ns: int | None) -> dict[int, dict[str, Any]]:
        """Window number -> sensor -> record, of the rows with stamps before the end."""
        begin, windows = self._begin(judged), defaultdict[int, dict[str, Any]](dict)
        for one in judged:
            columns = one.columns(end_ns)
            t_ns = columns["t_ns"]
            if len(t_ns) and begin is not None:
                for number, part in _split(t_ns, begin, self.length_ns):
                    rows = {name: column[part] for name, column in columns.items()}
                    windows[number][one.feed.sensor] = one.decoded.record(**rows)
                if end_ns is not None:
                    one.feed.passed_on(t_ns, columns["arrival_ns"])
                self.rows[one.feed.sensor] += len(t_ns)
        if "pose_modes" in self._feeds:
            for rows in windows.values():
                self._left_out += join_modes(rows, self._feeds["pose_modes"].topic.name)
        return windows

    def _settle(self, judged: Sequence[Judged], end_ns: int | None) -> None:
        """Discard what is done with: given out, bad for a while, or of a topic that feeds nothing."""
        fed = {feed.topic: None for feed in self._feeds.values()}
        for topic in (*fed, *(topic for topic in self.gatherer.topics if topic not in fed)):
            mine = [one for one in judged if one.feed.topic is topic]
            old = self._old.get(topic, 0) if topic in fed else topic.rows
            done, left_out = settle(topic, mine, end_ns, old)
            if self.done is not None:
                self.done(topic, done)
            if end_ns is not None:
                topic.discard(done)
            self._old[topic] = old - int(done[:old].sum())
            self._left_out += left_out

    def _facts_now(self) -> Facts:
        """Vehicle and map frame as they are known at the first piece."""
        if self.facts is None:
            self._metadata = self.source.metadata.get(METADATA)
            self.facts, problem = read_facts(self.source)
            self._problem = problem
        return self.facts

    def _late_metadata(self) -> tuple[LeftOut, ...]:
        """What is wrong with the metadata record, or with its place."""
        if self.source.metadata.get(METADATA) == self._metadata:
            return self._problem
        return (*self._problem, LeftOut(self.source.path.name, f"metadata {METADATA} comes behind rows in use", 1))


def _split(t_ns: NDArray[np.int64], begin: int, length_ns: int) -> Iterator[tuple[int, slice]]:
    """Numbers of the windows from begin on that increasing stamps (N,) fall into, and the rows in each."""
    since = t_ns.view(np.uint64) - np.uint64(begin % (1 << 64))  # a difference may be beyond int64, but is not negative
    numbers = since // np.uint64(length_ns)
    edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(t_ns)]
    for first, stop in itertools.pairwise(edges):
        yield int(numbers[first]), slice(first, stop)
