"""Streaming filter: records in, states out, over the same kernels as the batch run and bit-identical to it.

Measurements are applied in stamp order: each waits until the IMU has passed its time, and one that is older than the
state is not applied (arrival order, with rewinding, is a matter of ordering and lives outside the core).
"""

import heapq

import numpy as np

from fusion.alignment import Aligner, Initial
from fusion.config import FusionConfig
from fusion.events import OUTPUT, new_recorder
from fusion.result import Decisions, Reason, States
from fusion.run import decisions, feed, join, start, states, unused
from fusion.state import Core, Floats, covariance
from fusion.timeline import APPLY, Sources, concatenate, merge, parameters, sources
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.records import GnssFix, GnssVelocity, Imu, Log, PoseFix, WheelSpeed
from sensors.vehicle import Vehicle

Measurement = GnssFix | GnssVelocity | PoseFix | WheelSpeed

_KEPT_NS = 60_000_000_000
"""IMU samples kept while not aligned."""


class Localizer:
    """Push records of one or more rows as they come; read ``core`` or take the recorded states and decisions.

    States are recorded on multiples of the output period, as ``fusion.run`` does; rows count pushed measurements of
    each sensor from zero, in the order of pushing. A measurement with the stamp of an IMU sample goes before it.
    """

    def __init__(
        self, vehicle: Vehicle | None = None, map_frame: MapFrame | None = None, config: FusionConfig | None = None
    ) -> None:
        self.vehicle, self.map_frame, self.config = vehicle or Vehicle(), map_frame, config or FusionConfig()
        self._par = parameters(self.vehicle, self.config)
        self._aligner = Aligner(self.vehicle, self.config, self._par)
        self._pending: list[tuple[int, int, int, Sources]] = []
        self._pushed = 0
        self._rows: dict[type, int] = {}
        self._imu: Imu | None = None
        self.core: Core | None = None
        self._states: list[States] = []
        self._decisions: list[Decisions] = []

    @property
    def t_ns(self) -> int | None:
        """Time of the state; None before alignment."""
        return None if self.core is None else int(self.core.clock[0])

    def push(self, record: Imu | Measurement) -> None:
        """Take an IMU record or a measurement. IMU stamps must rise; raises EgolocError where they do not."""
        if isinstance(record, Imu):
            self._push_imu(record)
        else:
            self._push_measurement(record)

    def take_states(self) -> States:
        """States recorded since the last call."""
        taken, self._states = self._states, []
        return join(States, taken or [states(new_recorder(0, 0))])

    def take_decisions(self) -> Decisions:
        """Decisions since the last call, in the order of application."""
        taken, self._decisions = self._decisions, []
        if not taken:
            empty = sources(Log(vehicle=self.vehicle), self.config)
            return unused(empty, np.empty(0, np.int64), Reason.BEFORE_ALIGNMENT)
        return join(Decisions, taken)

    def covariance(self) -> Floats | None:
        """(15, 15) covariance at the last use of P (a measurement or a recorded state), None before alignment."""
        return None if self.core is None else covariance(self.core).copy()

    def _push_measurement(self, record: Measurement) -> None:
        found = sources(self._log_of(record), self.config)
        first = self._rows.get(type(record), 0)
        self._rows[type(record)] = first + len(record)
        for i in np.lexsort((found.kind, found.t_ns)):
            one = found.at(i, first)
            heapq.heappush(self._pending, (int(found.t_ns[i]), int(found.kind[i]), self._pushed, one))
            self._pushed += 1

    def _log_of(self, record: Measurement) -> Log:
        return Log(
            gnss=record if isinstance(record, GnssFix) else None,
            gnss_velocity=record if isinstance(record, GnssVelocity) else None,
            pose_fixes=record if isinstance(record, PoseFix) else None,
            wheel=record if isinstance(record, WheelSpeed) else None,
            vehicle=self.vehicle,
            map_frame=self.map_frame,
        )

    def _push_imu(self, record: Imu) -> None:
        if not len(record):
            return
        last = self._imu.t_ns[-1] if self._imu is not None else None
        if last is not None and record.t_ns[0] <= last:
            raise EgolocError(f"Imu.t_ns: expected increasing stamps, got {record.t_ns[0]} after {last}")
        if self.core is None:
            self._imu = record if self._imu is None else _append(self._imu, record)
            self._align()
            return
        self._imu = record[-1:]
        self._process(record)

    def _align(self) -> None:
        """Offer pending measurements up to the last sample; once aligned, go on with the samples that follow."""
        imu = self._imu
        assert imu is not None
        while self._pending and self._pending[0][0] <= imu.t_ns[-1]:
            t_ns, kind, _, one = heapq.heappop(self._pending)
            initial = None
            if one.verdict[0] == APPLY and t_ns >= imu.t_ns[0]:
                columns = (imu.t_ns, imu.gyro, imu.accel)
                initial = self._aligner.offer(t_ns, kind, 0, one.measurements, columns)
            self._decisions.append(unused(one, np.zeros(1, np.int64), Reason.BEFORE_ALIGNMENT, initial))
            if initial is not None:
                self._begin(initial, imu)
                return
        self._imu = imu[int(np.searchsorted(imu.t_ns, imu.t_ns[-1] - _KEPT_NS)) :]

    def _begin(self, initial: Initial, imu: Imu) -> None:
        self.core = start(initial, imu)
        while self._pending and self._pending[0][0] == initial.t_ns:
            *_, one = heapq.heappop(self._pending)
            self._decisions.append(unused(one, np.zeros(1, np.int64), Reason.BEFORE_ALIGNMENT))
        rest = imu[int(np.searchsorted(imu.t_ns, initial.t_ns, side="right")) :]
        self._imu = imu[-1:]
        if len(rest):
            self._process(rest)

    def _process(self, imu: Imu) -> None:
        """Run samples with every measurement up to the last of them."""
        core = self.core
        assert core is not None
        due: list[Sources] = []
        last, now = int(imu.t_ns[-1]), int(core.clock[0])
        while self._pending and self._pending[0][0] <= last:
            t_ns, _, _, one = heapq.heappop(self._pending)
            if t_ns <= now:
                self._decisions.append(unused(one, np.zeros(1, np.int64), Reason.LATE))
            else:
                due.append(one)
        found = concatenate(due) if due else sources(Log(vehicle=self.vehicle), self.config)
        timeline = merge(found, now + 1, last, self.config, self.vehicle.land_vehicle)
        events = timeline.events
        outputs = int((events.kind == OUTPUT).sum())
        recorder = new_recorder(outputs, len(events.t) - outputs)
        feed(core, imu, events, found.measurements, self._par, recorder)
        if outputs:
            self._states.append(states(recorder))
        if recorder.filled[1]:
            self._decisions.append(decisions(recorder, timeline))


def _append(a: Imu, b: Imu) -> Imu:
    return Imu(
        np.concatenate((a.t_ns, b.t_ns)),
        np.concatenate((a.arrival_ns, b.arrival_ns)),
        np.concatenate((a.gyro, b.gyro)),
        np.concatenate((a.accel, b.accel)),
    )
