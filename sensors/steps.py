"""Counts the steps between stamps of a source of any length: its rate, its gaps, in bounded memory."""

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S

Ints = NDArray[np.int64]

DISTINCT = 1 << 16
"""Steps of different length that are told apart; from then on to within 0.4 %."""
_BITS = 9


class Steps:
    """Stamps that came so far: count, first_ns, last_ns (None before the first), longest_ns step (None before two)."""

    def __init__(self) -> None:
        self.count = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.longest_ns: int | None = None
        self._lengths = np.zeros(0, np.int64)
        self._counts = np.zeros(0, np.int64)
        self._coarse = False

    def add(self, t_ns: Ints) -> None:
        """Take in the stamps (N,) of the next stretch, sorted; the step from the stretch before counts as well."""
        if not len(t_ns):
            return
        steps = np.diff(t_ns)
        if self.first_ns is None or self.last_ns is None:
            self.first_ns = self.last_ns = int(t_ns[0])
        else:
            steps = np.concatenate(([max(int(t_ns[0]) - self.last_ns, 0)], steps))
        self.count += len(t_ns)
        self.first_ns, self.last_ns = min(self.first_ns, int(t_ns[0])), max(self.last_ns, int(t_ns[-1]))
        if len(steps):
            self.longest_ns = max(self.longest_ns or 0, int(steps.max()))
            self._count(steps)

    def _count(self, steps: Ints) -> None:
        lengths, counts = np.unique(self._cut(steps) if self._coarse else steps, return_counts=True)
        self._merge(np.concatenate((self._lengths, lengths)), np.concatenate((self._counts, counts)))
        if len(self._lengths) > DISTINCT and not self._coarse:
            self._coarse = True
            self._merge(self._cut(self._lengths), self._counts)

    def _merge(self, lengths: Ints, counts: Ints) -> None:
        self._lengths, place = np.unique(lengths, return_inverse=True)
        self._counts = np.bincount(place, counts, len(self._lengths)).astype(np.int64)

    @staticmethod
    def _cut(lengths: Ints) -> Ints:
        """Lengths with all but their highest bits cleared."""
        _, exponent = np.frexp(lengths.astype(np.float64))
        shift = np.maximum(exponent - _BITS, 0).astype(np.int64)
        result: Ints = (lengths >> shift) << shift
        return result

    def median_ns(self) -> float | None:
        """The median step."""
        total = int(self._counts.sum())
        if not total:
            return None
        ends = np.cumsum(self._counts)
        low, high = np.searchsorted(ends, ((total - 1) // 2, total // 2), side="right")
        return (float(self._lengths[low]) + float(self._lengths[high])) / 2

    def rate_hz(self) -> float | None:
        """Of the median step; None where that is unknown or zero."""
        median = self.median_ns()
        return NS_PER_S / median if median else None

    def above(self, length_ns: int) -> int:
        """How many steps are longer."""
        return int(self._counts[self._lengths > length_ns].sum())
