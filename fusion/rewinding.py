"""The filter between calls in arrival order: what waits for the first state, then ``fusion.arrival`` and its history.

A row is due when it arrived, by the clock of the stamps: if the IMU's first sample seems to arrive before its stamp, or
more than a second after it, the clocks differ by that much. Nothing is due before it was true.

Where the filter gives up, samples and measurements that it has not met wait once more, for another first state. That is
final: a measurement from before it is too late, whatever it would have changed.
"""

from operator import is_not

import numpy as np
from numpy.typing import NDArray

from fusion.alignment import SERVING, Initial
from fusion.arrival import Desk, arrive
from fusion.config import FusionConfig
from fusion.events import Measurements
from fusion.health import begin
from fusion.history import (
    M_DECIDED,
    M_EVENTS,
    M_NEXT,
    M_OUTPUT,
    M_OUTPUT_PERIOD,
    M_SILENT,
    M_START,
    M_TICK,
    M_TICK_PERIOD,
    NEW,
    PLAYED,
    History,
    columns_for,
    enter,
    new_history,
    read_only,
    unplayed,
    waiting,
    with_room,
)
from fusion.journal import Journal
from fusion.navigator import Navigator, start
from fusion.recording import unused
from fusion.result import Decisions, Reason, States
from fusion.snapshots import with_snapshots
from fusion.sources import Sources, compact, joined
from fusion.state import C_COUNT, C_STATE, FOREVER, NEVER, Core, Nanoseconds
from fusion.timeline import periods
from sensors import pieces
from sensors.clock import NS_PER_S
from sensors.geodesy import MapFrame
from sensors.held import Held
from sensors.records import Imu, Log
from sensors.vehicle import Vehicle

_WAIT_NS = 60 * NS_PER_S
"""Without a first state, a pushed measurement waits for the IMU until it is so much older than another."""
_NOW = np.zeros(1, np.int64)
_NO_TIME = read_only(np.empty(0, np.int64))
_NO_AXES = read_only(np.empty((0, 3)))
_NO_IMU = Imu(_NO_TIME, _NO_TIME, _NO_AXES, _NO_AXES)
_NO_SAMPLES = (_NO_TIME, _NO_AXES, _NO_AXES, _NO_TIME)


class RewindingNavigator(Navigator):
    """Rows of ``add`` wait until ``advance`` passes the time when they are due; those of ``push`` are due now."""

    def __init__(
        self, vehicle: Vehicle, map_frame: MapFrame | None, config: FusionConfig, kept: int | None = None
    ) -> None:
        """kept: so many states and decisions are kept until they are taken, or a few more; None: all."""
        super().__init__(vehicle, map_frame, config, config.history_s)
        self._history_ns = round(config.history_s * NS_PER_S)
        self._due: list[Nanoseconds] = []
        """When the samples of ``_imu`` are due."""
        self._offset_ns = 0
        """Of the clock of arrivals."""
        self._last_due = NEVER
        self._seen_ns = NEVER
        """Stamp of the newest sample that alignment has had."""
        self._since_ns = self._decided_ns = NEVER
        """When the filter gave up last; up to when motion ticks were decided by then."""
        self._offered: dict[int, int] = {}
        """Of each sensor, the newest measurement that alignment has had."""
        self._history: History | None = None
        self._desk: Held[Desk] | None = None
        self._columns: Measurements
        self._journal = Journal(self._states, self._decisions, kept, self._par.axes_var)

    def add(self, piece: Log) -> None:
        """Take the measurements and IMU samples of a piece; nothing is decided yet.

        Raises EgolocError where IMU stamps do not go on rising.
        """
        super().add(piece)
        imu = piece.imu
        if imu is None or not len(imu):
            return
        if self._first_imu_ns == imu.t_ns[0]:
            ahead = int(imu.arrival_ns[0] - imu.t_ns[0])
            self._offset_ns = 0 if 0 <= ahead <= NS_PER_S else ahead
        self._due.append(np.maximum.accumulate(np.maximum(self._due_of(imu), self._last_due)))
        self._last_due = int(self._due[-1][-1])

    def push(self, piece: Log) -> None:
        """Take rows that come now, whatever their arrival says, and go on.

        Raises EgolocError where IMU stamps do not go on rising.
        """
        if self.core is None:
            self.add(piece)
            self.advance(FOREVER)
            if self.core is None and len(self.pending.t_ns):
                self.decide(Reason.BEFORE_ALIGNMENT, int(self.pending.t_ns[-1]) - _WAIT_NS)
            return
        imu, went_on = piece.imu, True
        if imu is not None and len(imu):
            self._check_rising(imu)
            went_on = self._arrive(self.spikes.passed(imu), np.zeros(len(imu), np.int64), self._nothing, _NO_TIME)
        for found in self._found(piece):
            for first in range(0, len(found.t_ns), NEW):
                part = found if len(found.t_ns) <= NEW else found.chosen(slice(first, first + NEW))
                if went_on:
                    went_on = self._arrive(_NO_IMU, _NO_TIME, part, _NOW)
                else:
                    self.pending = joined((self.pending, part))
        if not went_on:
            self.advance(FOREVER)

    def advance(self, known_ns: int) -> None:
        """Go on with all that is due by known_ns: no row that is due sooner is added later."""
        known_ns = min(known_ns, FOREVER - 1)
        while self._imu or self.core is not None:
            imu: Imu = pieces.joined(self._imu or [_NO_IMU])
            imu_due = np.concatenate(self._due or [_NO_TIME])
            last = int(np.searchsorted(imu_due, known_ns, side="right"))
            if self.core is None and not self._start(imu, imu_due, known_ns):
                if last:
                    self._seen_ns = max(self._seen_ns, int(imu.t_ns[last - 1]))
                kept = int(np.searchsorted(imu.t_ns, self._seen_ns - self._kept_ns)) if last else 0
                self._imu, self._due = [imu[kept:]], [imu_due[kept:]]
                return
            self._imu, self._due = [], []
            went_on = self._run(imu[:last], imu_due[:last], known_ns)
            self._wait(imu[last:], imu_due[last:])
            if went_on:
                return

    def decide(self, reason: Reason, last_ns: int | None = None) -> None:
        """Measurements up to last_ns (None: all) are decided: they are not applied, for this reason."""
        super().decide(reason, last_ns)
        if last_ns is None and self._history is not None:
            self._journal.flush()
            self._decisions.append(unused(waiting(self._history), reason))
            self._history.mark[M_EVENTS] = self._history.mark[M_NEXT]

    def take_states(self) -> States:
        """States recorded since the last call."""
        self._journal.flush()
        return super().take_states()

    def take_decisions(self) -> Decisions:
        """Decisions since the last call, in the order in which they were made."""
        self._journal.flush()
        return super().take_decisions()

    def _due_of(self, found: Sources | Imu) -> Nanoseconds:
        return np.maximum(found.arrival_ns - self._offset_ns, found.t_ns)

    def _wait(self, imu: Imu, imu_due: Nanoseconds) -> None:
        """Samples that follow those of ``_imu``."""
        if len(imu):
            self._imu.append(imu)
            self._due.append(imu_due)

    def _start(self, imu: Imu, imu_due: Nanoseconds, known_ns: int) -> bool:
        """Offer measurements as they can be had, up to known_ns, until one completes a first state.

        Of each sensor they are offered in stamp order. Those that the IMU leaves behind by the history are decided.
        """
        waiting = self.pending
        due = self._due_of(waiting)
        ready, waits = _ready(waiting.t_ns, due, imu.t_ns, imu_due)
        left, _ = _ready(waiting.t_ns + self._history_ns + 1, due, imu.t_ns, imu_due)
        since_ns = max(self._first_imu_ns, self._since_ns)
        serving = np.isin(waiting.kind, SERVING) & (waiting.verdict < 0) & (waiting.t_ns >= since_ns)
        order = np.lexsort((waiting.kind, waiting.t_ns, waits, ready))
        initial, now_ns = None, known_ns
        for i in order[(serving & (ready <= known_ns) & (ready < left))[order]]:
            initial = self._offer(int(i), imu)
            if initial is not None:
                now_ns = int(ready[i])
                break
        gone = np.flatnonzero(left <= now_ns)
        self._before_alignment(waiting.chosen(gone[np.lexsort((waiting.kind[gone], waiting.t_ns[gone], left[gone]))]))
        rest = left > now_ns
        if initial is not None:
            early = rest & (due <= now_ns) & (waiting.t_ns <= initial.t_ns)
            self._before_alignment(waiting.chosen(np.flatnonzero(early)), initial)
            rest &= ~early
            silent = np.searchsorted(imu_due, now_ns)
            self._begin(initial, imu, int(imu.t_ns[silent - 1]) if silent else NEVER)
        self.pending = compact(waiting.chosen(np.flatnonzero(rest)))
        return initial is not None

    def _offer(self, i: int, imu: Imu) -> Initial | None:
        waiting = self.pending
        t_ns, kind = int(waiting.t_ns[i]), int(waiting.kind[i])
        if t_ns <= self._offered.get(kind, NEVER):
            return None
        self._offered[kind] = t_ns
        columns = (imu.t_ns, imu.gyro, imu.accel)
        return self._aligner.offer(t_ns, kind, int(waiting.row[i]), waiting.measurements, columns)

    def _before_alignment(self, found: Sources, initial: Initial | None = None) -> None:
        if len(found.t_ns):
            self._decisions.append(unused(found, Reason.BEFORE_ALIGNMENT, initial))

    def _begin(self, initial: Initial, imu: Imu, silent_ns: int) -> None:
        """Begin with a first state; silent_ns: states up to this time were not known when the clock read it."""
        length_s = self._config.history_s
        core = start(initial, imu)
        begin(core, initial.t_ns, self._diverged, self._par.health.settled_ns)
        self.core = with_snapshots(core, length_s)
        self.aligned_ns = initial.t_ns if self.aligned_ns is None else self.aligned_ns
        self._columns = columns_for(self._nothing.measurements, length_s)
        self._history = new_history(len(self.core.ring_t), self._columns, length_s)
        mark = self._history.mark
        output, tick = periods(self._config, self._empty.vehicle.land_vehicle)
        mark[M_OUTPUT_PERIOD], mark[M_OUTPUT] = output, (initial.t_ns // output + 1) * output
        if tick:
            mark[M_TICK_PERIOD], mark[M_TICK] = tick, (initial.t_ns // tick + 1) * tick
        mark[M_START], mark[M_DECIDED] = initial.t_ns, self._decided_ns
        mark[M_SILENT] = max(silent_ns, self._seen_ns)

    def _run(self, imu: Imu, imu_due: Nanoseconds, known_ns: int) -> bool:
        """Give the kernel samples and pending measurements up to known_ns, by when they are due; False: it gave up."""
        assert self.core is not None
        waiting = self.pending
        due = self._due_of(waiting)
        order = np.lexsort((waiting.kind, waiting.t_ns, due))
        order = order[: int(np.searchsorted(due[order], known_ns, side="right"))]
        begin = int(np.searchsorted(imu.t_ns, self.core.clock[C_STATE], side="right"))
        if len(order):
            self.pending = compact(waiting.chosen(np.delete(np.arange(len(due)), order)))
        for first in range(0, max(len(order), 1), NEW):
            rows, later = order[first : first + NEW], order[first + NEW :]
            end = int(np.searchsorted(imu_due, due[later[0]])) if len(later) else len(imu)
            went_on = self._arrive(imu[begin:end], imu_due[begin:end], waiting.chosen(rows), due[rows])
            begin = max(begin, end)
            if not went_on:
                self._wait(imu[begin:], imu_due[begin:])
                self.pending = joined((self.pending, compact(waiting.chosen(later))))
                return False
        return True

    def _arrive(self, imu: Imu, imu_due: Nanoseconds, found: Sources, due: Nanoseconds) -> bool:
        """Run the kernel over samples and at most NEW measurements, both sorted by when they are due; False: it gave
        the state up, and what it did not meet waits."""
        core = self.core
        assert core is not None
        assert self._history is not None
        mark, samples = self._history.mark, _NO_SAMPLES
        outputs = ticks = 0
        if len(imu):
            last = int(imu.t_ns[-1])
            outputs = max((last - int(mark[M_OUTPUT])) // int(mark[M_OUTPUT_PERIOD]) + 1, 0)
            if mark[M_TICK_PERIOD]:
                ticks = max((last - int(mark[M_TICK])) // int(mark[M_TICK_PERIOD]) + 1, 0)
            self._history = with_room(self._history, self._most_at_once(imu.t_ns))
            samples = read_only(imu.t_ns), read_only(imu.gyro), read_only(imu.accel), read_only(imu_due)
        count = enter(self._history, self._columns, found, due)
        rec = self._journal.room(outputs + 1, ticks + count + int(mark[M_EVENTS] - mark[M_NEXT]) + 1)
        desk = self._laid(Desk(core, self._history, self._par, rec, self._journal.stamps))
        i, j, given_up = arrive(desk, *samples, count)
        if given_up:
            self._give_back(core, imu, np.maximum(imu_due, self._due_of(imu)), found, (i, j))
        return not given_up

    def _laid(self, desk: Desk) -> Held[Desk]:
        """The same for the kernel, made anew where one of its parts is another."""
        if self._desk is None or any(map(is_not, self._desk.value, desk)):
            self._desk = Held(desk)
        return self._desk

    def _give_back(self, core: Core, imu: Imu, imu_due: Nanoseconds, found: Sources, taken: tuple[int, int]) -> None:
        """Give the state up; what it has not met waits, from its time on. imu, found: of which so many were taken."""
        assert self._history is not None
        i, j = taken
        self._journal.flush()
        self._give_up(core)
        self._since_ns = int(core.clock[C_STATE])
        again = unplayed(self._history, int(core.clock[C_COUNT]))
        seen_ns = [NEVER, *again.t_ns.tolist()][-1]
        last_imu, last_found = (int(due[n - 1]) if n else NEVER for due, n in ((imu_due, i), (self._due_of(found), j)))
        if last_found > last_imu:  # a late one: states over the samples after it are known
            self._seen_ns = self._decided_ns = max(self._seen_ns, seen_ns)
        now_ns = max(last_imu, last_found, seen_ns)
        self._wait(again, np.full(len(again), now_ns))
        self._wait(imu[i:], np.maximum.accumulate(np.maximum(imu_due[i:], now_ns)))
        self._last_due = max(self._last_due, now_ns, *imu_due[i:][-1:].tolist())
        self.pending = joined((compact(waiting(self._history)), compact(found.chosen(slice(j, None))), self.pending))
        self._offered.clear()
        self._history = None

    def _most_at_once(self, imu_t: Nanoseconds) -> int:
        """Outputs and motion ticks over the samples that are played at a time."""
        assert self.core is not None
        assert self._history is not None
        mark, now = self._history.mark, int(self.core.clock[C_STATE])
        span = int(imu_t[-1]) - now
        if len(imu_t) > PLAYED:
            edges = np.concatenate(([now], imu_t))
            span = int((edges[PLAYED:] - edges[:-PLAYED]).max())
        return span // int(mark[M_OUTPUT_PERIOD]) + (span // int(mark[M_TICK_PERIOD]) if mark[M_TICK_PERIOD] else 0) + 2


def _ready(
    t_ns: Nanoseconds, due: Nanoseconds, imu_t: Nanoseconds, imu_due: Nanoseconds
) -> tuple[Nanoseconds, NDArray[np.bool_]]:
    """When measurements of t_ns are there and reached by the IMU (FOREVER: not yet), and whether they wait for it."""
    k = np.searchsorted(imu_t, t_ns)
    reached = np.where(k < len(imu_t), imu_due[np.minimum(k, len(imu_t) - 1)], FOREVER)
    return np.maximum(due, reached), due <= reached
