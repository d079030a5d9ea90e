"""The filter's loop: IMU samples and events in stamp order, one pass, no allocation per step.

``process`` serves the batch run and the streaming Localizer alike; whatever is fed in one call or in many, the same
operations run in the same order.
"""

import numpy as np
from numpy.typing import NDArray

from fusion._linalg import Vector, attitude, axpy, blend, matvec
from fusion.covariance import accumulate, coast, propagate, widen
from fusion.events import MOTION, OUTPUT, Events, Measurements, Parameters, Recorder
from fusion.gating import correct, innovate, observed_directions, whiten
from fusion.measurements import gnss_position, gnss_velocity, heading, pose_fix, wheel_speed, wrap, yaw_row
from fusion.mechanization import increments, refresh, strapdown
from fusion.motion import clear, motion
from fusion.recovery import believed, doubted, in_doubt
from fusion.result import Reason, Sensor
from fusion.state import C_BEND, C_COUNT, C_INTERVAL, C_SAMPLE, C_STATE, RING_SIZE, Core, Floats
from fusion.tape import note_coast, note_correction, note_move, note_state
from sensors._kernels import radii
from sensors.kernel import kernel

_GNSS_POSITION = int(Sensor.GNSS_POSITION)
_GNSS_VELOCITY = int(Sensor.GNSS_VELOCITY)
_GNSS_YAW = int(Sensor.GNSS_YAW)
_POSE_FIX = int(Sensor.POSE_FIX)
_ACCEPTED = int(Reason.ACCEPTED)
_PARTLY = int(Reason.PARTLY_ACCEPTED)
_CHI_SQUARE = int(Reason.CHI_SQUARE)
_COVARIANCE = int(Reason.COVARIANCE)
_RECEIVER = int(Reason.RECEIVER)

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

    Events lie at or after the state's time. Between two samples the signals are curves, so an event is met at its own
    time, not at a sample's.
    """
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
                    _advance(nav, earth, acc, span, part)
                    if gap:
                        _move(core, par)
                        widen(core.P, (stop - now) * 1e-9, par.coast_accel, par.coast_rate)
                clock[C_STATE] = stop
            if stop == t and not remembered:
                _remember(core, t, w, f)
                remembered = True
            if stop < target:
                continue
            if e >= events or ev.t[e] > stop:
                break
            rate = blend(interval[0], interval[1], (stop - start) / whole) if whole > 0 else w
            if not (gap and ev.kind[e] == MOTION):  # the rate in a gap is a guess
                _handle(core, rec, par, m, ev, e, axpy(-1.0, (nav[10], nav[11], nav[12]), rate))
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
def _advance(nav: Floats, earth: Floats, acc: Floats, span: Floats, part: Part) -> None:
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
    accumulate(acc, span, r, dv, dt)
    strapdown(nav, earth, axpy(bow, w_bend, turn), dv, dt)


@kernel(inline="always")
def _remember(core: Core, t: int, w: Vector, f: Vector) -> None:
    """Keep a sample as the last one and in the ring."""
    core.clock[C_INTERVAL] = t - core.clock[C_SAMPLE]
    core.clock[C_SAMPLE] = t
    k = core.clock[C_COUNT] % RING_SIZE
    core.ring_t[k] = t
    for j in range(3):
        core.last[1, j], core.last[1, 3 + j] = core.last[0, j], core.last[0, 3 + j]
        core.last[0, j], core.last[0, 3 + j] = w[j], f[j]
        core.ring[k, j], core.ring[k, 3 + j] = w[j], f[j]
    core.clock[C_COUNT] += 1


@kernel(inline="always")
def _coast(core: Core, par: Parameters, dt: float) -> None:
    """Bridge a gap in the IMU at constant velocity and attitude, with the covariance widened."""
    _move(core, par)
    nav = core.nav
    meridian, transverse = radii(np.sin(nav[0]))
    nav[1] += nav[3] * dt / ((transverse + nav[2]) * np.cos(nav[0]))
    nav[0] += nav[4] * dt / (meridian + nav[2])
    nav[2] += nav[5] * dt
    refresh(nav, core.earth)
    coast(core.P, dt, par.coast_accel, par.coast_rate)
    if len(core.tape):
        note_coast(core.tape, core.tape_end, dt)


@kernel(inline="always")
def _move(core: Core, par: Parameters) -> None:
    """Bring P up to the state's time."""
    if core.span[0] != 0.0:
        propagate(core.nav, core.earth, core.P, core.acc, core.span, (core.phi, core.M, core.Mt), par.noise)
        if len(core.tape):
            note_move(core.tape, core.tape_end, core.phi, core.stay)


@kernel(inline="always")
def _handle(core: Core, rec: Recorder, par: Parameters, m: Measurements, ev: Events, e: int, rate: Vector) -> None:
    """Apply or record event e at the state's time; rate: bias-free body rate, rad/s."""
    kind = ev.kind[e]
    if ev.verdict[e] >= 0:
        _record(rec, e, kind, 0, ev.verdict[e])
        return
    _move(core, par)
    if kind == OUTPUT:
        record_state(core, rec, ev.t[e])
        if len(core.tape):
            note_state(core.tape, core.tape_end, core.nav, core.P, ev.t[e])
        return
    accepted = _ACCEPTED
    if kind == MOTION:
        kind, dof = motion(core, par, ev.t[e], rate)
        if dof == 0:
            return
    elif kind == _GNSS_VELOCITY and in_doubt(core, 0, ev.t[e]):
        _record(rec, e, kind, 0, _RECEIVER)
        return
    else:
        dof = _measure(core, par, m, kind, ev.row[e], rate)
        if dof == 0:
            _record(rec, e, kind, 0, _COVARIANCE)
            return
        if kind == _POSE_FIX and dof < 3:
            accepted = _PARTLY
    k = _record(rec, e, kind, dof, _CHI_SQUARE)
    passed = _apply(core, rec, k, dof, par.gate[dof - 1], accepted)
    if kind in (_GNSS_POSITION, _POSE_FIX) and dof == 3:
        if passed:
            believed(core, int(kind == _POSE_FIX))
        elif kind == _POSE_FIX:
            doubted(core, par, 1, _triple(rec.innovation, k), heading(attitude(core.nav)), ev.t[e])
        else:
            doubted(core, par, 0, _triple(rec.innovation, k), (1.0, 0.0), ev.t[e])


@kernel()
def _triple(a: Floats, row: int) -> Vector:
    return a[row, 0], a[row, 1], a[row, 2]


@kernel()
def _copy(cov: Floats, row: int, R: Floats) -> None:
    for i in range(3):
        for j in range(3):
            R[i, j] = cov[row, i, j]


@kernel(inline="always")
def _measure(core: Core, par: Parameters, m: Measurements, kind: int, row: int, rate: Vector) -> int:
    """Write residual, H and R of a sensor's measurement into the core; return its degrees of freedom."""
    nav, H, R = core.nav, core.H, core.R
    clear(H)
    r = attitude(nav)
    if kind == _POSE_FIX:
        dof: int = _measure_pose(core, par, m, row)
        return dof
    if kind == _GNSS_POSITION:
        _copy(m.gnss_cov, row, R)
        z = gnss_position(nav, r, H, _triple(m.gnss_llh, row), par.gnss_arm)
    elif kind == _GNSS_VELOCITY:
        _copy(m.vel_cov, row, R)
        z = gnss_velocity(nav, r, H, _triple(m.vel, row), par.gnss_arm, rate)
    elif kind == _GNSS_YAW:
        R[0, 0] = m.yaw_var[row]
        z = (wrap(m.yaw[row] - yaw_row(r, H, 0)), 0.0, 0.0)
    else:
        R[0, 0] = m.wheel_var[row]
        z = (wheel_speed(nav, r, H, m.wheel[row], par.axle, rate), 0.0, 0.0)
    core.residual[0], core.residual[1], core.residual[2] = z
    return 3 if kind in (_GNSS_POSITION, _GNSS_VELOCITY) else 1


@kernel(inline="always")
def _measure_pose(core: Core, par: Parameters, m: Measurements, row: int) -> int:
    """Pose fix in vehicle axes; directions that the histogram does not observe are dropped."""
    R, nav, cov = core.R, core.nav, m.pose_cov
    r = attitude(nav)
    c, s = heading(r)
    tilt = (m.pose_tilt[row, 0], m.pose_tilt[row, 1])
    z = pose_fix(r, core.H, nav, _triple(m.pose_llh, row), m.pose_yaw[row], tilt, par.pose_arm, (c, s))
    core.residual[0], core.residual[1], core.residual[2] = z
    ee, en, nn = cov[row, 0, 0], cov[row, 0, 1], cov[row, 1, 1]
    ey, ny = cov[row, 0, 2], cov[row, 1, 2]
    R[0, 0] = c * c * ee + 2.0 * c * s * en + s * s * nn
    R[1, 1] = s * s * ee - 2.0 * c * s * en + c * c * nn
    R[0, 1] = R[1, 0] = c * s * (nn - ee) + (c * c - s * s) * en
    R[0, 2] = R[2, 0] = c * ey + s * ny
    R[1, 2] = R[2, 1] = c * ny - s * ey
    R[2, 2] = cov[row, 2, 2]
    limits = par.pose_limits
    trace = R[0, 0] / limits[0] ** 2 + R[1, 1] / limits[1] ** 2 + R[2, 2] / limits[2] ** 2
    if trace <= 1.0:  # then every eigenvalue is
        return 3
    kept: int = observed_directions(core.H, R, core.residual, limits, core.eigen, core.W)
    return kept


@kernel(inline="always")
def _apply(core: Core, rec: Recorder, k: int, dof: int, threshold: float, accepted: int) -> bool:
    """Gate the core's residual and correct the state; complete decision k. Whether it passed."""
    L, residual = core.L, core.residual
    rec.scores[k, 1] = threshold
    rec.scores[k, 2] = rec.scores[k, 3] = 0.0
    for i in range(dof):
        rec.innovation[k, i] = residual[i]
    if not innovate(core.P, core.H, core.W, dof, core.R, L):
        return False
    for i in range(dof):
        total = 0.0
        for j in range(i + 1):
            total += L[i, j] * L[i, j]
        rec.sigma[k, i] = np.sqrt(total)
    score = whiten(dof, residual, L)
    rec.scores[k, 0] = score
    if not score <= threshold:
        return False
    correct(core.nav, core.earth, core.P, core.W, core.dx, residual, dof)
    if len(core.tape):
        note_correction(core.tape, core.tape_end, (core.H, core.L, core.W), residual, core.dx, dof)
    dx = core.dx
    rec.reason[k] = accepted
    rec.scores[k, 2] = np.sqrt(dx[0] ** 2 + dx[1] ** 2 + dx[2] ** 2)
    rec.scores[k, 3] = abs(dx[8])
    return True


@kernel(inline="always")
def _record(rec: Recorder, event: int, sensor: int, dof: int, reason: int) -> int:
    """Open a decision; returns its row."""
    k = int(rec.filled[1])
    rec.filled[1] = k + 1
    rec.event[k], rec.sensor[k], rec.dof[k], rec.reason[k] = event, sensor, dof, reason
    for i in range(3):
        rec.innovation[k, i] = rec.sigma[k, i] = np.nan
    for i in range(4):
        rec.scores[k, i] = np.nan
    return k


@kernel(inline="always")
def record_state(core: Core, rec: Recorder, t: int) -> None:
    """Record nav, the pose covariance (position, attitude) and every sigma."""
    P = core.P
    k = rec.filled[0]
    rec.filled[0] = k + 1
    rec.t[k] = t
    for i in range(16):
        rec.nav[k, i] = core.nav[i]
    for i in range(15):
        rec.sigma_state[k, i] = np.sqrt(P[i, i])
    for i in range(6):
        a = i if i < 3 else i + 3
        for j in range(6):
            b = j if j < 3 else j + 3
            rec.pose_cov[k, i, j] = P[a, b]
