"""A topic's rows on their way into a sensor's record: judged stretch by stretch, given out up to a stamp."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.mcap.columns import Topic
from sensors.mcap.decode import DECODERS
from sensors.mcap.decoded import Decoded, in_order
from sensors.records import LeftOut
from sensors.screening import NOTHING, RUNS_AHEAD, Carry, Verdict, judge, usual_offset

Mask = NDArray[np.bool_]


@dataclass(eq=False)
class Feed:
    """A sensor and its topic. newest: stamp and arrival of the last good row that was surely read; None before."""

    sensor: str
    topic: Topic
    carry: Carry = NOTHING
    newest: tuple[int, int] | None = None
    active_ns: int = 0
    _seen: int = 0

    def note_activity(self, active_ns: int) -> None:
        """active_ns: for how long the log has been running now."""
        if self.topic.seen != self._seen:
            self._seen, self.active_ns = self.topic.seen, active_ns

    def reached(self, read_up_to: int, active_ns: int) -> int | None:
        """The stamp that this sensor's clock shows at a log time up to which everything was read."""
        if self.newest is None:
            return None
        t_ns, arrival_ns = self.newest
        return t_ns + max(min(read_up_to - arrival_ns, active_ns - self.active_ns), 0)

    def judge(self, read_up_to: int | None) -> "Judged | None":
        """Decode and judge all rows of the topic; None where they do not hold this quantity."""
        decoded = DECODERS[self.sensor](self.topic)
        if decoded is None:
            return None
        decoded, order = in_order(decoded)
        t_ns, arrival_ns = decoded.columns["t_ns"], decoded.columns["arrival_ns"]
        verdict = judge(t_ns, arrival_ns, decoded.valid, self.carry)
        good = verdict.code == 0
        if read_up_to is not None:
            read = np.flatnonzero(good & (arrival_ns <= read_up_to))
            if len(read):
                self.newest = int(t_ns[read[-1]]), int(arrival_ns[read[-1]])
        return Judged(self, decoded, order, verdict, good)

    def passed_on(self, t_ns: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> None:
        """Remember what was given out last: (N,) stamps and arrivals."""
        if len(t_ns):
            offset = usual_offset(t_ns, arrival_ns)
            self.carry = replace(self.carry, last_ns=int(t_ns[-1]), offset_ns=offset)


@dataclass(eq=False)
class Judged:
    """A feed's rows in the order in which they were judged: order says which those are (None: as read)."""

    feed: Feed
    decoded: Decoded
    order: NDArray[np.intp] | None
    verdict: Verdict
    good: Mask

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """(N,) stamps."""
        result: NDArray[np.int64] = self.decoded.columns["t_ns"]
        return result

    def due(self, end_ns: int | None) -> Mask:
        """(N,) good rows with a stamp before the end (None: there is none)."""
        return self.good if end_ns is None else self.good & (self.t_ns < end_ns)

    def columns(self, end_ns: int | None) -> Mapping[str, NDArray[Any]]:
        """The columns of the rows that are due."""
        rows = self.due(end_ns)
        count = int(rows.sum())
        chosen: Mask | slice = slice(count) if rows[:count].all() else rows
        return {name: column[chosen] for name, column in self.decoded.columns.items()}


def settle(topic: Topic, judged: Sequence[Judged], end_ns: int | None, old: int) -> tuple[Mask, list[LeftOut]]:
    """(N,) rows of a topic, as read, that are done with, and which of them were left out.

    Done are rows before the last one that is due, and bad ones among the first `old` (those that were there when last
    was settled): judged twice, they stay bad.
    """
    if end_ns is None:
        left_out = [row for j in judged for row in j.verdict.left_out(topic.name)]
        return np.ones(topic.rows, bool), list(dict.fromkeys(left_out))
    last = max((int(due[-1]) + 1 for j in judged if len(due := np.flatnonzero(j.due(end_ns)))), default=0)
    order = next((j.order for j in judged if j.order is not None), None)
    done = (np.arange(topic.rows) if order is None else order) < old
    for j in judged:
        done &= ~j.good
    done[:last] = True
    left_out = []
    for j in judged:
        stray = int((done & j.good & ~j.due(end_ns)).sum())  # of two sensors of a topic one went on, the other did not
        mine = (*j.verdict.left_out(topic.name, done), *([LeftOut(topic.name, RUNS_AHEAD, stray)] if stray else []))
        left_out += mine
    if order is not None:
        done[order] = done.copy()
    return done, list(dict.fromkeys(left_out))
