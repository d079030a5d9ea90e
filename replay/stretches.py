"""How far the filter had drifted at the end of every stretch of hidden GNSS."""

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


class StretchEnds:
    """The last epoch of each stretch that has a reference, a state and a sigma, batch by batch."""

    def __init__(self) -> None:
        self._ends: dict[int, tuple[int, float, float]] = {}
        self._last_gnss: dict[int, int | None] = {}
        self._open: set[int] = set()
        self._used_ns = np.empty(0, np.int64)  # of GNSS positions that were applied

    def add(self, states: Columns, decisions: Columns, seen_ns: int) -> None:
        """The next batch; all decisions up to seen_ns are known with it."""
        self._add_states(states)
        used = (decisions["sensor"] == Sensor.GNSS_POSITION) & decisions["accepted"]
        self._used_ns = np.sort(np.concatenate((self._used_ns, decisions["t_ns"][used])))
        self._close(seen_ns)
        reached = [int(states["t_ns"][-1])] if len(states["t_ns"]) else []
        needed = min([seen_ns, *reached, *(self._ends[index][0] for index in self._open)])
        self._used_ns = self._used_ns[max(int(np.searchsorted(self._used_ns, needed, side="right")) - 1, 0) :]

    def entries(self, planned: list[tuple[int, int]], start_ns: int) -> list[Entry]:
        """One stretch each: start since the log's, horizontal error and sigma at its last epoch that has both."""
        self._close(None)
        return [self._entry(index, start, end, start_ns) for index, (start, end) in enumerate(planned)]

    def _add_states(self, states: Columns) -> None:
        inside = states["stretch"] >= 0
        if not inside.any():
            return
        rows = np.flatnonzero(inside & np.all([np.isfinite(states[name]) for name in _KNOWN], axis=0))
        index = states["stretch"][rows]
        for last in rows[np.flatnonzero(np.diff(index, append=-1))]:
            miss = np.hypot(*(states[axis][last] - states[f"ref_{axis}"][last] for axis in "xy"))
            sigma = np.hypot(states["sigma_lon"][last], states["sigma_lat"][last])
            stretch = int(states["stretch"][last])
            self._ends[stretch] = (int(states["t_ns"][last]), float(miss), float(sigma))
            self._open.add(stretch)

    def _close(self, seen_ns: int | None) -> None:
        """Find the last GNSS position before the end of stretches whose decisions are all known (None: all)."""
        for index in [i for i in self._open if seen_ns is None or self._ends[i][0] < seen_ns]:
            before = int(np.searchsorted(self._used_ns, self._ends[index][0], side="right"))
            self._last_gnss[index] = int(self._used_ns[before - 1]) if before else None
            self._open.remove(index)

    def _entry(self, index: int, start: int, end: int, start_ns: int) -> Entry:
        entry: Entry = {
            "start_s": (start - start_ns) / NS_PER_S,
            **dict.fromkeys(("end_horizontal_m", "end_sigma_m", "since_gnss_s")),
        }
        if index not in self._ends or end - self._ends[index][0] > END_TOLERANCE_NS:
            return entry
        t_ns, entry["end_horizontal_m"], entry["end_sigma_m"] = self._ends[index]
        last = self._last_gnss[index]
        entry["since_gnss_s"] = None if last is None else (t_ns - last) / NS_PER_S
        return entry
