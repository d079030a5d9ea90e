"""Batch run over a log: lay out the events, align, let the kernel go through them once."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion._kernels import process
from fusion.alignment import Aligner, Initial
from fusion.config import FusionConfig
from fusion.events import OUTPUT, Events, Measurements, Parameters, Recorder, new_recorder
from fusion.mechanization import refresh
from fusion.result import Decisions, FusionResult, Reason, States
from fusion.state import (
    ACCEL_BIAS,
    C_INTERVAL,
    C_SAMPLE,
    C_STATE,
    C_TICK,
    GYRO_BIAS,
    LLH,
    QUATERNION,
    VELOCITY,
    Core,
    Floats,
    covariance,
    new_core,
)
from fusion.timeline import APPLY, Sources, Timeline, merge, parameters, sources
from sensors.errors import EgolocError
from sensors.records import Imu, LeftOut, Log

Columns = TypeVar("Columns", States, Decisions)
Scalar = TypeVar("Scalar", np.int64, np.float64)


def run(log: Log, config: FusionConfig | None = None) -> FusionResult:
    """Fuse a log in stamp order.

    States come on multiples of the output period, from alignment to the last IMU sample. Raises EgolocError for a log
    without IMU, or with pose fixes but no map frame.
    """
    config = config or FusionConfig()
    imu = log.imu
    if imu is None or len(imu) < 2:
        raise EgolocError("the log has no IMU samples: expected sensor_msgs/msg/Imu on a topic")
    par = parameters(log.vehicle, config)
    found = sources(log, config)
    order = np.lexsort((found.kind, found.t_ns))
    initial = _align(log, config, found, order, imu)
    if initial is None:
        return FusionResult(states(new_recorder(0, 0)), unused(found, order, Reason.BEFORE_ALIGNMENT), None)
    core = start(initial, imu)
    last = int(imu.t_ns[-1])
    timeline = merge(found, initial.t_ns + 1, last, config, log.vehicle.land_vehicle)
    events = timeline.events
    outputs = int((events.kind == OUTPUT).sum())
    recorder = new_recorder(outputs, len(events.t) - outputs)
    first = int(np.searchsorted(imu.t_ns, initial.t_ns, side="right"))
    feed(core, imu[first:], events, found.measurements, par, recorder)
    applied = decisions(recorder, timeline)
    before = order[found.t_ns[order] <= initial.t_ns]
    early = unused(found, before, Reason.BEFORE_ALIGNMENT, initial)
    late = unused(found, order[found.t_ns[order] > last], Reason.OUTSIDE_IMU)
    gaps = int((np.diff(imu.t_ns) > config.imu.max_gap_s * 1e9).sum())
    notes = (LeftOut("imu", f"gap over {config.imu.max_gap_s:g} s, bridged or coasted", gaps),) if gaps else ()
    return FusionResult(states(recorder), join(Decisions, (early, applied, late)), initial.t_ns, notes)


def _align(log: Log, config: FusionConfig, found: Sources, order: NDArray[np.int64], imu: Imu) -> Initial | None:
    """Offer the measurements in stamp order until the aligner has a state."""
    aligner = Aligner(log.vehicle, config, parameters(log.vehicle, config))
    columns = (imu.t_ns, imu.gyro, imu.accel)
    for i in order:
        if found.verdict[i] == APPLY and imu.t_ns[0] <= found.t_ns[i] <= imu.t_ns[-1]:
            t = int(found.t_ns[i])
            initial = aligner.offer(t, int(found.kind[i]), int(found.row[i]), found.measurements, columns)
            if initial is not None:
                return initial
    return None


def start(initial: Initial, imu: Imu) -> Core:
    """A core at the first state, with the IMU sample at or before it as the last one."""
    core = new_core()
    before = int(np.searchsorted(imu.t_ns, initial.t_ns, side="right")) - 1
    core.clock[C_STATE] = initial.t_ns
    core.clock[C_SAMPLE] = imu.t_ns[before]
    core.clock[C_TICK] = initial.t_ns
    core.nav[:] = initial.nav
    covariance(core)[:] = initial.P
    refresh(core.nav, core.earth)
    core.last[0, :3], core.last[0, 3:] = imu.gyro[before], imu.accel[before]
    if before > 0:
        core.clock[C_INTERVAL] = imu.t_ns[before] - imu.t_ns[before - 1]
        core.last[1, :3], core.last[1, 3:] = imu.gyro[before - 1], imu.accel[before - 1]
    return core


def feed(core: Core, imu: Imu, events: Events, measurements: Measurements, par: Parameters, rec: Recorder) -> None:
    """Run the kernel over an IMU record and all events up to its last sample.

    Every column goes in read-only and contiguous: one compiled kernel serves every log, whatever its sensors.
    """
    columns = Measurements(*(_read_only(column) for column in measurements))
    process(core, _read_only(imu.t_ns), _read_only(imu.gyro), _read_only(imu.accel), events, 0, columns, par, rec)


def _read_only(column: NDArray[Scalar]) -> NDArray[Scalar]:
    view = np.ascontiguousarray(column).view()
    view.flags.writeable = False
    return view


def states(rec: Recorder) -> States:
    """The recorder's states."""
    n = int(rec.filled[0])
    nav = rec.nav[:n]
    return States(
        rec.t[:n],
        nav[:, LLH],
        nav[:, VELOCITY],
        nav[:, QUATERNION],
        nav[:, GYRO_BIAS],
        nav[:, ACCEL_BIAS],
        rec.pose_cov[:n],
        rec.sigma_state[:n],
    )


def decisions(rec: Recorder, timeline: Timeline) -> Decisions:
    """The recorder's decisions with the times and log rows of their events."""
    n = int(rec.filled[1])
    event, scores = rec.event[:n], rec.scores[:n]
    return Decisions(
        timeline.events.t[event],
        timeline.arrival_ns[event],
        rec.sensor[:n],
        timeline.log_row[event],
        rec.reason[:n],
        rec.innovation[:n],
        rec.sigma[:n],
        scores[:, 0],
        scores[:, 1],
        rec.dof[:n],
        scores[:, 2],
        scores[:, 3],
    )


def unused(found: Sources, rows: NDArray[np.int64], reason: Reason, initial: Initial | None = None) -> Decisions:
    """Decisions for measurements that never reached the kernel; the one that completed alignment says so."""
    n = len(rows)
    nothing: Floats = np.full(n, np.nan)
    reasons = np.where(found.verdict[rows] == APPLY, np.int8(reason), found.verdict[rows]).astype(np.int8)
    if initial is not None:
        used = (found.t_ns[rows] == initial.t_ns) & (found.kind[rows] == initial.sensor)
        reasons[used] = Reason.USED_FOR_ALIGNMENT
    return Decisions(
        found.t_ns[rows],
        found.arrival_ns[rows],
        found.kind[rows],
        found.log_row[rows],
        reasons,
        np.full((n, 3), np.nan),
        np.full((n, 3), np.nan),
        nothing,
        nothing,
        np.zeros(n, np.int8),
        nothing,
        nothing,
    )


def join(kind: type[Columns], parts: Sequence[Columns]) -> Columns:
    """Records one after the other."""
    names = kind.__dataclass_fields__
    return kind(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
