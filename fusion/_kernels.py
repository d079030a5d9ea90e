"""The filter's loop: IMU samples and events in stamp order, one pass, no allocation per step.

``process`` serves the batch run and the streaming Localizer alike; whatever is fed in one call or in many, the same
operations run in the same order.
"""

import math

import numpy as np
from numpy.typing import NDArray

from fusion._linalg import Matrix, Vector, attitude, axpy, blend, matvec
from fusion.blocks import arm_of, fade, lasting, renew, scale, see_arm, see_delay
from fusion.covariance import accumulate, coast, propagate, widen
from fusion.events import AGAIN, MOTION, OUTPUT, Events, Measurements, Parameters, Recorder
from fusion.gating import correct, innovate, observed_directions, whiten
from fusion.measurements import Pair, gnss_position, gnss_velocity, heading, pose_fix, wheel_speed, wrap, yaw_row
from fusion.mechanization import increments, refresh, strapdown
from fusion.modes import observed_without
from fusion.motion import clear, motion
from fusion.recovery import believed, doubted, in_doubt
from fusion.result import Reason, Sensor
from fusion.robust import reweigh
from fusion.snapshots import S_CHANGED, save
from fusion.state import C_BEND, C_COUNT, C_INTERVAL, C_SAMPLE, C_STATE, ROW, Core, Floats
from fusion.streak import tally, threshold_of
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
_MODES_AGREE = int(Reason.MODES_AGREE)
_MULTI_MODAL = int(Reason.MULTI_MODAL)

Interval = tuple[Vector, Vector, Vector, Vector, Vector, Vector]
"""Rates at both ends of an IMU interval, forces at both ends, and the bend of each (coefficient of x^2 - x)."""
_GAP_STEP_NS = 50_000_000
"""A gap is crossed in steps of at most this."""
NORMAL_GRAVITY = 9.81
"""Near enough for the acceleration over a delay, m/s^2."""
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
            stop = min(target, now + _GAP_STEP_NS) if gap else target
            if stop > now:
                if whole > par.bridge_ns:
                    _coast(core, par, (stop - now) * 1e-9)
                else:
                    part = (interval, (now - start) / whole, (stop - start) / whole, (stop - now) * 1e-9)
                    _advance(nav, earth, acc, span, part, par.layout.gyro_scale)
                    if gap:
                        _age(core, span[0])
                        propagate(nav, earth, core.P, acc, span, (core.phi, core.M, core.Mt), par.noise)
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
            rate = blend(interval[0], interval[1], (stop - start) / whole) if whole > 0 else w
            guess = gap
            if keeps and stop == start < t:  # after a rewind to the sample before
                rate, guess = (core.rate[0], core.rate[1], core.rate[2]), clock[C_INTERVAL] > par.max_gap_ns
            if not (guess and ev.kind[e] == MOTION):  # the rate in a gap is a guess
                recorded, decided = rec.filled[0], rec.filled[1]
                _handle(core, rec, par, m, ev, e, axpy(-1.0, (nav[10], nav[11], nav[12]), rate))
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
def _advance(nav: Floats, earth: Floats, acc: Floats, span: Floats, part: Part, gyro_scale: int) -> None:
    """One strapdown step over a part of an IMU interval; gyro_scale: its error state."""
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
    if gyro_scale >= 0:
        turn = (turn[0], turn[1], turn[2] * (1.0 - nav[gyro_scale + 1]))
    accumulate(acc, span, r, dv, turn[2], dt)
    strapdown(nav, earth, turn, dv, dt)


@kernel(inline="always")
def _age(core: Core, dt: float) -> None:
    """Time and road go by for the errors that last."""
    core.aged[0] += dt
    core.aged[1] += dt * math.sqrt(core.nav[3] * core.nav[3] + core.nav[4] * core.nav[4])


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
    propagate(core.nav, core.earth, core.P, core.acc, core.span, (core.phi, core.M, core.Mt), par.noise)
    nav = core.nav
    meridian, transverse = radii(np.sin(nav[0]))
    nav[1] += nav[3] * dt / ((transverse + nav[2]) * np.cos(nav[0]))
    nav[0] += nav[4] * dt / (meridian + nav[2])
    nav[2] += nav[5] * dt
    refresh(nav, core.earth)
    coast(core.P, dt, par.coast_accel, par.coast_rate)
    _age(core, dt)


@kernel(inline="always")
def _handle(core: Core, rec: Recorder, par: Parameters, m: Measurements, ev: Events, e: int, rate: Vector) -> None:
    """Apply or record event e at the state's time; rate: bias-free body rate, rad/s."""
    kind = ev.kind[e]
    if ev.verdict[e] >= 0:
        _record(rec, e, kind, 0, ev.verdict[e])
        return
    if core.P.shape[0] > ROW:
        _age(core, core.span[0])
    propagate(core.nav, core.earth, core.P, core.acc, core.span, (core.phi, core.M, core.Mt), par.noise)
    if kind == OUTPUT:
        _record_state(core, rec, ev.t[e])
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
        dof, accepted = _measure(core, par, m, kind, ev.row[e], rate, True)
        if dof == 0:
            _record(rec, e, kind, 0, accepted)
            return
    k = _record(rec, e, kind, dof, _CHI_SQUARE)
    if kind not in (_GNSS_POSITION, _POSE_FIX):
        _apply(core, rec, par, k, dof, par.gate[dof - 1], accepted)
        return
    which = int(kind == _POSE_FIX)
    threshold = threshold_of(core, par, dof, ev.t[e]) if which else par.gate[dof - 1]
    passed = _apply(core, rec, par, k, dof, threshold, accepted)
    first = par.layout.pose_error if which else par.layout.gnss_error
    if not passed and first >= 0:  # what lasted may have changed all at once: then the state need not move for it
        dof, accepted = _measure(core, par, m, kind, ev.row[e], rate, False)
        known = innovate(core.P, core.H, core.W, dof, core.R, core.L)
        if known and whiten(dof, core.residual, core.L) <= threshold:
            renew(core.nav, core.P, first)
            dof, accepted = _measure(core, par, m, kind, ev.row[e], rate, True)
            passed = _apply(core, rec, par, k, dof, threshold, accepted)
    if not (passed and accepted == _MODES_AGREE):  # which says nothing of where the modes differ
        tally(core, which, passed, ev.t[e])
    if dof == 3:
        if passed:
            believed(core, which, ev.t[e])
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
def _measure(
    core: Core, par: Parameters, m: Measurements, kind: int, row: int, rate: Vector, lasts: bool
) -> tuple[int, int]:
    """Write residual, H and R of a sensor's measurement into the core; return its degrees of freedom, and the Reason to
    record if it is applied, or why it cannot be where there are none.

    lasts: let the states of errors that last carry their share of R; else R is whole, and they are not seen.
    """
    nav, H, R = core.nav, core.H, core.R
    clear(H)
    r = attitude(nav)
    if kind == _POSE_FIX:
        observed: tuple[int, int] = _measure_pose(core, par, m, row, rate, lasts)
        return observed
    arm = arm_of(nav, par.layout, par.gnss_arm)
    if kind == _GNSS_POSITION:
        _copy(m.gnss_cov, row, R)
        z = gnss_position(nav, r, H, _triple(m.gnss_llh, row), arm)
    elif kind == _GNSS_VELOCITY:
        _copy(m.vel_cov, row, R)
        z = gnss_velocity(nav, r, H, _triple(m.vel, row), arm, rate)
    elif kind == _GNSS_YAW:
        R[0, 0] = m.yaw_var[row]
        z = (wrap(m.yaw[row] - yaw_row(r, H, 0)), 0.0, 0.0)
    else:
        push = core.last[0, 3] - nav[13] - NORMAL_GRAVITY * r[6]
        slip = par.wheel_slip * push * m.wheel[row]
        R[0, 0] = m.wheel_var[row] + slip * slip
        z = (wheel_speed(nav, r, H, m.wheel[row], par.axle, rate), 0.0, 0.0)
    core.residual[0], core.residual[1], core.residual[2] = z
    if kind not in (_GNSS_POSITION, _GNSS_VELOCITY):
        return 1, _ACCEPTED
    if H.shape[1] > ROW:
        _see_receiver(core, par, r, kind == _GNSS_VELOCITY, rate, lasts)
    return 3, _ACCEPTED


@kernel(inline="always")
def _see_receiver(core: Core, par: Parameters, r: Matrix, of_velocity: bool, rate: Vector, lasts: bool) -> None:
    """What the blocks add to an antenna's position or velocity."""
    nav, H, layout = core.nav, core.H, par.layout
    see_arm(H, layout, r, rate, of_velocity)
    if layout.gnss_delay >= 0:
        change: Vector = (nav[3], nav[4], nav[5])
        if of_velocity:
            f: Vector = (core.last[0, 3] - nav[13], core.last[0, 4] - nav[14], core.last[0, 5] - nav[15])
            change = matvec(r, f)
            change = (change[0], change[1], change[2] - NORMAL_GRAVITY)
        see_delay(nav, H, core.residual, layout.gnss_delay, change)
    if layout.gnss_error < 0 or of_velocity:
        return
    if lasts:
        stated = core.R[0, 0] + core.R[1, 1]
        if 0.25 * core.aged[2] <= stated <= 4.0 * core.aged[2]:
            fade(nav, core.P, layout.gnss_error, math.exp(-par.gnss_rate * core.aged[0]))
        else:  # another kind of solution, with errors of its own
            renew(nav, core.P, layout.gnss_error)
        core.aged[0], core.aged[2] = 0.0, stated
        lasting(nav, H, core.R, core.residual, core.L, layout.gnss_error, par.gnss_shares[1])
    scale(core.R, par.gnss_shares[0] + (0.0 if lasts else par.gnss_shares[1]))


@kernel(inline="always")
def _measure_pose(core: Core, par: Parameters, m: Measurements, row: int, rate: Vector, lasts: bool) -> tuple[int, int]:
    """Pose fix in vehicle axes; directions that the histogram does not observe are dropped; rate: body, rad/s."""
    R, nav, cov = core.R, core.nav, m.pose_cov
    r = attitude(nav)
    c, s = heading(r)
    tilt = (m.pose_tilt[row, 0], m.pose_tilt[row, 1])
    z = pose_fix(r, core.H, nav, _triple(m.pose_llh, row), m.pose_yaw[row], tilt, par.pose_arm, (c, s))
    core.residual[0], core.residual[1], core.residual[2] = z
    ee, en, nn = cov[row, 0, 0], cov[row, 0, 1], cov[row, 1, 1]
    fresh = core.fresh
    fresh[0], fresh[1], fresh[2], fresh[3], fresh[4] = c * z[0] - s * z[1], s * z[0] + c * z[1], ee, en, nn
    ey, ny = cov[row, 0, 2], cov[row, 1, 2]
    R[0, 0] = c * c * ee + 2.0 * c * s * en + s * s * nn
    R[1, 1] = s * s * ee - 2.0 * c * s * en + c * c * nn
    R[0, 1] = R[1, 0] = c * s * (nn - ee) + (c * c - s * s) * en
    R[0, 2] = R[2, 0] = c * ey + s * ny
    R[1, 2] = R[2, 1] = c * ny - s * ey
    R[2, 2] = cov[row, 2, 2]
    limits = par.pose_limits
    trace = R[0, 0] / limits[0] ** 2 + R[1, 1] / limits[1] ** 2 + R[2, 2] / limits[2] ** 2
    a, b, turn = m.pose_spread[row, 0], m.pose_spread[row, 1], m.pose_spread[row, 2]
    alone = 0  # directions that are observed if there is one mode only
    if trace > 1.0 and (a != 0.0 or b != 0.0 or turn != 0.0):
        alone = observed_without(R, (c * a + s * b, c * b - s * a, turn), limits, core.eigen)
    _see_matching(core, par, (c, s), r[8] * rate[2], lasts)
    if trace <= 1.0:  # then every eigenvalue is
        return 3, _ACCEPTED
    if par.layout.pose_error >= 0:  # R has been scaled
        grown = math.sqrt(par.pose_shares[0] + (0.0 if lasts else par.pose_shares[1]))
        limits = (grown * limits[0], grown * limits[1], grown * limits[2])
    kept = observed_directions(core.H, R, core.residual, limits, core.eigen, core.W)
    if kept == 3:
        return 3, _ACCEPTED
    if kept == 0 or not par.pose_partial:
        return 0, _MULTI_MODAL if kept < alone else _COVARIANCE
    return kept, _MODES_AGREE if kept < alone else _PARTLY


@kernel(inline="always")
def _see_matching(core: Core, par: Parameters, ahead: Pair, yaw_rate: float, lasts: bool) -> None:
    """What the blocks add to a pose fix (along, left, yaw)."""
    nav, H, residual, layout = core.nav, core.H, core.residual, par.layout
    c, s = ahead
    if layout.pose_delay >= 0:
        change: Vector = (c * nav[3] + s * nav[4], c * nav[4] - s * nav[3], yaw_rate)
        see_delay(nav, H, residual, layout.pose_delay, change)
    if layout.pose_yaw >= 0:
        H[2, layout.pose_yaw] = 1.0
        residual[2] -= nav[layout.pose_yaw + 1]
    if layout.pose_error < 0:
        return
    if lasts:
        fade(nav, core.P, layout.pose_error, math.exp(-par.pose_per_m * core.aged[1]))
        core.aged[1] = 0.0
        lasting(nav, H, core.R, residual, core.L, layout.pose_error, par.pose_shares[1])
    scale(core.R, par.pose_shares[0] + (0.0 if lasts else par.pose_shares[1]))


@kernel(inline="always")
def _apply(core: Core, rec: Recorder, par: Parameters, k: int, dof: int, threshold: float, accepted: int) -> bool:
    """Gate the core's residual and correct the state; complete decision k. Whether it passed."""
    L, residual = core.L, core.residual
    rec.scores[k, 1] = threshold
    rec.scores[k, 2] = rec.scores[k, 3] = rec.scores[k, 4] = 0.0
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
    weight = 1.0
    if par.robust:
        weight = reweigh(
            core.P, core.H, core.W, dof, core.R, L, residual, rec.innovation, k, par.robust, par.robust_sigmas, core.dx
        )  # fmt: skip
    correct(core.nav, core.earth, core.P, core.W, core.dx, residual, dof)
    dx = core.dx
    rec.reason[k] = accepted
    rec.scores[k, 2] = np.sqrt(dx[0] ** 2 + dx[1] ** 2 + dx[2] ** 2)
    rec.scores[k, 3] = abs(dx[8])
    rec.scores[k, 4] = weight
    return True


@kernel(inline="always")
def _record(rec: Recorder, event: int, sensor: int, dof: int, reason: int) -> int:
    """Open a decision; returns its row."""
    k = int(rec.filled[1])
    rec.filled[1] = k + 1
    rec.event[k], rec.sensor[k], rec.dof[k], rec.reason[k] = event, sensor, dof, reason
    for i in range(3):
        rec.innovation[k, i] = rec.sigma[k, i] = np.nan
    for i in range(5):
        rec.scores[k, i] = np.nan
    return k


@kernel(inline="always")
def _record_state(core: Core, rec: Recorder, t: int) -> None:
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
