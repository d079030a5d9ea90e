"""The sums of a drive while it is scored: one row a segment, scene and mode, for each method."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from replay._kernels import sum_outputs
from replay.config import Limits
from replay.outputs import Outputs
from replay.segments import AXES, BELOW, METHODS, SEGMENT_NS, THRESHOLDS, Segments
from replay.sketch import Histograms

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Number = TypeVar("Number", np.int64, np.float64)
Cell = tuple[int, int, int]
"""Segment, scene code, mode code."""

LARGEST_ERROR = 1e100
"""What a diverged filter is off at most: its square is still a number."""
UNKNOWN, COVERED, GOOD, NEAR = range(4)
"""Columns of times and metres: without a reference, with one, within all limits, within those of position."""
_THRESHOLDS = np.array([THRESHOLDS[axis] for axis in AXES])


class Cells:
    """Growing sums.

    Of C cells: span_ns, epochs (C,) int64, span_m (C,): what of the grid is evaluated; of each method times
    (C, 4) ns and metres (C, 4), counts (C, 3, 4) and sums (C, 3, 3) as replay._kernels.sum_outputs describes them.
    """

    def __init__(self, limits: Limits, start_ns: int) -> None:
        self._limits = np.array([limits.lon_m, limits.lat_m, limits.yaw_deg])
        self._start_ns = start_ns
        self._known: dict[Cell, int] = {}
        self._groups: dict[tuple[int, int], int] = {}  # scene and mode
        self._group_of: list[int] = []  # each cell's
        self.histograms = Histograms()
        n = len(METHODS)
        self.span_ns: Integers = np.zeros(0, np.int64)
        self.epochs: Integers = np.zeros(0, np.int64)
        self.span_m: Floats = np.zeros(0)
        self.times: Integers = np.zeros((n, 0, 4), np.int64)
        self.metres: Floats = np.zeros((n, 0, 4))
        self.counts: Integers = np.zeros((n, 0, 3, 4), np.int64)
        self.sums: Floats = np.zeros((n, 0, 3, 3))

    def find(self, t_ns: Integers, scene: NDArray[np.int16], mode: NDArray[np.int16]) -> Integers:
        """(N,) the cell of each stamp."""
        if not len(t_ns):
            return np.empty(0, np.int64)
        segment = np.maximum((t_ns - self._start_ns) // SEGMENT_NS, 0)
        packed, inverse = np.unique((segment << 32) | (scene.astype(np.int64) << 16) | mode, return_inverse=True)
        cells = [(key >> 32, key >> 16 & 0xFFFF, key & 0xFFFF) for key in packed.tolist()]
        places = np.array([self._place(cell) for cell in cells], np.int64)
        if len(self._known) > len(self.span_ns):
            self._grow(2 * len(self._known))
        return places[inverse]

    def _place(self, cell: Cell) -> int:
        """Where the sums of a cell stand."""
        if cell not in self._known:
            self._known[cell] = len(self._known)
            self._group_of.append(self._groups.setdefault(cell[1:], len(self._groups)))
        return self._known[cell]

    def add_grid(self, cell: Integers, cover_ns: Integers, speed: Floats) -> None:
        """Evaluated epochs (N,) of the grid, in time order; speed of the reference, m/s."""
        np.add.at(self.span_ns, cell, cover_ns)
        np.add.at(self.span_m, cell, 1e-9 * cover_ns * speed)
        np.add.at(self.epochs, cell, 1)

    def add_outputs(self, method: str, outputs: Outputs, grid: Outputs, speed: Floats) -> None:
        """Outputs of a method, and all evaluated epochs of the grid that they can stand for, with their speed (G,)."""
        if not len(outputs.t_ns):
            return
        at = METHODS.index(method)
        scored = np.zeros(len(outputs.t_ns), np.bool_)
        error = np.clip(outputs.error, -LARGEST_ERROR, LARGEST_ERROR)
        sum_outputs(
            *(outputs.t_ns, outputs.cover_ns, outputs.cell, error),
            *(grid.t_ns, grid.cover_ns, grid.cell, speed, self._limits, _THRESHOLDS),
            *(self.times[at], self.metres[at], self.counts[at], self.sums[at], scored),
        )
        self._count(at, outputs.cell[scored], np.abs(error[scored]))

    def _count(self, method: int, cell: Integers, size: Floats) -> None:
        """Into the histograms of scene, mode and axis. size: (N, 3) |e|, NaN where an axis is not estimated."""
        axes = len(AXES)
        keys = [(scene, mode, method, axis) for scene, mode in self._groups for axis in range(axes)]
        which = axes * np.array(self._group_of, np.int64)[cell, None] + np.arange(axes)
        known = ~np.isnan(size)
        self.histograms.add(keys, which[known], size[known])

    def table(self, methods: Sequence[str], texts: Mapping[str, Sequence[str]]) -> Segments:
        """The sums of some methods. texts: of scene and mode codes, the log's name, METHODS."""
        parts = [self._of_method(METHODS.index(method)) for method in methods]
        columns: dict[str, NDArray[Any]] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        kept = (columns["evaluated_ns"] > 0) | (columns["lon_count"] > 0)
        columns["log"] = np.zeros(len(kept), np.int32)
        ranks = [_rank(texts[kind])[columns[kind]] for kind in ("mode", "scene")]
        order = np.lexsort((columns["method"], *ranks, columns["segment"]))
        order = order[kept[order]]
        return Segments(texts, {name: column[order] for name, column in columns.items()})

    def _of_method(self, method: int) -> dict[str, NDArray[Any]]:
        """The columns of a method, one row a cell."""
        n = len(self._known)
        times, metres, counts, sums = (a[method, :n] for a in (self.times, self.metres, self.counts, self.sums))
        good = GOOD if counts[:, 2, 0].any() else NEAR  # an axis that a method never estimates is left out
        cells = np.array(list(self._known), np.int64).reshape(n, 3)
        columns: dict[str, NDArray[Any]] = dict(zip(("segment", "scene", "mode"), cells.T, strict=True))
        columns["method"] = np.full(n, method, np.int32)
        columns["epochs"] = self.epochs[:n]
        for unit, span, parts in (("ns", self.span_ns, times), ("m", self.span_m, metres)):
            columns[f"evaluated_{unit}"] = span[:n] - parts[:, UNKNOWN]
            columns |= {f"covered_{unit}": parts[:, COVERED], f"good_{unit}": parts[:, good]}
        for i, axis in enumerate(AXES):
            columns |= {name: counts[:, i, j] for j, name in enumerate((f"{axis}_count", *BELOW[axis]))}
            columns |= {f"{axis}_{name}": sums[:, i, j] for j, name in enumerate(("abs", "squared", "max"))}
        return columns

    def _grow(self, capacity: int) -> None:
        """Room for more cells."""
        self.span_ns, self.epochs = _longer(self.span_ns, capacity, 0), _longer(self.epochs, capacity, 0)
        self.span_m = _longer(self.span_m, capacity, 0)
        self.times, self.metres = _longer(self.times, capacity, 1), _longer(self.metres, capacity, 1)
        self.counts, self.sums = _longer(self.counts, capacity, 1), _longer(self.sums, capacity, 1)


def _longer(array: NDArray[Number], length: int, axis: int) -> NDArray[Number]:
    """The array with zeros behind it, length long along an axis."""
    behind = [(0, length - size if i == axis else 0) for i, size in enumerate(array.shape)]
    return np.pad(array, behind)


def _rank(texts: Sequence[str]) -> NDArray[np.int64]:
    """The place of each text in alphabetical order."""
    return np.argsort(np.argsort(np.array(texts, np.str_)))
