"""Fixes of one sensor on their way into the sums: each waits until the grid has come as far as it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

COVER_PERIODS = 1.5
"""An output stands for at most this many nominal periods."""
NOMINAL_NS = 300 * NS_PER_S
"""A sensor's nominal period is the median over this long from its first fix on."""


@dataclass(frozen=True, slots=True, eq=False)
class Outputs:
    """Outputs in time order.

    t_ns, cover_ns (N,): each stands for ]t - cover, t]; cell (N,) its row of the sums; error (N, 3) m, m, deg.
    """

    t_ns: Integers
    cover_ns: Integers
    cell: Integers
    error: Floats


def cover_ns(t_ns: Integers, longest_ns: int, before_ns: int | None = None) -> Integers:
    """(N,) ns that each output stands for: back to the one before it, but no further than longest_ns.

    before_ns: the one before the first; None: there is none, and the first stands for nothing.
    """
    if not len(t_ns):
        return np.empty(0, np.int64)
    steps = np.diff(t_ns, prepend=t_ns[0] if before_ns is None else before_ns)
    return np.minimum(steps, longest_ns)


def longest_cover_ns(period_ns: float) -> int:
    """COVER_PERIODS periods."""
    return round(COVER_PERIODS * period_ns)


class Waiting:
    """The fixes of a sensor that are not summed yet. Each counts once; stamps increase from batch to batch."""

    def __init__(self) -> None:
        self._t_ns = np.empty(0, np.int64)
        self._cell = np.empty(0, np.int64)
        self._error = np.empty((0, 3))
        self._before_ns: int | None = None  # the last that is summed
        self._last_row = -1
        self._longest_ns: int | None = None

    def add(self, t_ns: Integers, row: Integers, cell: Integers, error: Floats) -> None:
        """Fixes in any order; row: in the log's record, by which a fix that comes twice is known."""
        _, first = np.unique(row, return_index=True)
        first = first[row[first] > self._last_row]
        first = first[np.argsort(t_ns[first], kind="stable")]
        if not len(first):
            return
        self._last_row = int(row[first].max())
        self._t_ns = np.concatenate((self._t_ns, t_ns[first]))
        self._cell = np.concatenate((self._cell, cell[first]))
        self._error = np.concatenate((self._error, error[first]))

    def take(self, upto_ns: int | None) -> Outputs:
        """The fixes up to a time (None: all), which wait no longer; none before the nominal period is known."""
        if self._longest_ns is None:
            self._longest_ns = self._longest(final=upto_ns is None)
        ready = 0
        if self._longest_ns is not None:
            ready = len(self._t_ns) if upto_ns is None else int(np.searchsorted(self._t_ns, upto_ns, side="right"))
        t_ns = self._t_ns[:ready]
        taken = Outputs(
            t_ns, cover_ns(t_ns, self._longest_ns or 0, self._before_ns), self._cell[:ready], self._error[:ready]
        )
        if ready:
            self._before_ns = int(t_ns[-1])
            self._t_ns, self._cell, self._error = self._t_ns[ready:], self._cell[ready:], self._error[ready:]
        return taken

    def needs_after_ns(self, seen_ns: int) -> int:
        """The grid up to this time is no longer needed, if the fixes still to come are later than seen_ns."""
        if self._before_ns is None:
            return int(self._t_ns[0]) if len(self._t_ns) else seen_ns
        return self._before_ns if len(self._t_ns) else max(self._before_ns, seen_ns - (self._longest_ns or 0))

    def _longest(self, *, final: bool) -> int | None:
        """What a fix stands for at most; None while that is not known."""
        if not len(self._t_ns) or not (final or self._t_ns[-1] > self._t_ns[0] + NOMINAL_NS):
            return None
        inside = max(int(np.searchsorted(self._t_ns, self._t_ns[0] + NOMINAL_NS, side="right")), 2)
        steps = np.diff(self._t_ns[:inside])
        return longest_cover_ns(float(np.median(steps))) if len(steps) else 0
