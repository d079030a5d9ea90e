"""A drive against its reference, piece by piece: what the filter made of it becomes rows of the two tables.

Rows are held back until reference, tags and hidden stretches say of them what they will say at the end of the drive:
so they are the same to the last bit however the drive is cut.
"""

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion.recording import join
from fusion.result import Decisions, FusionResult, Sensor, States
from replay.config import RunConfig
from replay.decisions import FIXES, Fixes, decision_columns, gnss_columns, pose_columns
from replay.hiding import Hider
from replay.references import FOREVER_NS, LATE_NS, Excluded, Samples, Track
from replay.run_files import ReferenceFacts
from replay.states import state_columns
from replay.tags import TagTrack
from sensors.clock import NS_PER_S
from sensors.geodesy import MapFrame
from sensors.records import Log, Trajectory
from sensors.vehicle import Vehicle

Nanoseconds = NDArray[np.int64]
Columns = dict[str, NDArray[Any]]
Record = TypeVar("Record", States, Decisions)


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Rows of both tables that follow those of the batch before, each in the order of its table.

    states, decisions: their columns, with `scene` and `mode` as int16 codes into scenes and modes, which only grow;
    samples: the reference at the rows of states, as they are compared with it (None: read from a run's tables).
    """

    states: Columns
    decisions: Columns
    scenes: tuple[str, ...]
    modes: tuple[str, ...]
    samples: Samples | None = None


class Evaluation:
    """Takes the pieces of a drive, each with its result, and gives batches of rows.

    reference: of the whole drive, instead of the pieces' own; all_columns: of decisions, not only those that scoring
    reads.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        config: RunConfig,
        reference: Trajectory | None = None,
        *,
        all_columns: bool = True,
    ) -> None:
        self._vehicle, self._all_columns = vehicle, all_columns
        self._period_ns = round(NS_PER_S / config.fusion.output_hz)
        self._hider = Hider(config.hide_gnss, vehicle) if config.hide_gnss is not None else None
        self._point = vehicle.reference_lever_arm if self._hider is None else vehicle.gnss_lever_arm
        self._track, self._own = Track(), reference is None
        if reference is not None:
            self._track.add(reference)
            self._track.close()
        self._fixes, self._scenes, self._modes = Fixes(), TagTrack(), TagTrack()
        self._states: list[States] = []
        self._decisions: list[Decisions] = []
        self._frame: MapFrame | None = None
        self._first_imu_ns: int | None = None
        self._imu_ns = -FOREVER_NS
        self._known_ns = self._done_ns = -FOREVER_NS
        """Up to when all states have come, and up to when rows were taken."""

    def given(self, piece: Log) -> Log:
        """What the filter gets of a piece."""
        return piece if self._hider is None else self._hider.hide(piece)

    def add(self, given: Log, result: FusionResult) -> Batch:
        """The next piece as the filter got it, and what was decided with it."""
        self._frame = given.map_frame
        if given.imu is not None and len(given.imu):
            self._first_imu_ns = int(given.imu.t_ns[0]) if self._first_imu_ns is None else self._first_imu_ns
            self._imu_ns = int(given.imu.t_ns[-1])
        if self._own:
            self._track.add(given.reference)
        self._fixes.add(given)
        self._scenes.add(given.scene)
        self._modes.add(given.mode)
        self._hold(result)
        return self._take(min(self._known_ns, self._settled_ns()))

    def finish(self, result: FusionResult) -> Batch:
        """The rest. Raises EgolocError where GNSS was to be hidden and there is nothing to compare with."""
        if self._hider is not None:
            self._hider.close()
        self._track.close()
        self._hold(result)
        return self._take(FOREVER_NS)

    @property
    def first_imu_ns(self) -> int | None:
        """Stamp of the first IMU sample."""
        return self._first_imu_ns

    def epochs(self) -> int:
        """Stamps of the output grid from the first IMU sample to the last so far."""
        if self._first_imu_ns is None:
            return 0
        return int(self._imu_ns // self._period_ns + -self._first_imu_ns // self._period_ns + 1)

    @property
    def stretches(self) -> list[tuple[int, int]] | None:
        """Start and end of the stretches of hidden GNSS that are used; None: nothing was to be hidden."""
        if self._hider is None:
            return None
        return [(start, end) for start, end in self._hider.stretches().tolist()]

    def reference_facts(self, source: str) -> ReferenceFacts:
        """What it was compared with. source: where that came from."""
        judged = self._track.judged
        if judged is None:
            return {"kind": None, "source": None, "heading": None}
        kind = "odometry" if self._hider is None else "hidden gnss"
        return {"kind": kind, "source": source, "heading": "attitude" if judged.has_heading else "course"}

    def _hold(self, result: FusionResult) -> None:
        self._decisions.append(result.decisions)
        self._states.append(result.states)
        if len(result.states):
            self._known_ns = int(result.states.t_ns[-1])
        else:  # not aligned, or not again
            self._known_ns = max(self._known_ns, self._imu_ns - LATE_NS)

    def _settled_ns(self) -> int:
        """Up to when it is known what to compare with."""
        settled = self._track.settled_ns(self._imu_ns)
        return settled if self._hider is None else min(settled, self._hider.settled_ns(self._imu_ns))

    def _take(self, until_ns: int) -> Batch:
        """The rows up to a time that have not been taken."""
        since, until = self._done_ns, max(until_ns, self._done_ns)
        states, self._states = split_at(self._states, until)
        decisions, self._decisions = split_at(self._decisions, until)
        samples = self._epochs(states, since, until)
        batch = Batch(
            self.compared(states, samples) | self._tags(samples.t_ns),
            self._decision_rows(decisions),
            tuple(self._scenes.texts),
            tuple(self._modes.texts),
            samples,
        )
        self._done_ns = until
        for kept in (self._track, self._scenes, self._modes):
            kept.forget(until - LATE_NS)
        return batch

    def compared(self, states: States, samples: Samples) -> Columns:
        """One row per epoch: states, which may lack at some of them, beside the reference there."""
        has_state = np.isin(samples.t_ns, states.t_ns, assume_unique=True)
        judged = self._track.judged
        return state_columns(
            states,
            samples.t_ns[~has_state],
            self._frame or MapFrame("enu"),  # without a frame there are no states
            samples,
            self._point,
            FOREVER_NS if judged is None else judged.first_ns,
            None if self._hider is None else self._hider.stretches(),
        )

    def _epochs(self, states: States, since_ns: int, until_ns: int) -> Samples:
        """The reference at every state, and at every epoch of the output grid where there is one but no state."""
        missing = self._epochs_without_state(states.t_ns, since_ns, until_ns)
        if len(missing):
            missing = missing[self._track.sample(missing).excluded != Excluded.OUTSIDE]
        t_ns = np.sort(np.concatenate((states.t_ns, missing)), kind="stable") if len(missing) else states.t_ns
        return self._track.sample(t_ns)

    def _epochs_without_state(self, known: Nanoseconds, since_ns: int, until_ns: int) -> Nanoseconds:
        """Stamps of the output grid since a time and up to another, within the IMU's, without a state."""
        if self._first_imu_ns is None or self._track.is_empty:
            return np.empty(0, np.int64)
        first, last = max(since_ns + 1, self._first_imu_ns), min(until_ns, self._imu_ns)
        period = self._period_ns
        grid = np.arange(-(-first // period) * period, last + 1, period, dtype=np.int64)
        if not len(known):
            return grid
        has_state = known[np.minimum(np.searchsorted(known, grid), len(known) - 1)] == grid
        missing: Nanoseconds = grid[~has_state]
        return missing

    def _decision_rows(self, decisions: Decisions) -> Columns:
        """One row per decision."""
        rows = decisions.row.astype(np.int64) if self._hider is None else self._hider.original_rows(decisions)
        measured = {}
        for sensor in FIXES:
            here = np.flatnonzero(decisions.sensor == sensor)
            if len(here):
                fixes = self._fixes.take(sensor, decisions.row[here])
                measured[sensor] = self._fix_columns(sensor, fixes, decisions.t_ns[here])
        return decision_columns(decisions, rows, measured, all_columns=self._all_columns) | self._tags(decisions.t_ns)

    def _fix_columns(self, sensor: Sensor, fixes: Columns, t_ns: Nanoseconds) -> Columns:
        """What GNSS or pose fixes, true at t_ns, say in the map."""
        if sensor == Sensor.POSE_FIX:
            return pose_columns(fixes, self._vehicle, self._track.sample(t_ns), self._point)
        assert self._frame is not None
        hidden = self._hider is not None  # its own fixes are the reference
        samples = None if hidden else self._track.sample(t_ns)
        return gnss_columns(fixes, self._vehicle, self._frame, samples, self._point)

    def _tags(self, t_ns: Nanoseconds) -> Columns:
        return {"scene": self._scenes.at(t_ns), "mode": self._modes.at(t_ns)}


def split_at(parts: list[Record], until_ns: int) -> tuple[Record, list[Record]]:
    """The rows of parts (one or more) before the first that is later than a time, and the others."""
    whole = join(parts)
    later = whole.t_ns > until_ns
    count = int(np.argmax(later)) if later.any() else len(later)
    return _rows(whole, slice(count)), [_rows(whole, slice(count, None))] if count < len(later) else []


def _rows(record: Record, rows: slice) -> Record:
    return type(record)(**{f.name: getattr(record, f.name)[rows] for f in fields(record)})
