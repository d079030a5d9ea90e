"""The filter between calls: what waits for the IMU, alignment, then the kernel. Session and Localizer both drive it.

Whatever is given in one call or in many, the same operations run in the same order.
"""

import numpy as np

from fusion._kernels import GAP_STEP_NS, process
from fusion.alignment import SERVING, Aligner, Initial
from fusion.config import FusionConfig
from fusion.events import MOTION, OUTPUT, Events, Measurements, Parameters, Recorder, new_recorder
from fusion.health import begin
from fusion.history import read_only
from fusion.layout import used
from fusion.mechanization import refresh
from fusion.recording import decisions, join, states, unused
from fusion.result import Decisions, Reason, Restart, States
from fusion.sources import APPLY, RECORDS, Sources, joined, parts, sources, split
from fusion.spikes import SpikeGate
from fusion.state import C_INTERVAL, C_SAMPLE, C_STATE, C_TICK, FOREVER, H_CAUSE, NAV_SIZE, NEVER, Core, new_core
from fusion.tape import Tape, portions
from fusion.timeline import merge, parameters
from sensors import pieces
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.records import Imu, Log
from sensors.vehicle import Vehicle


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
        self.state_count = used(self._par.layout)
        self._aligner = self._new_aligner()
        self._tape = tape
        if tape is not None:
            tape.axes_var = self._par.axes_var
        self._kept_ns = round((config.alignment.window_s + kept_s) * NS_PER_S)
        self._rows = dict.fromkeys(RECORDS, 0)
        self._imu: list[Imu] = []
        """Samples after the state; before alignment those before it as well, as far as they are kept."""
        self.spikes = SpikeGate(config.imu)
        self._decisions: list[Decisions] = []
        self._states: list[States] = []
        self._restarts: list[Restart] = []
        self.pending = self._nothing = sources(self._empty, config)
        self._first_imu_ns = FOREVER
        self.last_imu_ns = NEVER
        self.core: Core | None = None
        self._diverged: Core | None = None
        """The core that was given up last."""
        self.aligned_ns: int | None = None
        """Time of the first state."""

    def add(self, piece: Log) -> None:
        """Take the measurements and IMU samples of a piece; nothing is decided yet.

        Raises EgolocError where IMU stamps do not go on rising.
        """
        found = joined([self._nothing, *self._found(piece)])
        if len(found.t_ns):
            self.pending = joined((self.pending, found)) if len(self.pending.t_ns) else found
        if piece.imu is not None and len(piece.imu):
            self._add_imu(piece.imu)

    def _found(self, piece: Log) -> list[Sources]:
        """The measurements of a piece, of each sensor for itself."""
        records = {name: getattr(piece, name) for name in RECORDS}
        mine = Log(vehicle=self._empty.vehicle, map_frame=self._empty.map_frame, **records)
        found = parts(mine, self._config, self._rows)
        for name, record in records.items():
            self._rows[name] += 0 if record is None else len(record)
        return found

    def _add_imu(self, imu: Imu) -> None:
        self._check_rising(imu)
        self._first_imu_ns = self._aligner.first_imu_ns = min(self._first_imu_ns, int(imu.t_ns[0]))
        self._imu.append(self.spikes.passed(imu))

    def _check_rising(self, imu: Imu) -> None:
        """Raise unless the samples go on; they are the last ones from now on."""
        if imu.t_ns[0] <= self.last_imu_ns:
            raise EgolocError(f"Imu.t_ns: expected increasing stamps, got {imu.t_ns[0]} after {self.last_imu_ns}")
        self.last_imu_ns = int(imu.t_ns[-1])

    def push(self, piece: Log) -> None:
        """Take rows that come now, and go on as far as the IMU has come. Raises EgolocError as ``add`` does."""
        self.add(piece)
        if piece.imu is not None:
            self.advance(self.last_imu_ns)

    def advance(self, known_ns: int) -> None:
        """Go on to known_ns at most, the time up to which every measurement has been added."""
        while self._imu:
            imu: Imu = pieces.joined(self._imu)
            core = self.core or self._align(imu, min(known_ns, self.last_imu_ns))
            if core is None:
                self._imu = [imu[int(np.searchsorted(imu.t_ns, known_ns - self._kept_ns)) :]]
                return
            first, last = np.searchsorted(imu.t_ns, (core.clock[C_STATE], known_ns), side="right")
            self._imu = [imu[last:]] if last < len(imu) else []
            if first == last or self._process(core, imu[first:last]):
                return
            # no sample before the end of the old state is looked at: a piece may not hold it
            self._give_up(core)
            self._imu = [imu[int(np.searchsorted(imu.t_ns, core.clock[C_STATE], side="right")) :]]

    def _give_up(self, core: Core) -> None:
        """Align anew from the state's time on, by whole windows of the IMU."""
        self._restarts.append(Restart(int(core.clock[C_STATE]), int(core.health[H_CAUSE])))
        if self._tape is not None:
            self._tape.cut(core)
        self._diverged, self.core, self._aligner = core, None, self._new_aligner()

    def _new_aligner(self) -> Aligner:
        return Aligner(self._empty.vehicle, self._config, self._par)

    def decide(self, reason: Reason, last_ns: int | None = None) -> None:
        """Measurements up to last_ns (None: all) are decided: they are not applied, for this reason."""
        early, self.pending = (self.pending, self._nothing) if last_ns is None else split(self.pending, last_ns)
        if len(early.t_ns):
            self._decisions.append(unused(early, reason))

    def take_states(self) -> States:
        """States recorded since the last call."""
        taken = self._states.copy()
        self._states.clear()
        return join(taken or [states(new_recorder(0, 0))])

    def take_decisions(self) -> Decisions:
        """Decisions since the last call, in the order of application."""
        taken = self._decisions.copy()
        self._decisions.clear()
        return join(taken or [unused(self._nothing, Reason.LATE)])

    def take_restarts(self) -> tuple[Restart, ...]:
        """Divergences since the last call after which alignment began anew."""
        taken, self._restarts = self._restarts, []
        return tuple(taken)

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
            self.core = start(initial, imu)
            begin(self.core, initial.t_ns, self._diverged, self._par.health.settled_ns)
            self.aligned_ns = initial.t_ns if self.aligned_ns is None else self.aligned_ns
        return self.core

    def _process(self, core: Core, imu: Imu) -> bool:
        """Run samples with every measurement up to the last of them; False: the filter has diverged on the way."""
        last, now = int(imu.t_ns[-1]), int(core.clock[C_STATE])
        if len(self.pending.t_ns) and self.pending.t_ns[0] <= now:
            self.decide(Reason.LATE, now)
        found = self._nothing
        if len(self.pending.t_ns) and self.pending.t_ns[0] <= last:
            found, self.pending = split(self.pending, last)
        timeline = merge(found, now + 1, last, self._config, self._empty.vehicle.land_vehicle)
        events = timeline.events
        outputs = int((events.kind == OUTPUT).sum())
        recorder = new_recorder(outputs, len(events.t) - outputs, self._par.axes_var)
        done = feed(core, imu, events, found.measurements, self._par, recorder, self._tape)
        if outputs:
            self._states.append(states(recorder))
        if recorder.filled[1]:
            self._decisions.append(decisions(recorder, timeline))
        if done == len(events.t):
            return True
        rest = found.chosen(slice(int((events.kind[:done] < MOTION).sum()), None))
        self.pending = joined((rest, self.pending))
        return False


def start(initial: Initial, imu: Imu) -> Core:
    """A core at the first state, with the IMU sample at or before it as the last one."""
    core = new_core(len(initial.P))
    before = int(np.searchsorted(imu.t_ns, initial.t_ns, side="right")) - 1
    core.clock[C_STATE] = initial.t_ns
    core.clock[C_SAMPLE] = imu.t_ns[before]
    core.clock[C_TICK] = initial.t_ns
    core.nav[:NAV_SIZE], core.P[:] = initial.nav, initial.P
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
) -> int:
    """Run the kernel over an IMU record and all events up to its last sample; the first event not reached.

    Every column goes in read-only and contiguous: one compiled kernel serves every log, whatever its sensors. With a
    tape it goes by portions, which changes nothing but the memory that the tape needs.
    """
    columns = Measurements(*(read_only(column) for column in measurements))
    t, gyro, accel = read_only(imu.t_ns), read_only(imu.gyro), read_only(imu.accel)
    if tape is None:
        return int(process(core, t, gyro, accel, events, 0, columns, par, rec))
    first = 0
    for part, numbers in list(portions(core, t, events.t, par, GAP_STEP_NS)):
        threaded, before = tape.threaded(core, numbers), int(rec.filled[0])
        first = int(process(threaded, t[part], gyro[part], accel[part], events, first, columns, par, rec))
        tape.keep(threaded, int(rec.filled[0]) - before)
        if first < len(events.t) and events.t[first] <= t[part][-1]:  # the state was given up
            break
    return first
