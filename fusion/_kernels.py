"""The filter's loop: IMU samples and events in stamp order, one pass, no allocation per step.

``process`` serves the batch run and the streaming Localizer alike; whatever is fed in one call or in many, the same
operations run in the same order. What happens at an event is ``fusion.update``'s.
"""

import numpy as np
from numpy.typing import NDArray

from fusion._linalg import Vector, attitude, axpy, blend, matvec
from fusion.covariance import accumulate, coast, widen
from fusion.events import AGAIN, MOTION, Events, Measurements, Parameters, Recorder
from fusion.layout import Layout
from fusion.mechanization import increments, refresh, strapdown
from fusion.snapshots import S_CHANGED, save
from fusion.state import C_BEND, C_COUNT, C_INTERVAL, C_SAMPLE, C_STATE, Core, Floats
from fusion.tape import note_coast
from fusion.update import age, gives_up, handle, move
from sensors._kernels import radii
from sensors.kernel import kernel
from sensors.reference import by_reference

Interval = tuple[Vector, Vector, Vector, Vector, Vector, Vector]
"""Rates at both ends of an IMU interval, forces at both ends, and the bend of each (coefficient of x^2 - x)."""
GAP_STEP_NS = 50_000_000
"""A gap is crossed in steps of at most this."""
Part = tuple[Interval, float, float, float]
"""Part a..b of an interval (0..1) and its length in seconds."""


@kernel()
def process(
    core: Core,
    imu_t: NDArray[np.int64],
    gyro: Floats,
    accel: Floats,
    ev: Events,
    first_event: int,
    m: Measurements,
    par: Parameters,
    rec: Recorder,
) -> int:
    """Run IMU samples and all events up to the last of them; return the index of the first event not reached.

    A position that finds the filter hopeless (``fusion.health``) is not reached, and nothing after it.
    Events lie at or after the state's time. Between two samples the signals are curves, so an event is met at its own
    time, not at a sample's.
    """
    core, ev, m, par, rec = by_reference(core), by_reference(ev), by_reference(m), by_reference(par), by_reference(rec)
    reached: int = sweep(core, imu_t, gyro, accel, ev, first_event, m, par, rec, False)
    return reached


@kernel(inline="always")
def sweep(
    core: Core,
    imu_t: NDArray[np.int64],
    gyro: Floats,
    accel: Floats,
    ev: Events,
    first_event: int,
    m: Measurements,
    par: Parameters,
    rec: Recorder,
    keeps: bool,
) -> int:
    """The loop itself. keeps: a constant; with snapshots (``fusion.arrival``), or none that anybody would pay for."""
    e = first_event
    events = len(ev.t)
    nav, earth, acc, span, clock = core.nav, core.earth, core.acc, core.span, core.clock
    for i in range(len(imu_t)):
        t, start = imu_t[i], clock[C_SAMPLE]
        whole = t - start
        w: Vector = (gyro[i, 0], gyro[i, 1], gyro[i, 2])
        f: Vector = (accel[i, 0], accel[i, 1], accel[i, 2])
        # the sample before the last one serves where the spacing is even to a quarter
        clock[C_BEND] = int(clock[C_INTERVAL] > 0 and 3 * whole <= 4 * clock[C_INTERVAL] <= 5 * whole)
        gap = whole > par.max_gap_ns
        interval = _interval(core.last, clock[C_BEND] != 0, par.increments, w, f)
        remembered = False
        while True:
            now = clock[C_STATE]
            target = ev.t[e] if e < events and ev.t[e] < t else t
            stop = min(target, now + GAP_STEP_NS) if gap else target
            if stop > now:
                if whole > par.bridge_ns:
                    _coast(core, par, (stop - now) * 1e-9)
                else:
                    part = (interval, (now - start) / whole, (stop - start) / whole, (stop - now) * 1e-9)
                    _advance(nav, earth, acc, span, part, par.layout)
                    if gap:
                        move(core, par)
                        widen(core.P, (stop - now) * 1e-9, par.coast_accel, par.coast_rate)
                clock[C_STATE] = stop
            if stop == t and not remembered:
                _remember(core, t, w, f)
                if keeps:
                    save(core, blend(interval[0], interval[1], 1.0), gap)
                remembered = True
            if stop < target:
                continue
            if e >= events or ev.t[e] > stop:
                break
            if gives_up(core, par, ev, e, stop):
                return e
            rate = blend(interval[0], interval[1], (stop - start) / whole) if whole > 0 else w
            guess = gap
            if keeps and stop == start < t:  # after a rewind to the sample before
                rate, guess = (core.rate[0], core.rate[1], core.rate[2]), clock[C_INTERVAL] > par.max_gap_ns
            if not (guess and ev.kind[e] == MOTION):  # the rate in a gap is a guess
                recorded, decided = rec.filled[0], rec.filled[1]
                handle(core, rec, par, m, ev, e, axpy(-1.0, (nav[10], nav[11], nav[12]), rate))
                if keeps:
                    core.saves[S_CHANGED] = 1
                    if ev.verdict[e] == AGAIN:
                        rec.filled[0], rec.filled[1] = recorded, decided
            e += 1
    return e


@kernel(inline="always")
def _interval(last: Floats, bent: bool, increments: bool, w: Vector, f: Vector) -> Interval:
    """Rates and forces over the interval that ends with sample (w, f).

    rate samples: the parabola through the last three (bent), else a line. increments: the line through the two latest
    means, whose integral over the interval is the increment and whose coning term is the two-sample one (Savage 1998).
    """
    w0: Vector = (last[0, 0], last[0, 1], last[0, 2])
    f0: Vector = (last[0, 3], last[0, 4], last[0, 5])
    flat: Vector = (0.0, 0.0, 0.0)
    if increments:
        return blend(w0, w, 0.5), blend(w0, w, 1.5), blend(f0, f, 0.5), blend(f0, f, 1.5), flat, flat
    if not bent:
        return w0, w, f0, f, flat, flat
    w_old: Vector = (last[1, 0], last[1, 1], last[1, 2])
    f_old: Vector = (last[1, 3], last[1, 4], last[1, 5])
    return w0, w, f0, f, _bend(w_old, w0, w), _bend(f_old, f0, f)


@kernel(inline="always")
def _bend(older: Vector, last: Vector, new: Vector) -> Vector:
    """Half the second difference: the parabola through three samples is the line plus this times (x^2 - x)."""
    return (
        0.5 * (new[0] - 2.0 * last[0] + older[0]),
        0.5 * (new[1] - 2.0 * last[1] + older[1]),
        0.5 * (new[2] - 2.0 * last[2] + older[2]),
    )


@kernel(inline="always")
def _advance(nav: Floats, earth: Floats, acc: Floats, span: Floats, part: Part, layout: Layout) -> None:
    """One strapdown step over a part of an IMU interval."""
    interval, a, b, dt = part
    w0, w1, f0, f1, w_bend, f_bend = interval
    bg: Vector = (nav[10], nav[11], nav[12])
    ba: Vector = (nav[13], nav[14], nav[15])
    turn, push = increments(
        axpy(-1.0, bg, blend(w0, w1, a)),
        axpy(-1.0, bg, blend(w0, w1, b)),
        axpy(-1.0, ba, blend(f0, f1, a)),
        axpy(-1.0, ba, blend(f0, f1, b)),
        dt,
    )
    # integral of the bend (x^2 - x) over a..b, in units of dt
    bow = ((a * a + a * b + b * b) / 3.0 - 0.5 * (a + b)) * dt
    r = attitude(nav)
    dv = matvec(r, axpy(bow, f_bend, push))
    turn = axpy(bow, w_bend, turn)
    g, b = layout.gyro_scale + 1, layout.gyro_misalignment + 1
    if g > 0:
        turn = (turn[0], turn[1], turn[2] * (1.0 - nav[g]))
    if b > 0:
        turn = (turn[0] - nav[b] * turn[2], turn[1] - nav[b + 1] * turn[2], turn[2])
    accumulate(acc, span, r, dv, turn[2], dt)
    strapdown(nav, earth, turn, dv, dt)


@kernel(inline="always")
def _remember(core: Core, t: int, w: Vector, f: Vector) -> None:
    """Keep a sample as the last one and in the ring."""
    core.clock[C_INTERVAL] = t - core.clock[C_SAMPLE]
    core.clock[C_SAMPLE] = t
    k = core.clock[C_COUNT] & (len(core.ring_t) - 1)
    core.ring_t[k] = t
    for j in range(3):
        core.last[1, j], core.last[1, 3 + j] = core.last[0, j], core.last[0, 3 + j]
        core.last[0, j], core.last[0, 3 + j] = w[j], f[j]
        core.ring[k, j], core.ring[k, 3 + j] = w[j], f[j]
    core.clock[C_COUNT] += 1


@kernel(inline="always")
def _coast(core: Core, par: Parameters, dt: float) -> None:
    """Bridge a gap in the IMU at constant velocity and attitude, with the covariance widened."""
    move(core, par)
    nav = core.nav
    meridian, transverse = radii(np.sin(nav[0]))
    nav[1] += nav[3] * dt / ((transverse + nav[2]) * np.cos(nav[0]))
    nav[0] += nav[4] * dt / (meridian + nav[2])
    nav[2] += nav[5] * dt
    refresh(nav, core.earth)
    coast(core.P, dt, par.coast_accel, par.coast_rate)
    age(core, dt)
    if len(core.tape):
        note_coast(core, dt)
