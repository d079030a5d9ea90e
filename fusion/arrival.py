"""Arrival order: IMU samples and measurements as they come, late ones at their own time by rewinding (Larsen 1998).

After each arrival the state is the one that stamp order gives for all that has arrived: the newest snapshot before the
late measurement is restored, and IMU samples and events after it are met again, in stamp order and by the same loop.
What was recorded stays as it was: states as they were known when the IMU first reached their time, decisions as they
were made when a measurement was first applied. Met again, a measurement is gated again, and may end otherwise.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion._kernels import sweep
from fusion.events import AGAIN, MOTION, OUTPUT, Events, Parameters, Recorder
from fusion.history import (
    I_ARRIVAL,
    I_DUE,
    I_KIND,
    I_LOG_ROW,
    I_ROW,
    I_T,
    I_VERDICT,
    M_DECIDED,
    M_EVENTS,
    M_FREE,
    M_LENGTH,
    M_NEXT,
    M_OUTPUT,
    M_OUTPUT_PERIOD,
    M_SAMPLES,
    M_SILENT,
    M_START,
    M_TICK,
    M_TICK_PERIOD,
    NEW,
    PLAYED,
    History,
)
from fusion.result import Reason
from fusion.snapshots import S_FIRST, S_NEWEST, restore, snapshot_before
from fusion.state import C_COUNT, C_SAMPLE, C_STATE, FOREVER, Core, Floats, Nanoseconds
from fusion.update import record_decision
from sensors.held import Held, refer
from sensors.kernel import kernel
from sensors.reference import by_reference

_APPLY = -1
_BEFORE_ALIGNMENT = int(Reason.BEFORE_ALIGNMENT)
_OUTSIDE_IMU = int(Reason.OUTSIDE_IMU)
_LATE = int(Reason.LATE)
_DUPLICATE = int(Reason.DUPLICATE)


class Desk(NamedTuple):
    """What every arrival finds. stamps (M, 3): time, arrival and log row of each recorded decision."""

    core: Core
    history: History
    par: Parameters
    rec: Recorder
    stamps: NDArray[np.int64]


@kernel()
def arrive(
    desk: Held[Desk],
    imu_t: Nanoseconds,
    gyro: Floats,
    accel: Floats,
    imu_due: Nanoseconds,
    count: int,
) -> tuple[int, int, bool]:
    """Take IMU samples and the first ``count`` measurements of the inbox, both sorted by when they are due.

    Of what is due at the same time measurements come first, and share a rewind. Returns how many samples and
    measurements were taken, and whether the filter has given up: at a position that finds it hopeless it stays, with
    the samples that had arrived by then in the ring and the events not met in the history; nothing else is taken.
    """
    at = refer(desk)
    core, history, par, rec, stamps = at.core, at.history, at.par, at.rec, at.stamps
    mark, inbox, samples = history.mark, history.inbox, len(imu_t)
    i = j = 0
    while i < samples or j < count:
        due = inbox[j, I_DUE] if j < count else FOREVER
        begin, before = i, mark[M_SAMPLES]
        while i < samples and imu_due[i] < due and i - begin < PLAYED:
            _load(history, imu_t[i], gyro, accel, i)
            i += 1
        if i > begin:
            _lay_grid(core, history, rec, stamps, imu_t[i - 1])
        else:
            if mark[M_EVENTS] + PLAYED > len(history.arrival_ns):
                _make_room(core, history, rec, stamps)
            earliest, stop = FOREVER, min(j + PLAYED, count)
            while j < stop and inbox[j, I_DUE] == due:
                earliest = min(earliest, _admit(core, history, j, rec, stamps))
                j += 1
            if earliest == FOREVER:
                continue
            _rewind(core, history, earliest)
        _play(core, history, par, rec, stamps)
        if _stuck(core, history, mark[M_NEXT]):
            # the sample that reached this time had arrived, and none after it
            arrived = max(before, core.clock[C_COUNT] + int(core.clock[C_SAMPLE] < core.clock[C_STATE]))
            i -= mark[M_SAMPLES] - arrived
            mark[M_SAMPLES] = arrived
            return i, j, True
    while mark[M_FREE] < NEW:
        _make_room(core, history, rec, stamps)
    return i, j, False


@kernel(inline="always")
def _stuck(core: Core, history: History, e: int) -> bool:
    """Whether event e, the first not met, is not met although the state has reached it: the filter has given up."""
    return bool(e < history.mark[M_EVENTS] and history.events.t[e] <= core.clock[C_STATE])


@kernel(inline="always")
def _load(history: History, t: int, gyro: Floats, accel: Floats, row: int) -> None:
    """Put an IMU sample into the ring."""
    ring = history.samples
    k = history.mark[M_SAMPLES] & (len(ring.t) - 1)
    history.mark[M_SAMPLES] += 1
    ring.t[k] = t
    for axis in range(3):
        ring.gyro[k, axis], ring.accel[k, axis] = gyro[row, axis], accel[row, axis]


@kernel()
def _lay_grid(core: Core, history: History, rec: Recorder, stamps: Nanoseconds, last: int) -> None:
    """Lay out motion ticks and outputs up to the last IMU sample."""
    mark = history.mark
    while True:
        tick = mark[M_TICK] if mark[M_TICK_PERIOD] > 0 else FOREVER
        t = min(tick, mark[M_OUTPUT])
        if t > last:
            return
        if mark[M_EVENTS] + 2 > len(history.arrival_ns):
            _make_room(core, history, rec, stamps)
        if t == tick:
            _insert(history, t, MOTION, -1, AGAIN if t <= mark[M_DECIDED] else _APPLY, t, -1)
            mark[M_TICK] += mark[M_TICK_PERIOD]
        if t == mark[M_OUTPUT]:
            _insert(history, t, OUTPUT, -1, AGAIN if t <= mark[M_SILENT] else _APPLY, t, -1)
            mark[M_OUTPUT] += mark[M_OUTPUT_PERIOD]


@kernel()
def _play(core: Core, history: History, par: Parameters, rec: Recorder, stamps: Nanoseconds) -> None:
    """Run the ring's samples after the state, with the events up to the last of them."""
    mark, played, every, size = history.mark, history.played, history.events, len(core.ring_t)
    first, decided, n = mark[M_NEXT], rec.filled[1], mark[M_EVENTS]
    events = by_reference(Events(every.t[:n], every.kind[:n], every.row[:n], every.verdict[:n]))
    met = first
    while core.clock[C_COUNT] < mark[M_SAMPLES]:
        begin = core.clock[C_COUNT] & (size - 1)
        end = min(begin + mark[M_SAMPLES] - core.clock[C_COUNT], size)
        t, gyro, accel = played.t[begin:end], played.gyro[begin:end], played.accel[begin:end]
        met = sweep(core, t, gyro, accel, events, met, history.m, par, rec, True)
        if _stuck(core, history, met):
            break
    for k in range(decided, rec.filled[1]):
        e = rec.event[k]
        stamps[k, 0], stamps[k, 1], stamps[k, 2] = every.t[e], history.arrival_ns[e], history.log_row[e]
    mark[M_NEXT] = met
    for e in range(met - 1, first - 1, -1):
        if every.verdict[e] < 0:
            every.verdict[e] = AGAIN
        else:
            _remove(history, e, 1)


@kernel()
def _admit(core: Core, history: History, j: int, rec: Recorder, stamps: Nanoseconds) -> int:
    """Line measurement j of the inbox up among the events; the time to rewind to for it, FOREVER if there is no need.

    One that will not be applied is decided at once.
    """
    mark, new, now = history.mark, history.inbox[j], core.clock[C_STATE]
    t, verdict = new[I_T], new[I_VERDICT]
    late = t <= now
    if late and verdict < 0:
        if t <= mark[M_START]:
            verdict = _BEFORE_ALIGNMENT
        elif t < now - mark[M_LENGTH] or snapshot_before(core, mark[M_SAMPLES], t) < 0:
            verdict = _LATE
    if not (late and verdict >= 0):
        if _insert(history, t, new[I_KIND], new[I_ROW], verdict, new[I_ARRIVAL], new[I_LOG_ROW]):
            if late:
                mark[M_NEXT] += 1
            return t if late else FOREVER
        verdict = _DUPLICATE
    k = record_decision(rec, -1, new[I_KIND], 0, verdict)
    stamps[k, 0], stamps[k, 1], stamps[k, 2] = t, new[I_ARRIVAL], new[I_LOG_ROW]
    _release(history, new[I_ROW])
    return FOREVER


@kernel()
def _rewind(core: Core, history: History, t: int) -> None:
    """Go back to time t or before; the events from there on are the next to be met."""
    number = snapshot_before(core, history.mark[M_SAMPLES], t)
    restore(core, number)
    e, now = history.mark[M_NEXT], core.clock[C_STATE]
    while e > 0 and history.events.t[e - 1] >= now:
        e -= 1
    history.mark[M_NEXT] = e


@kernel()
def _insert(history: History, t: int, kind: int, row: int, verdict: int, arrival: int, log_row: int) -> bool:
    """Put an event in its place by time and kind; False: there is one already."""
    events, n = history.events, history.mark[M_EVENTS]
    e = n
    while e > 0 and (events.t[e - 1] > t or (events.t[e - 1] == t and events.kind[e - 1] > kind)):
        e -= 1
    if e > 0 and events.t[e - 1] == t and events.kind[e - 1] == kind:
        return False
    for k in range(n, e, -1):
        _move(history, k - 1, k)
    events.t[e], events.kind[e], events.row[e], events.verdict[e] = t, kind, row, verdict
    history.arrival_ns[e], history.log_row[e] = arrival, log_row
    history.mark[M_EVENTS] = n + 1
    return True


@kernel(inline="always")
def _move(history: History, source: int, target: int) -> None:
    events = history.events
    events.t[target], events.kind[target] = events.t[source], events.kind[source]
    events.row[target], events.verdict[target] = events.row[source], events.verdict[source]
    history.arrival_ns[target], history.log_row[target] = history.arrival_ns[source], history.log_row[source]


@kernel()
def _remove(history: History, first: int, count: int) -> None:
    """Forget events from the first on, all of them met."""
    mark = history.mark
    for e in range(first, first + count):
        _release(history, history.events.row[e])
    for e in range(first + count, mark[M_EVENTS]):
        _move(history, e, e - count)
    mark[M_EVENTS] -= count
    mark[M_NEXT] -= count


@kernel(inline="always")
def _release(history: History, row: int) -> None:
    """A row of the measurements' columns is free again."""
    if row >= 0:
        history.free[history.mark[M_FREE]] = row
        history.mark[M_FREE] += 1


@kernel()
def _make_room(core: Core, history: History, rec: Recorder, stamps: Nanoseconds) -> None:
    """Forget the oldest quarter of the events, and the snapshots that would need those that were met.

    One of them that still waits for the IMU is decided: it will not be applied.
    """
    mark, events, size = history.mark, history.events, len(core.saved_t)
    count = max(mark[M_EVENTS] // 4, 1)
    met = min(count, mark[M_NEXT])
    while met > 0 and core.saves[S_FIRST] <= core.saves[S_NEWEST]:
        if core.saved_t[core.saves[S_FIRST] % size, 0] >= events.t[met - 1]:
            break
        core.saves[S_FIRST] += 1
    for e in range(met, count):
        if events.kind[e] < MOTION and events.verdict[e] != AGAIN:
            k = record_decision(rec, -1, events.kind[e], 0, _OUTSIDE_IMU)
            stamps[k, 0], stamps[k, 1], stamps[k, 2] = events.t[e], history.arrival_ns[e], history.log_row[e]
    mark[M_NEXT] = max(mark[M_NEXT], count)
    _remove(history, 0, count)
