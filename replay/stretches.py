"""How far the filter had drifted in every stretch of hidden GNSS: at its end, and at worst."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.result import Sensor
from sensors.clock import NS_PER_S

Columns = dict[str, NDArray[Any]]
Entry = dict[str, Any]

END_TOLERANCE_NS = NS_PER_S
"""The last known epoch of a hidden stretch must lie this near its end for its error to count as that of the end."""
_KNOWN = ("ref_x", "x", "y", "sigma_lon", "sigma_lat")


class StretchErrors:
    """Horizontal errors in each stretch, batch by batch, at epochs that have a reference, a state and a sigma."""

    def __init__(self) -> None:
        self.ends: dict[int, tuple[int, float, float]] = {}
        """Time, error and sigma of the last epoch of each."""
        self._within: dict[int, tuple[int, float, float]] = {}  # epochs, largest error, sum of (error / sigma)^2

    def add(self, states: Columns) -> list[int]:
        """The next rows of states; which stretches they lie in."""
        inside = states["stretch"] >= 0
        if not inside.any():
            return []
        rows = np.flatnonzero(inside & np.all([np.isfinite(states[name]) for name in _KNOWN], axis=0))
        index = states["stretch"][rows]
        miss = np.hypot(*(states[axis][rows] - states[f"ref_{axis}"][rows] for axis in "xy"))
        sigma = np.hypot(states["sigma_lon"][rows], states["sigma_lat"][rows])
        edges = np.flatnonzero(np.diff(index, prepend=-1, append=-1))
        for first, end in pairwise(edges):
            stretch, last = int(index[first]), end - 1
            self.ends[stretch] = (int(states["t_ns"][rows[last]]), float(miss[last]), float(sigma[last]))
            self._add_within(stretch, miss[first:end], sigma[first:end])
        return [int(stretch) for stretch in np.unique(index)]

    def within(self, stretch: int) -> Entry | None:
        """The largest error, m, and the rms of error over sigma of a stretch's epochs; None: it has none."""
        if stretch not in self._within:
            return None
        count, largest, squares = self._within[stretch]
        return {"largest_horizontal_m": largest, "error_over_sigma_rms": math.sqrt(squares / count)}

    def _add_within(self, stretch: int, miss: NDArray[np.float64], sigma: NDArray[np.float64]) -> None:
        count, largest, squares = self._within.get(stretch, (0, 0.0, 0.0))
        for square in np.square(miss / sigma).tolist():  # one by one: batches must not change a digit
            squares += square
        self._within[stretch] = count + len(miss), max(largest, float(miss.max())), squares


class StretchEnds:
    """What is told of each stretch: the filter's errors, the smoothed ones, and how long GNSS had been away."""

    def __init__(self) -> None:
        self._filter, self._smoothed = StretchErrors(), StretchErrors()
        self._last_gnss: dict[int, int | None] = {}
        self._open: set[int] = set()
        self._used_ns = np.empty(0, np.int64)  # of GNSS positions that were applied

    def add(self, states: Columns, decisions: Columns, seen_ns: int) -> None:
        """The next batch; all decisions up to seen_ns are known with it."""
        self._open |= set(self._filter.add(states))
        used = (decisions["sensor"] == Sensor.GNSS_POSITION) & decisions["accepted"]
        self._used_ns = np.sort(np.concatenate((self._used_ns, decisions["t_ns"][used])))
        self._close(seen_ns)
        reached = [int(states["t_ns"][-1])] if len(states["t_ns"]) else []
        needed = min([seen_ns, *reached, *(self._filter.ends[index][0] for index in self._open)])
        self._used_ns = self._used_ns[max(int(np.searchsorted(self._used_ns, needed, side="right")) - 1, 0) :]

    def add_smoothed(self, states: Columns) -> None:
        """The next smoothed states."""
        self._smoothed.add(states)

    def entries(self, planned: list[tuple[int, int]], start_ns: int, *, smoothed: bool = False) -> list[Entry]:
        """One stretch each: start since the log's, horizontal error and sigma at its last epoch that has both, and
        errors within it, of the filter and, where there are any, of the smoothed states."""
        self._close(None)
        return [
            self._entry(index, start, end, start_ns)
            | {"within": self._filter.within(index)}
            | ({"smoothed": self._smoothed.within(index)} if smoothed else {})
            for index, (start, end) in enumerate(planned)
        ]

    def _close(self, seen_ns: int | None) -> None:
        """Find the last GNSS position before the end of stretches whose decisions are all known (None: all)."""
        ends = self._filter.ends
        for index in [i for i in self._open if seen_ns is None or ends[i][0] < seen_ns]:
            before = int(np.searchsorted(self._used_ns, ends[index][0], side="right"))
            self._last_gnss[index] = int(self._used_ns[before - 1]) if before else None
            self._open.remove(index)

    def _entry(self, index: int, start: int, end: int, start_ns: int) -> Entry:
        ends = self._filter.ends
        entry: Entry = {
            "start_s": (start - start_ns) / NS_PER_S,
            **dict.fromkeys(("end_horizontal_m", "end_sigma_m", "since_gnss_s")),
        }
        if index not in ends or end - ends[index][0] > END_TOLERANCE_NS:
            return entry
        t_ns, entry["end_horizontal_m"], entry["end_sigma_m"] = ends[index]
        last = self._last_gnss[index]
        entry["since_gnss_s"] = None if last is None else (t_ns - last) / NS_PER_S
        return entry
