"""Which rows of a raw source may become a record: finite, in order, stamped near their arrival. The rest is counted."""

from bisect import bisect_left
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sensors.records import LeftOut

Mask = NDArray[np.bool_]
Nanoseconds = NDArray[np.int64]

JUMP_NS = 10_000_000_000
"""A stamp this far from its arrival (beyond the log's usual offset) has jumped."""
APART_NS = 3_600_000_000_000
"""A pause this long parts a source: a clock that was set in between, or another drive."""
_NONE = np.iinfo(np.int64).min


def screen(
    source: str, t_ns: Nanoseconds, arrival_ns: Nanoseconds, valid: Mapping[str, Mask]
) -> tuple[Mask, tuple[LeftOut, ...]]:
    """Rows to keep, (N,) bool, and what was left out with its reason.

    valid: reason -> (N,) mask of rows that pass it, e.g. ``{"gyro is not finite": np.isfinite(gyro).all(1)}``.
    Then stamps: out go those that jump away from their arrival; as few as it takes for the others to increase (of two
    equal ones the second); and what lies an hour or more apart from the largest part.
    """
    keep = np.ones(len(t_ns), bool)
    left_out: list[LeftOut] = []

    def drop(reason: str, bad: Mask) -> None:
        bad = bad & keep
        if bad.any():
            left_out.append(LeftOut(source, reason, int(bad.sum())))
            keep[bad] = False

    for reason, passes in valid.items():
        drop(reason, ~passes)
    drop("stamp jumps away from its arrival", _jumped(t_ns, arrival_ns, keep))
    rows = np.flatnonzero(keep)
    if (np.diff(t_ns[rows]) <= 0).any():
        chosen = np.zeros(len(t_ns), bool)
        chosen[rows[_increasing(t_ns[rows])]] = True
        previous = np.full(len(t_ns), _NONE)
        previous[1:] = np.maximum.accumulate(np.where(chosen, t_ns, _NONE))[:-1]
        drop("stamp repeats", ~chosen & (t_ns == previous))
        drop("stamp goes back", ~chosen & (t_ns < previous))
        drop("stamp runs ahead of those that follow", ~chosen)
    drop("stamp lies an hour or more apart from most others", _apart(t_ns, keep))
    return keep, tuple(left_out)


def _jumped(t_ns: Nanoseconds, arrival_ns: Nanoseconds, keep: Mask) -> Mask:
    """(N,) rows whose stamp is far from its arrival.

    None where all arrivals are the same, or half of the rows would go: then the arrivals tell nothing.
    """
    offset = t_ns.astype(np.float64) - arrival_ns.astype(np.float64)  # int64 could overflow; 0.2 us do not matter
    nothing = np.zeros(len(t_ns), bool)
    if not keep.any() or np.ptp(offset) <= JUMP_NS or not np.ptp(arrival_ns[keep]):
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


def _apart(t_ns: Nanoseconds, keep: Mask) -> Mask:
    """(N,) rows outside the largest part that no long pause interrupts; the rows to keep have increasing stamps."""
    rows = np.flatnonzero(keep)
    outside = np.zeros(len(t_ns), bool)
    if not len(rows) or float(t_ns[rows[-1]]) - float(t_ns[rows[0]]) < APART_NS:
        return outside
    parts = np.split(rows, np.flatnonzero(np.diff(t_ns[rows]) >= APART_NS) + 1)
    outside[rows] = True
    outside[max(parts, key=len)] = False
    return outside
