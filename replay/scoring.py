"""From the tables of a run to its sums, batch by batch: nothing else is needed, so new limits need no new replay.

Whatever the batches, the sums are the same to the last bit.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.result import Reason, Sensor
from replay.cells import Cells
from replay.config import Limits
from replay.metrics import SENSORS, methods_of, well_known
from replay.outputs import Outputs, Waiting, cover_ns, longest_cover_ns
from replay.references import Excluded
from replay.run_files import Facts
from replay.segments import AXES, METHODS
from replay.stretches import StretchEnds
from replay.sums import Counts, Sums
from sensors.clock import NS_PER_S
from sensors.records import GnssStatus

Floats = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

STATES = (
    *("t_ns", "x", "y", "ref_x", "ref_y", "ref_yaw", "ref_speed", "ref_sigma_m", "ref_sigma_yaw", "excluded"),
    *("err_lon", "err_lat", "err_yaw", "sigma_lon", "sigma_lat", "stretch", "scene", "mode"),
)
DECISIONS = (
    *("t_ns", "sensor", "row", "reason", "accepted", "status"),
    *("err_lon", "err_lat", "err_yaw", "scene", "mode"),
)
"""The columns of both tables that scoring reads."""
HOLD_NS = 60 * NS_PER_S
"""A decision may be this much older than another of a batch before."""
_UNCOUNTED = tuple(why.name.lower() for why in (Excluded.EVALUATED, Excluded.NOT_HIDDEN))
_ERRORS = ("err_lon", "err_lat", "err_yaw")


class Scorer:
    """Adds up a drive.

    limits: the largest errors; log: its name; period_ns: of the output grid; start_ns: its first IMU sample.
    """

    def __init__(self, limits: Limits, *, log: str, period_ns: int, start_ns: int) -> None:
        self._limits, self._log, self._period_ns = limits, log, period_ns
        self._cells = Cells(limits, start_ns)
        self._waiting = {method: Waiting() for method in SENSORS}
        self._stretches = StretchEnds()
        self._grid = Outputs(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)))
        self._speed = np.empty(0)
        self._before_ns: int | None = None
        self._smoothed_ns: int | None = None
        self._seen_ns = -(2**62)
        self._rows = 0
        self._excluded = dict.fromkeys((*(why.name.lower() for why in Excluded), "position_sigma", "yaw_sigma"), 0)
        self._decisions = np.zeros((len(Sensor), len(Reason)), np.int64)

    def add(self, states: Columns, decisions: Columns) -> None:
        """The next rows of both tables, in time order; either may be empty, or ahead of the other.

        scene and mode: codes into lists of texts that only ever grow.
        """
        self._add_states(states)
        self._add_decisions(decisions)
        if self._before_ns is not None:
            self._sum_fixes(self._before_ns)
        self._stretches.add(states, decisions, self._seen_ns)
        needed = min(waiting.needs_after_ns(self._seen_ns - HOLD_NS) for waiting in self._waiting.values())
        self._grid, self._speed = _rows(self._grid, self._grid.t_ns > needed), self._speed[self._grid.t_ns > needed]

    def add_smoothed(self, states: Columns) -> None:
        """The next rows of smoothed states, at the epochs of the filter's; these may all have been added before."""
        t_ns = states["t_ns"]
        if not len(t_ns):
            return
        position, yaw = self._well_known(states)
        evaluated = (states["excluded"] == Excluded.EVALUATED) & position & yaw
        outputs, grid, speed = self._epochs(states, evaluated, self._smoothed_ns)
        self._cells.add_outputs("smoothed", outputs, grid, speed)
        self._stretches.add_smoothed(states)
        self._smoothed_ns = int(t_ns[-1])

    def finish(self, facts: Facts, scenes: Sequence[str] = ("",), modes: Sequence[str] = ("",)) -> Sums:
        """The sums of the whole drive. scenes, modes: the texts of the codes."""
        self._sum_fixes(None)
        counts = self._counts(facts)
        methods = methods_of(counts)
        texts = {"log": (self._log,), "scene": tuple(scenes), "mode": tuple(modes), "method": METHODS}
        sketch = self._cells.histograms.sketch(lambda key: _named(key, scenes, modes), methods)
        return Sums(counts, self._cells.table(methods, texts), sketch)

    def _add_states(self, states: Columns) -> None:
        """Sum the grid and fusion's states on it, and keep the grid for the fixes that are still to come."""
        t_ns = states["t_ns"]
        if not len(t_ns):
            return
        outputs, grid, speed = self._epochs(states, self._evaluated(states), self._before_ns)
        self._cells.add_grid(grid.cell, grid.cover_ns, speed)
        self._cells.add_outputs("fusion", outputs, grid, speed)
        self._grid, self._speed = _after(self._grid, grid), np.concatenate((self._speed, speed))
        self._before_ns, self._rows = int(t_ns[-1]), self._rows + len(t_ns)

    def _epochs(
        self, states: Columns, evaluated: NDArray[np.bool_], before_ns: int | None
    ) -> tuple[Outputs, Outputs, Floats]:
        """Epochs with a state, evaluated epochs (G,) and the reference's speed at these (G,); before_ns: the epoch
        before, None: the first row stands for nothing."""
        t_ns = states["t_ns"]
        if before_ns is None:
            evaluated[0] = False
        cover = cover_ns(t_ns, longest_cover_ns(self._period_ns), before_ns)
        cell = self._cells.find(t_ns, states["scene"], states["mode"])
        every = Outputs(t_ns, cover, cell, _error(states))
        speed = states["ref_speed"][evaluated]
        with_output = np.isfinite(every.error[:, 0]) & np.isfinite(every.error[:, 1])
        return _rows(every, with_output), _rows(every, evaluated), np.where(np.isfinite(speed), speed, 0.0)

    def _evaluated(self, states: Columns) -> NDArray[np.bool_]:
        """Which epochs are scored; the others are counted by reason."""
        code = states["excluded"]
        evaluated: NDArray[np.bool_] = code == Excluded.EVALUATED
        for why in Excluded:
            self._excluded[why.name.lower()] += int((code == why).sum())
        position, yaw = self._well_known(states)
        self._excluded["position_sigma"] += int((evaluated & ~position).sum())
        self._excluded["yaw_sigma"] += int((evaluated & position & ~yaw).sum())
        chosen: NDArray[np.bool_] = evaluated & position & yaw
        return chosen

    def _well_known(self, states: Columns) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """At which epochs the reference is well below the limits, in position and in yaw."""
        sigma = np.stack((states["ref_sigma_m"], states["ref_sigma_yaw"]), axis=-1)
        return well_known(sigma, self._limits, heading=np.isfinite(states["ref_yaw"]))

    def _add_decisions(self, decisions: Columns) -> None:
        """Count what the filter decided, and line up the fixes: each once, whatever it decided, with a position."""
        if not len(decisions["t_ns"]):
            return
        self._seen_ns = max(self._seen_ns, int(decisions["t_ns"].max()))
        pairs = decisions["sensor"].astype(np.int64) * len(Reason) + decisions["reason"]
        self._decisions += np.bincount(pairs, minlength=self._decisions.size).reshape(self._decisions.shape)
        for method, sensor in SENSORS.items():
            rows = np.flatnonzero((decisions["sensor"] == sensor) & (decisions["status"] != GnssStatus.NONE))
            fixes = {name: decisions[name][rows] for name in ("t_ns", "row", "scene", "mode", *_ERRORS)}
            cell = self._cells.find(fixes["t_ns"], fixes["scene"], fixes["mode"])
            self._waiting[method].add(fixes["t_ns"], fixes["row"], cell, _error(fixes))

    def _sum_fixes(self, upto_ns: int | None) -> None:
        for method, waiting in self._waiting.items():
            self._cells.add_outputs(method, waiting.take(upto_ns), self._grid, self._speed)

    def _counts(self, facts: Facts) -> Counts:
        hide, planned = facts["hide_gnss"], facts["stretches"]
        return Counts(
            limits=self._limits,
            order=facts["order"],
            reference=facts["reference"],
            span_ns=self._rows * self._period_ns,
            alignment_s=facts["alignment_s"],
            excluded={why: count for why, count in self._excluded.items() if count and why not in _UNCOUNTED},
            decisions=self._decision_counts(),
            hidden_length_s=None if planned is None or hide is None else hide["length_s"],
            stretches=self._stretches.entries(planned or [], facts["start_ns"], smoothed=facts.get("smoothed", False)),
            warnings=facts["warnings"],
            warning_counts=dict(Counter(entry["kind"] for entry in facts["warnings"])),
            left_out=facts["left_out"],
            health=facts["health"],
            smoothed=facts.get("smoothed", False),
            estimates=facts.get("estimates", []),
        )

    def _decision_counts(self) -> dict[str, dict[str, int]]:
        """Sensor -> reason -> number of measurements."""
        counts = {}
        for sensor in Sensor:
            found = {reason.name.lower(): int(self._decisions[sensor, reason]) for reason in Reason}
            if any(found.values()):
                counts[sensor.name.lower()] = {reason: count for reason, count in found.items() if count}
        return counts


def _error(columns: Columns) -> Floats:
    """(N, 3) m, m, deg."""
    lon, lat, yaw = (columns[name] for name in _ERRORS)
    return np.stack((lon, lat, np.degrees(yaw)), axis=-1)


def _rows(outputs: Outputs, chosen: NDArray[np.bool_]) -> Outputs:
    return Outputs(outputs.t_ns[chosen], outputs.cover_ns[chosen], outputs.cell[chosen], outputs.error[chosen])


def _after(first: Outputs, then: Outputs) -> Outputs:
    return Outputs(*(np.concatenate((getattr(first, f.name), getattr(then, f.name))) for f in fields(Outputs)))


def _named(key: Any, scenes: Sequence[str], modes: Sequence[str]) -> tuple[str, str, str, str]:
    scene, mode, method, axis = key
    return scenes[scene], modes[mode], METHODS[method], AXES[axis]
