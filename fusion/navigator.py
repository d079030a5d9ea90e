"""The filter between calls: what waits for the IMU, alignment, then the kernel. Session and Localizer both drive it.

Whatever is given in one call or in many, the same operations run in the same order.
"""

from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion._kernels import GAP_STEP_NS, process
from fusion.alignment import SERVING, Aligner, Initial
from fusion.config import FusionConfig
from fusion.events import OUTPUT, Events, Measurements, Parameters, Recorder, new_recorder
from fusion.mechanization import refresh
from fusion.recording import decisions, join, states, unused
from fusion.result import Decisions, Reason, States
from fusion.sources import APPLY, RECORDS, joined, sources, split
from fusion.state import C_INTERVAL, C_SAMPLE, C_STATE, C_TICK, Core, new_core
from fusion.tape import Tape, portions
from fusion.timeline import merge, parameters
from sensors import pieces
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.records import Imu, Log
from sensors.vehicle import Vehicle

Scalar = TypeVar("Scalar", np.int64, np.float64)

_NEVER, _EVER = 2**63 - 1, -(2**63)
"""After and before any stamp."""


class Navigator:
    """Measurements wait in ``pending`` until ``advance`` passes them; what was decided is taken out."""

    def __init__(
        self,
        vehicle: Vehicle,
        map_frame: MapFrame | None,
        config: FusionConfig,
        kept_s: float = 0.0,
        tape: Tape | None = None,
    ) -> None:
        """kept_s: IMU samples before the time that ``advance`` was given are kept so long while not aligned, besides
        what alignment itself looks back on: only measurements that come late need more. tape: for the smoother."""
        self._empty = Log(vehicle=vehicle, map_frame=map_frame)
        self._config, self._par = config, parameters(vehicle, config)
        self._aligner = Aligner(vehicle, config, self._par)
        self._tape = tape
        self._kept_ns = round((config.alignment.window_s + kept_s) * NS_PER_S)
        self._rows = dict.fromkeys(RECORDS, 0)
        self._imu: list[Imu] = []
        """Samples after the state; before alignment those before it as well, as far as they are kept."""
        self._decisions: list[Decisions] = []
        self._states: list[States] = []
        self.pending = self._nothing = sources(self._empty, config)
        self._first_imu_ns = _NEVER
        self.last_imu_ns = _EVER
        self.core: Core | None = None
        self.aligned_ns: int | None = None

    def add(self, piece: Log) -> None:
        """Take the measurements and IMU samples of a piece; nothing is decided yet.

        Raises EgolocError where IMU stamps do not go on rising.
        """
        records = {name: getattr(piece, name) for name in RECORDS}
        found = sources(replace(self._empty, **records), self._config, self._rows)
        for name, record in records.items():
            self._rows[name] += 0 if record is None else len(record)
        if len(found.t_ns):
            self.pending = joined((self.pending, found)) if len(self.pending.t_ns) else found
        if piece.imu is not None and len(piece.imu):
            self._add_imu(piece.imu)

    def _add_imu(self, imu: Imu) -> None:
        if imu.t_ns[0] <= self.last_imu_ns:
            raise EgolocError(f"Imu.t_ns: expected increasing stamps, got {imu.t_ns[0]} after {self.last_imu_ns}")
        self._first_imu_ns = self._aligner.first_imu_ns = min(self._first_imu_ns, int(imu.t_ns[0]))
        self.last_imu_ns = int(imu.t_ns[-1])
        self._imu.append(imu)

    def advance(self, known_ns: int) -> None:
        """Go on to known_ns at most, the time up to which every measurement has been added."""
        if not self._imu:
            return
        imu: Imu = pieces.joined(self._imu)
        core = self.core or self._align(imu, min(known_ns, self.last_imu_ns))
        if core is None:
            self._imu = [imu[int(np.searchsorted(imu.t_ns, known_ns - self._kept_ns)) :]]
            return
        first, last = np.searchsorted(imu.t_ns, (core.clock[C_STATE], known_ns), side="right")
        self._imu = [imu[last:]] if last < len(imu) else []
        if first < last:
            self._process(core, imu[first:last])

    def decide(self, reason: Reason, last_ns: int | None = None) -> None:
        """Measurements up to last_ns (None: all) are decided: they are not applied, for this reason."""
        early, self.pending = (self.pending, self._nothing) if last_ns is None else split(self.pending, last_ns)
        if len(early.t_ns):
            self._decisions.append(unused(early, reason))

    def take_states(self) -> States:
        """States recorded since the last call."""
        taken, self._states = self._states, []
        return join(taken or [states(new_recorder(0, 0))])

    def take_decisions(self) -> Decisions:
        """Decisions since the last call, in the order of application."""
        taken, self._decisions = self._decisions, []
        return join(taken or [unused(self._nothing, Reason.LATE)])

    def _align(self, imu: Imu, known_ns: int) -> Core | None:
        """Offer pending measurements up to known_ns in stamp order until one completes a first state."""
        waiting, columns = self.pending, (imu.t_ns, imu.gyro, imu.accel)
        initial: Initial | None = None
        known = (waiting.t_ns >= self._first_imu_ns) & (waiting.t_ns <= known_ns)
        for i in np.flatnonzero(known & (waiting.verdict == APPLY) & np.isin(waiting.kind, SERVING)):
            t_ns, kind, row = int(waiting.t_ns[i]), int(waiting.kind[i]), int(waiting.row[i])
            initial = self._aligner.offer(t_ns, kind, row, waiting.measurements, columns)
            if initial is not None:
                break
        early, self.pending = split(waiting, known_ns if initial is None else initial.t_ns)
        if len(early.t_ns):
            self._decisions.append(unused(early, Reason.BEFORE_ALIGNMENT, initial))
        if initial is not None:
            self.core, self.aligned_ns = start(initial, imu), initial.t_ns
        return self.core

    def _process(self, core: Core, imu: Imu) -> None:
        """Run samples with every measurement up to the last of them."""
        last, now = int(imu.t_ns[-1]), int(core.clock[C_STATE])
        if len(self.pending.t_ns) and self.pending.t_ns[0] <= now:
            self.decide(Reason.LATE, now)
        found = self._nothing
        if len(self.pending.t_ns) and self.pending.t_ns[0] <= last:
            found, self.pending = split(self.pending, last)
        timeline = merge(found, now + 1, last, self._config, self._empty.vehicle.land_vehicle)
        events = timeline.events
        outputs = int((events.kind == OUTPUT).sum())
        recorder = new_recorder(outputs, len(events.t) - outputs)
        feed(core, imu, events, found.measurements, self._par, recorder, self._tape)
        if outputs:
            self._states.append(states(recorder))
        if recorder.filled[1]:
            self._decisions.append(decisions(recorder, timeline))


def start(initial: Initial, imu: Imu) -> Core:
    """A core at the first state, with the IMU sample at or before it as the last one."""
    core = new_core()
    before = int(np.searchsorted(imu.t_ns, initial.t_ns, side="right")) - 1
    core.clock[C_STATE] = initial.t_ns
    core.clock[C_SAMPLE] = imu.t_ns[before]
    core.clock[C_TICK] = initial.t_ns
    core.nav[:], core.P[:] = initial.nav, initial.P
    refresh(core.nav, core.earth)
    core.last[0, :3], core.last[0, 3:] = imu.gyro[before], imu.accel[before]
    if before > 0:
        core.clock[C_INTERVAL] = imu.t_ns[before] - imu.t_ns[before - 1]
        core.last[1, :3], core.last[1, 3:] = imu.gyro[before - 1], imu.accel[before - 1]
    return core


def feed(
    core: Core,
    imu: Imu,
    events: Events,
    measurements: Measurements,
    par: Parameters,
    rec: Recorder,
    tape: Tape | None = None,
) -> None:
    """Run the kernel over an IMU record and all events up to its last sample.

    Every column goes in read-only and contiguous: one compiled kernel serves every log, whatever its sensors. With a
    tape it goes by portions, which changes nothing but the memory that the tape needs.
    """
    columns = Measurements(*(_read_only(column) for column in measurements))
    t, gyro, accel = _read_only(imu.t_ns), _read_only(imu.gyro), _read_only(imu.accel)
    if tape is None:
        process(core, t, gyro, accel, events, 0, columns, par, rec)
        return
    first = 0
    for part, numbers in list(portions(core, t, events.t, par, GAP_STEP_NS)):
        threaded, before = tape.threaded(core, numbers), int(rec.filled[0])
        first = process(threaded, t[part], gyro[part], accel[part], events, first, columns, par, rec)
        tape.keep(threaded, int(rec.filled[0]) - before)


def _read_only(column: NDArray[Scalar]) -> NDArray[Scalar]:
    view = np.ascontiguousarray(column).view()
    view.flags.writeable = False
    return view
