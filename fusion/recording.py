"""From the kernel's output arrays to States and Decisions."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion.alignment import Initial
from fusion.events import AGAIN, Recorder
from fusion.result import Decisions, Reason, States
from fusion.sources import APPLY, Sources
from fusion.state import ACCEL_BIAS, GYRO_BIAS, LLH, QUATERNION, VELOCITY, Floats, Nanoseconds
from fusion.timeline import Timeline
from sensors.pieces import joined

Columns = TypeVar("Columns", States, Decisions)


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
        rec.health[:n, 0],
        rec.health[:n, 1],
        rec.levels[:n],
    )


def decisions(rec: Recorder, timeline: Timeline) -> Decisions:
    """The recorder's decisions with the times and log rows of their events."""
    event = rec.event[: int(rec.filled[1])]
    return decided(rec, timeline.events.t[event], timeline.arrival_ns[event], timeline.log_row[event])


def decided(rec: Recorder, t_ns: Nanoseconds, arrival_ns: Nanoseconds, log_row: Nanoseconds) -> Decisions:
    """The recorder's decisions with their times and log rows, each (M,)."""
    n = int(rec.filled[1])
    scores = rec.scores[:n]
    return Decisions(
        t_ns,
        arrival_ns,
        rec.sensor[:n],
        log_row,
        rec.reason[:n],
        rec.innovation[:n],
        rec.sigma[:n],
        scores[:, 0],
        scores[:, 1],
        rec.dof[:n],
        scores[:, 2],
        scores[:, 3],
        scores[:, 4],
    )


def unused(found: Sources, reason: Reason, initial: Initial | None = None) -> Decisions:
    """Decisions for measurements that never reached the kernel; the one that completed alignment says so.

    Those that did reach it before the filter gave up (AGAIN) have been decided.
    """
    found = found.chosen(np.flatnonzero(found.verdict != AGAIN))
    n = len(found.t_ns)
    nothing: Floats = np.full(n, np.nan)
    reasons: NDArray[np.int8] = np.where(found.verdict == APPLY, np.int8(reason), found.verdict).astype(np.int8)
    if initial is not None:
        used = (found.t_ns == initial.t_ns) & (found.kind == initial.sensor)
        reasons[used] = Reason.USED_FOR_ALIGNMENT
    return Decisions(
        found.t_ns,
        found.arrival_ns,
        found.kind,
        found.log_row,
        reasons,
        np.full((n, 3), np.nan),
        np.full((n, 3), np.nan),
        nothing,
        nothing,
        np.zeros(n, np.int8),
        nothing,
        nothing,
        nothing,
    )


def join(parts: Sequence[Columns]) -> Columns:
    """Records (one or more) one after the other."""
    whole: Columns = joined([part for part in parts if len(part.t_ns)] or [parts[0]])
    return whole
