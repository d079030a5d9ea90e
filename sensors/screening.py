"""Which rows of a raw source may become a record: finite, in order, stamped near their arrival. The rest is counted.

A source that comes in stretches is judged stretch by stretch; Carry is what the earlier ones leave to the next.
"""

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.records import LeftOut

Mask = NDArray[np.bool_]
Nanoseconds = NDArray[np.int64]

JUMP_NS = 10_000_000_000
"""A stamp this far from its arrival (beyond the log's usual offset) has jumped."""
APART_NS = 3_600_000_000_000
"""A pause this long parts a source: a clock that was set in between, or another drive."""
RUNS_AHEAD = "stamp runs ahead of those that follow"
_NONE = np.iinfo(np.int64).min


@dataclass(frozen=True)
class Carry:
    """What is known from earlier stretches; None where there were none.

    last_ns: the last stamp that was kept; floor_ns: stamps before it come too late; alive_ns: the newest stamp that was
    kept of any source of the log; offset_ns: the usual stamp less arrival.
    """

    last_ns: int | None = None
    floor_ns: int | None = None
    alive_ns: int | None = None
    offset_ns: float | None = None


NOTHING = Carry()


@dataclass(frozen=True)
class Verdict:
    """code: (N,) int8, 0 for a row to keep, k for one that is left out for reasons[k - 1]."""

    code: NDArray[np.int8]
    reasons: tuple[str, ...]

    def left_out(self, source: str, rows: Mask | slice = slice(None)) -> tuple[LeftOut, ...]:
        """How many of the rows were left out for each reason."""
        counts = np.bincount(self.code[rows], minlength=len(self.reasons) + 1)[1:]
        return tuple(LeftOut(source, reason, int(n)) for reason, n in zip(self.reasons, counts, strict=True) if n)


def screen(
    source: str, t_ns: Nanoseconds, arrival_ns: Nanoseconds, valid: Mapping[str, Mask]
) -> tuple[Mask, tuple[LeftOut, ...]]:
    """Rows to keep, (N,) bool, and what was left out with its reason. See judge."""
    verdict = judge(t_ns, arrival_ns, valid)
    return verdict.code == 0, verdict.left_out(source)


def judge(t_ns: Nanoseconds, arrival_ns: Nanoseconds, valid: Mapping[str, Mask], carry: Carry = NOTHING) -> Verdict:
    """Which rows of a stretch to keep, and why not the others.

    valid: reason -> (N,) mask of rows that pass it, e.g. ``{"gyro is not finite": np.isfinite(gyro).all(1)}``.
    Then stamps: out go those that jump away from their arrival; as few as it takes for the others to increase (of two
    equal ones the second); and what lies an hour or more apart from the largest part.

    With something carried over, stamps must increase from the last one kept; a jump is one from the usual offset so
    far, unless no row comes back from it: then the clock was set, and is followed; and instead of the largest part that
    one counts which goes on from the log's newest stamp.
    """
    code = np.zeros(len(t_ns), np.int8)
    reasons: list[str] = []

    def drop(reason: str, bad: Mask) -> None:
        bad = bad & (code == 0)
        if bad.any():
            reasons.append(reason)
            code[bad] = len(reasons)

    for reason, passes in valid.items():
        if not passes.all():
            drop(reason, ~passes)
    drop("stamp jumps away from its arrival", _jumped(t_ns, arrival_ns, code == 0, carry.offset_ns))
    last = _NONE if carry.last_ns is None else carry.last_ns
    floor = _NONE if carry.floor_ns is None else carry.floor_ns
    rows = np.flatnonzero(code == 0)
    if len(rows) and (t_ns[rows[0]] < floor or t_ns[rows[0]] <= last or (np.diff(t_ns[rows]) <= 0).any()):
        rows = rows[(t_ns[rows] > last) & (t_ns[rows] >= floor)]
        chosen = np.zeros(len(t_ns), bool)
        chosen[rows[_increasing(t_ns[rows])]] = True
        previous = np.full(len(t_ns), last)
        previous[1:] = np.maximum(np.maximum.accumulate(np.where(chosen, t_ns, _NONE))[:-1], last)
        drop("stamp repeats", ~chosen & (t_ns == previous))
        drop("stamp goes back", ~chosen & (t_ns < previous))
        drop("message comes too late, after others of its time were passed on", ~chosen & (t_ns < floor))
        drop(RUNS_AHEAD, ~chosen)
    drop("stamp lies an hour or more apart from most others", _apart(t_ns, code == 0, carry.alive_ns))
    return Verdict(code, tuple(reasons))


def usual_offset(t_ns: Nanoseconds, arrival_ns: Nanoseconds) -> float:
    """The median stamp less arrival, ns."""
    return float(np.percentile(_offset(t_ns, arrival_ns), 50, method="lower"))


def _offset(t_ns: Nanoseconds, arrival_ns: Nanoseconds) -> NDArray[np.float64]:
    return t_ns.astype(np.float64) - arrival_ns.astype(np.float64)  # int64 could overflow; 0.2 us do not matter


def _jumped(t_ns: Nanoseconds, arrival_ns: Nanoseconds, keep: Mask, usual: float | None) -> Mask:
    """(N,) rows whose stamp is far from its arrival; usual: the offset so far.

    Without it, the median is usual. With it, a clock counts as set where at the end, for JUMP_NS or throughout, all
    rows are far: these go by their own median. Nothing is far where all arrivals are the same.
    """
    far = np.zeros(len(t_ns), bool)
    if not keep.any():
        return far
    offset = _offset(t_ns, arrival_ns)
    if usual is None:
        return far if np.ptp(offset) <= JUMP_NS else _far_from_median(offset, arrival_ns, keep)
    if not np.ptp(arrival_ns[keep]):
        return far
    far = np.abs(offset - usual) > JUMP_NS
    near = np.flatnonzero(keep & ~far)
    end = np.arange(len(t_ns)) > (near[-1] if len(near) else -1)
    if (end & keep).any() and (not len(near) or np.ptp(arrival_ns[end & keep]) >= JUMP_NS):
        far[end] = _far_from_median(offset[end], arrival_ns[end], keep[end])
    return far


def _far_from_median(offset: NDArray[np.float64], arrival_ns: Nanoseconds, keep: Mask) -> Mask:
    """(N,) rows far from the median offset.

    None where all arrivals are the same, or half of the rows would go: then the arrivals tell nothing.
    """
    nothing = np.zeros(len(offset), bool)
    if not np.ptp(arrival_ns[keep]):
        return nothing
    far: Mask = np.abs(offset - np.percentile(offset[keep], 50, method="lower")) > JUMP_NS
    return far if 2 * int((far & keep).sum()) < int(keep.sum()) else nothing


def _increasing(t_ns: Nanoseconds) -> NDArray[np.intp]:
    """Rows of the longest strictly increasing subsequence of stamps (N,); where several are as long, the first rows.

    Rows above all before and below all after belong to it; the others go through patience sorting (Fredman 1975).
    """
    highest, lowest = np.maximum.accumulate(t_ns), np.minimum.accumulate(t_ns[::-1])[::-1]
    chosen = np.ones(len(t_ns), bool)
    chosen[1:] &= t_ns[1:] > highest[:-1]
    chosen[:-1] &= t_ns[:-1] < lowest[1:]
    unsettled = np.flatnonzero(~chosen)[::-1]  # from the last on: of equally good rows the first comes last and stands
    starts: list[int] = []  # the latest stamp that starts a subsequence of each length, negated, and its row
    start_rows: list[int] = []
    after: dict[int, int] = {}
    for row, stamp in zip(unsettled.tolist(), (-t_ns[unsettled]).tolist(), strict=True):
        length = bisect_left(starts, stamp)
        after[row] = start_rows[length - 1] if length else -1
        starts[length : length + 1], start_rows[length : length + 1] = [stamp], [row]
    row = start_rows[-1] if start_rows else -1
    while row >= 0:
        chosen[row] = True
        row = after[row]
    return np.flatnonzero(chosen)


def _apart(t_ns: Nanoseconds, keep: Mask, alive_ns: int | None) -> Mask:
    """(N,) rows outside the part, uninterrupted by a long pause, that goes on from alive_ns, or else the largest.

    The rows to keep have increasing stamps.
    """
    rows = np.flatnonzero(keep)
    outside = np.zeros(len(t_ns), bool)
    if not len(rows):
        return outside
    before = float(t_ns[rows[0]]) if alive_ns is None else min(float(alive_ns), float(t_ns[rows[0]]))
    if float(t_ns[rows[-1]]) - before < APART_NS:
        return outside
    parts = np.split(rows, np.flatnonzero(np.diff(t_ns[rows]) >= APART_NS) + 1)
    outside[rows] = True
    if alive_ns is None:
        outside[max(parts, key=len)] = False
    elif float(t_ns[rows[0]]) - before < APART_NS:
        outside[parts[0]] = False
    return outside
