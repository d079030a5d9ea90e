"""Histograms of error sizes, fine enough for percentiles to 0.2 %, that add up over logs without loss.

A bin holds the float64 numbers that agree in their exponent and the first eight bits of their fraction: it is at most
2^-8 of its lower edge wide, so that its mid-point lies within 2^-9 (0.2 %) of every number in it. Bins reach from 2^-40
to 2^40 (1e-12 to 1e12 m or deg); what is smaller counts as 0, what is larger as the largest. After HdrHistogram (G.
Tene), whose buckets are divided in the same way.
"""

from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from replay.arrow import read_columns, text_codes, text_column

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

Key = tuple[str, str, str, str]
"""Scene text, mode, method, axis."""

FRACTION_BITS = 8
ACCURACY = 2.0 ** -(FRACTION_BITS + 1)
"""Largest relative error of an order statistic."""
_SHIFT = 52 - FRACTION_BITS
_EXPONENTS = (-40, 40)
_FIRST = ((1023 + _EXPONENTS[0]) << FRACTION_BITS) - 1
BINS = ((_EXPONENTS[1] - _EXPONENTS[0]) << FRACTION_BITS) + 2
"""One below the smallest and one above the largest bin included."""
_BIN_BITS = BINS.bit_length()
_TEXTS = ("scene", "mode", "method", "axis")
_NUMBERS = {"bin": np.int32, "count": np.int64}


def bins(size: Floats) -> Integers:
    """The bin of each number; none is negative or NaN."""
    index: Integers = (np.ascontiguousarray(size, np.float64).view(np.int64) >> _SHIFT) - _FIRST
    return np.clip(index, 0, BINS - 1, out=index)


def middle(index: Integers) -> Floats:
    """The number that stands for each bin: 0 for the first, infinity for the last."""
    lower, upper = (((index + _FIRST + i) << _SHIFT).view(np.float64) for i in (0, 1))
    return np.where(index == 0, 0.0, np.where(index == BINS - 1, np.inf, lower + (upper - lower) / 2))


def percentiles(counts: Integers, shares: Iterable[float], largest: float) -> list[float]:
    """Percentiles (0..100) of a histogram (BINS,) that is not empty, interpolated linearly between ranks.

    largest: the largest number itself, which no percentile exceeds.
    """
    filled = np.flatnonzero(counts)
    upto = np.cumsum(counts[filled])
    values = np.minimum(middle(filled), largest)
    rank = np.asarray(tuple(shares), np.float64) / 100 * (upto[-1] - 1)
    low, high = (values[np.searchsorted(upto, edge, side="right")] for edge in (np.floor(rank), np.ceil(rank)))
    result: list[float] = (low + (rank - np.floor(rank)) * (high - low)).tolist()
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Sketch:
    """Histograms, one for each key (scene text, mode, method, axis).

    keys: K, sorted; edges: (K + 1,) rows at which each begins and ends; bin: (R,) int32 bins that are not empty,
    increasing within a key; count: (R,) int64.
    """

    keys: tuple[Key, ...]
    edges: Integers
    bin: NDArray[np.int32]
    count: Integers

    def total(self, chosen: Callable[[Key], bool]) -> Integers:
        """(BINS,) the sum of the histograms whose keys are chosen."""
        result = np.zeros(BINS, np.int64)
        for key, begin, end in zip(self.keys, self.edges[:-1], self.edges[1:], strict=True):
            if chosen(key):
                result[self.bin[begin:end]] += self.count[begin:end]
        return result

    def chosen(self, wanted: Callable[[Key], bool]) -> "Sketch":
        """The histograms of some keys."""
        kept = [i for i, key in enumerate(self.keys) if wanted(key)]
        rows = [slice(*self.edges[i : i + 2].tolist()) for i in kept]
        edges = np.cumsum([0, *(row.stop - row.start for row in rows)])
        bin_, count = (
            np.concatenate([column[:0], *(column[row] for row in rows)]) for column in (self.bin, self.count)
        )
        return Sketch(tuple(self.keys[i] for i in kept), edges, bin_, count)

    def write(self, path: Path) -> None:
        """One row a bin that is not empty."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        codes = np.repeat(np.arange(len(self.keys), dtype=np.int32), np.diff(self.edges))
        texts = {name: text_column(codes, [key[i] for key in self.keys]) for i, name in enumerate(_TEXTS)}
        table = pa.table(texts | {"bin": pa.array(self.bin), "count": pa.array(self.count)})
        packed = dict.fromkeys(_NUMBERS, "DELTA_BINARY_PACKED")  # neighbours differ by little: a byte a row
        pq.write_table(
            *(table, path),
            compression="zstd",
            use_dictionary=list(_TEXTS),
            column_encoding=packed,
            write_statistics=False,
            write_page_checksum=True,
        )

    @classmethod
    def read(cls, path: Path) -> Self:
        """The histograms in a file; EgolocError names what is wrong with it."""
        table = read_columns(path, _TEXTS, _NUMBERS)
        columns = [text_codes(table[name]) for name in _TEXTS]
        changes = [np.diff(codes) != 0 for codes, _ in columns]
        starts = np.flatnonzero(np.r_[len(table) > 0, np.any(changes, axis=0)])
        keys = [tuple(texts[codes[row]] for codes, texts in columns) for row in starts]
        edges = np.r_[starts, len(table)].astype(np.int64)
        return cls(tuple(keys), edges, table["bin"].to_numpy(), table["count"].to_numpy())


class Histograms:
    """Histograms that grow."""

    def __init__(self) -> None:
        self._counts: dict[Hashable, Integers] = {}

    def add(self, keys: Sequence[Hashable], which: Integers, size: Floats) -> None:
        """Count numbers (N,), none negative or NaN, each under keys[which]."""
        packed, count = np.unique(which << _BIN_BITS | bins(size), return_counts=True)
        edges = np.searchsorted(packed, np.arange(len(keys) + 1) << _BIN_BITS)
        for key, begin, end in zip(keys, edges[:-1], edges[1:], strict=True):
            if end > begin:
                self._of(key)[packed[begin:end] & (1 << _BIN_BITS) - 1] += count[begin:end]

    def join(self, sketch: Sketch) -> None:
        """Count everything in a sketch."""
        for key, begin, end in zip(sketch.keys, sketch.edges[:-1], sketch.edges[1:], strict=True):
            self._of(key)[sketch.bin[begin:end]] += sketch.count[begin:end]

    def sketch(self, named: Callable[[Any], Key] = tuple, methods: Collection[str] | None = None) -> Sketch:
        """What was counted; named: what a key stands for; methods: the only ones (None: all)."""
        every = {named(key): counts for key, counts in self._counts.items()}
        counts = {key: every[key] for key in sorted(every) if methods is None or key[2] in methods}
        filled = [np.flatnonzero(column) for column in counts.values()]
        edges = np.r_[0, np.cumsum([len(index) for index in filled])].astype(np.int64)
        bin_ = np.concatenate([np.empty(0, np.int64), *filled]).astype(np.int32)
        count = [column[index] for column, index in zip(counts.values(), filled, strict=True)]
        return Sketch(tuple(counts), edges, bin_, np.concatenate([np.empty(0, np.int64), *count]))

    def _of(self, key: Hashable) -> Integers:
        if key not in self._counts:
            self._counts[key] = np.zeros(BINS, np.int64)
        return self._counts[key]
