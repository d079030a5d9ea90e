"""The filter's loop: IMU samples and events in stamp order, one pass, no allocation per step.

``process`` serves the batch run and the streaming Localizer alike; whatever is fed in one call or in many, the same
operations run in the same order.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fusion._linalg import Matrix, Quaternion, Vector, axpy, blend, cross, matvec, matvec_t, rotation
from fusion.covariance import Noise, accumulate, coast, propagate
from fusion.gating import correct, innovate, nis, observed_directions
from fusion.measurements import body_velocity, gnss_position, gnss_velocity, pose_fix, wrap, yaw_row
from fusion.mechanization import increments, strapdown
from fusion.result import Reason, Sensor
from fusion.state import RING_SIZE, Core, Floats
from sensors._kernels import EARTH_RATE, radii

MOTION = 100
"""Event: see whether the vehicle stands, then apply zero velocity or the non-holonomic constraint."""
OUTPUT = 101
"""Event: record the state."""

_GNSS_POSITION = int(Sensor.GNSS_POSITION)
_GNSS_VELOCITY = int(Sensor.GNSS_VELOCITY)
_GNSS_YAW = int(Sensor.GNSS_YAW)
_POSE_FIX = int(Sensor.POSE_FIX)
_WHEEL = int(Sensor.WHEEL)
_ZERO_VELOCITY = int(Sensor.ZERO_VELOCITY)
_NON_HOLONOMIC = int(Sensor.NON_HOLONOMIC)
_ACCEPTED = int(Reason.ACCEPTED)
_PARTLY = int(Reason.PARTLY_ACCEPTED)
_CHI_SQUARE = int(Reason.CHI_SQUARE)
_COVARIANCE = int(Reason.COVARIANCE)


class Parameters(NamedTuple):
    """The configuration in SI units, as the kernel reads it."""

    noise: Noise
    increments: bool
    max_gap_ns: int
    coast_accel: float
    coast_rate: float
    gate: Vector
    """Chi-square thresholds for 1, 2 and 3 degrees of freedom."""
    gnss_arm: Vector
    pose_arm: Vector
    axle: Vector
    pose_limits: Vector
    """Largest observed sigma along, left and in yaw."""
    zero_velocity: bool
    non_holonomic: bool
    lateral_var: float
    vertical_var: float
    per_speed: float
    min_speed: float
    still_window_ns: int
    still_accel_var: float
    still_rate_var: float
    still_max_speed: float
    zero_velocity_var: float
    zero_rate_var: float


class Measurements(NamedTuple):
    """Columns of each sensor with the covariances that the filter uses (floors and inflation applied).

    gnss_llh (N, 3), gnss_cov (N, 3, 3) ENU; vel (N, 3), vel_cov (N, 3, 3); yaw, yaw_var (N,); pose_llh (N, 3),
    pose_yaw (N,) from east, pose_tilt (N, 2), pose_cov (N, 3, 3) in (east, north, yaw); wheel, wheel_var (N,).
    """

    gnss_llh: Floats
    gnss_cov: Floats
    vel: Floats
    vel_cov: Floats
    yaw: Floats
    yaw_var: Floats
    pose_llh: Floats
    pose_yaw: Floats
    pose_tilt: Floats
    pose_cov: Floats
    wheel: Floats
    wheel_var: Floats


class Events(NamedTuple):
    """What happens when, sorted: t (M,) ns; kind (M,) Sensor, MOTION or OUTPUT; row (M,) into its sensor's columns;
    verdict (M,) int8: -1 to apply, else the Reason that is only recorded."""

    t: NDArray[np.int64]
    kind: NDArray[np.int8]
    row: NDArray[np.int64]
    verdict: NDArray[np.int8]


class Recorder(NamedTuple):
    """Output arrays, filled from ``count`` = (states, decisions) on.

    states: t (N,), nav (N, 16), pose_cov (N, 6, 6), sigma_state (N, 15). decisions: event (M,) index of the event, sensor, reason, dof (M,) int8,
    innovation, sigma (M, 3), scores (M, 4): NIS, threshold, metres moved, yaw moved. scratch: R, S, inverse, directions
    (4, 3, 3), vectors (2, 15).
    """

    count: NDArray[np.int64]
    t: NDArray[np.int64]
    nav: Floats
    pose_cov: Floats
    sigma_state: Floats
    event: NDArray[np.int64]
    sensor: NDArray[np.int8]
    reason: NDArray[np.int8]
    dof: NDArray[np.int8]
    innovation: Floats
    sigma: Floats
    scores: Floats
    scratch: Floats
    vectors: Floats


Interval = tuple[Vector, Vector, Vector, Vector, Vector, Vector]
"""Rates at both ends of an IMU interval, forces at both ends, and the bend of each (coefficient of x^2 - x)."""


@njit(cache=True, inline="always")
def _row(a: Floats, i: int) -> Vector:
    return a[i, 0], a[i, 1], a[i, 2]


@njit(cache=True, inline="always")
def _attitude(nav: Floats) -> Matrix:
    q: Quaternion = (nav[6], nav[7], nav[8], nav[9])
    return rotation(q)


@njit(cache=True)
def _advance(core: Core, interval: Interval, a: float, b: float, dt: float) -> None:
    """One strapdown step over the part a..b (0..1) of an IMU interval, dt seconds long."""
    nav = core.nav
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
    turn, push = axpy(bow, w_bend, turn), axpy(bow, f_bend, push)
    before: Quaternion = (nav[6], nav[7], nav[8], nav[9])
    accumulate(core, matvec(rotation(before), push), dt)
    strapdown(nav, turn, push, dt)


@njit(cache=True)
def _decide(core: Core, rec: Recorder, par: Parameters, event: int, sensor: int, dof: int, low: int, high: int) -> None:
    """Gate and apply the residual in rec.vectors[0] with covariance rec.scratch[0] and core.H; record the decision."""
    R, S, inverse = rec.scratch[0], rec.scratch[1], rec.scratch[2]
    residual, dx = rec.vectors[0], rec.vectors[1]
    k = rec.count[1]
    rec.count[1] = k + 1
    rec.event[k], rec.sensor[k], rec.dof[k] = event, sensor, dof
    valid = innovate(core, dof, low, high, R, S, inverse)
    score = nis(dof, residual, inverse)
    for i in range(dof):
        rec.innovation[k, i] = residual[i]
        rec.sigma[k, i] = np.sqrt(S[i, i])
    rec.scores[k, 0], rec.scores[k, 1] = score, par.gate[dof - 1]
    rec.scores[k, 2] = rec.scores[k, 3] = 0.0
    if not valid or not score <= par.gate[dof - 1]:
        rec.reason[k] = _CHI_SQUARE
        return
    yaw = np.arctan2(*_forward(core.nav))
    correct(core, dof, residual, inverse, dx)
    rec.reason[k] = _ACCEPTED
    rec.scores[k, 2] = np.sqrt(dx[0] ** 2 + dx[1] ** 2 + dx[2] ** 2)
    rec.scores[k, 3] = abs(wrap(np.arctan2(*_forward(core.nav)) - yaw))


@njit(cache=True, inline="always")
def _forward(nav: Floats) -> tuple[float, float]:
    """North and east components of the body's forward axis."""
    r = _attitude(nav)
    return r[3], r[0]


@njit(cache=True)
def _record_only(rec: Recorder, event: int, sensor: int, reason: int) -> None:
    k = rec.count[1]
    rec.count[1] = k + 1
    rec.event[k], rec.sensor[k], rec.dof[k], rec.reason[k] = event, sensor, 0, reason


@njit(cache=True)
def _set_residual(rec: Recorder, z: Vector) -> None:
    rec.vectors[0, 0], rec.vectors[0, 1], rec.vectors[0, 2] = z


@njit(cache=True)
def _apply_pose(core: Core, rec: Recorder, par: Parameters, m: Measurements, event: int, row: int) -> None:
    """Pose fix in vehicle axes; directions that the histogram does not observe are dropped."""
    nav = core.nav
    r = _attitude(nav)
    length = np.sqrt(r[0] * r[0] + r[3] * r[3])
    c, s = r[0] / length, r[3] / length
    z = pose_fix(r, core.H, nav, m.pose_llh[row], m.pose_yaw[row], m.pose_tilt[row], par.pose_arm, (c, s, 0.0))
    R, directions = rec.scratch[0], rec.scratch[3]
    P = m.pose_cov[row]
    cross_term = c * s * (P[1, 1] - P[0, 0]) + (c * c - s * s) * P[0, 1]
    R[0, 0] = c * c * P[0, 0] + 2.0 * c * s * P[0, 1] + s * s * P[1, 1]
    R[1, 1] = s * s * P[0, 0] - 2.0 * c * s * P[0, 1] + c * c * P[1, 1]
    R[0, 1] = R[1, 0] = cross_term
    R[0, 2] = R[2, 0] = c * P[0, 2] + s * P[1, 2]
    R[1, 2] = R[2, 1] = c * P[1, 2] - s * P[0, 2]
    R[2, 2] = P[2, 2]
    lim = par.pose_limits
    trace = R[0, 0] / lim[0] ** 2 + R[1, 1] / lim[1] ** 2 + R[2, 2] / lim[2] ** 2
    if trace <= 1.0:  # every eigenvalue is below the limit
        _set_residual(rec, z)
        _decide(core, rec, par, event, _POSE_FIX, 3, 0, 9)
        return
    kept = observed_directions(R, lim, directions)
    if kept == 0:
        _record_only(rec, event, _POSE_FIX, _COVARIANCE)
        return
    if kept == 3:
        _set_residual(rec, z)
        _decide(core, rec, par, event, _POSE_FIX, 3, 0, 9)
        return
    _project(core, rec, z, kept)
    k = rec.count[1]
    _decide(core, rec, par, event, _POSE_FIX, kept, 0, 9)
    if rec.reason[k] == _ACCEPTED:
        rec.reason[k] = _PARTLY


@njit(cache=True)
def _project(core: Core, rec: Recorder, z: Vector, kept: int) -> None:
    """Residual, H and R in the first ``kept`` directions (columns of scratch[3])."""
    R, T = rec.scratch[0], rec.scratch[3]
    rows = core.H.copy()
    full = R.copy()
    for i in range(kept):
        rec.vectors[0, i] = T[0, i] * z[0] + T[1, i] * z[1] + T[2, i] * z[2]
        for j in range(9):
            core.H[i, j] = T[0, i] * rows[0, j] + T[1, i] * rows[1, j] + T[2, i] * rows[2, j]
        for j in range(kept):
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += T[a, i] * full[a, b] * T[b, j]
            R[i, j] = total


@njit(cache=True)
def _still(core: Core, par: Parameters, now: int) -> tuple[bool, float, float, float]:
    """Whether the IMU was quiet over the window before now, and its mean rate since the last motion tick, rad/s."""
    count = core.clock[3]
    total = np.zeros(3)
    squares = np.zeros(3)
    recent = np.zeros(3)
    norm, norm2 = 0.0, 0.0
    n, fresh = 0, 0
    oldest = now
    for back in range(min(count, RING_SIZE)):
        i = (count - 1 - back) % RING_SIZE
        t = core.ring_t[i]
        if t <= now - par.still_window_ns:
            break
        oldest = t
        n += 1
        for k in range(3):
            rate = core.ring[i, k] - core.nav[10 + k]
            total[k] += rate
            squares[k] += rate * rate
        if t > core.clock[2]:
            fresh += 1
            for k in range(3):
                recent[k] += core.ring[i, k]
        f2 = core.ring[i, 3] ** 2 + core.ring[i, 4] ** 2 + core.ring[i, 5] ** 2
        norm += np.sqrt(f2)
        norm2 += f2
    if n < 5 or fresh == 0 or now - oldest < 0.8 * par.still_window_ns:
        return False, 0.0, 0.0, 0.0
    quiet = norm2 / n - (norm / n) ** 2 < par.still_accel_var
    for k in range(3):
        mean = total[k] / n
        quiet = quiet and squares[k] / n - mean * mean < par.still_rate_var
    return quiet, recent[0] / fresh, recent[1] / fresh, recent[2] / fresh


@njit(cache=True)
def _apply_motion(core: Core, rec: Recorder, par: Parameters, event: int, now: int, rate: Vector) -> None:
    """Zero velocity and zero rate at rest; else the non-holonomic constraint above a speed."""
    nav, P = core.nav, core.P
    R = rec.scratch[0]
    speed = np.sqrt(nav[3] ** 2 + nav[4] ** 2 + nav[5] ** 2)
    if par.zero_velocity and speed < par.still_max_speed + 3.0 * np.sqrt(P[3, 3] + P[4, 4] + P[5, 5]):
        quiet, w0, w1, w2 = _still(core, par, now)
        core.clock[2] = now
        if quiet:
            R[:] = 0.0
            for i in range(3):
                core.H[i, 3 + i] = 1.0
                R[i, i] = par.zero_velocity_var
                rec.vectors[0, i] = -nav[3 + i]
            k = rec.count[1]
            _decide(core, rec, par, event, _ZERO_VELOCITY, 3, 3, 6)
            core.H[:] = 0.0
            if rec.reason[k] == _ACCEPTED:
                _apply_zero_rate(core, rec, par, (w0, w1, w2))
            return
    core.clock[2] = now
    if not par.non_holonomic or speed < par.min_speed:
        return
    velocity = body_velocity(nav, _attitude(nav), core.H, par.axle, rate)
    for j in range(15):  # lateral and vertical rows first
        core.H[0, j], core.H[1, j] = core.H[1, j], core.H[2, j]
    extra = (par.per_speed * speed) ** 2
    R[:] = 0.0
    R[0, 0], R[1, 1] = par.lateral_var + extra, par.vertical_var + extra
    rec.vectors[0, 0], rec.vectors[0, 1] = -velocity[1], -velocity[2]
    _decide(core, rec, par, event, _NON_HOLONOMIC, 2, 3, 12)


@njit(cache=True)
def _apply_zero_rate(core: Core, rec: Recorder, par: Parameters, mean: Vector) -> None:
    """At rest the gyro shows its bias and the earth's turning: mean = bg + R' omega_ie. Gated, not recorded on its own."""
    nav = core.nav
    R, S, inverse = rec.scratch[0], rec.scratch[1], rec.scratch[2]
    earth = matvec_t(_attitude(nav), (0.0, EARTH_RATE * np.cos(nav[0]), EARTH_RATE * np.sin(nav[0])))
    R[:] = 0.0
    for i in range(3):
        core.H[i, 9 + i] = 1.0
        R[i, i] = par.zero_rate_var
        rec.vectors[0, i] = mean[i] - earth[i] - nav[10 + i]
    if innovate(core, 3, 9, 12, R, S, inverse) and nis(3, rec.vectors[0], inverse) <= par.gate[2]:
        correct(core, 3, rec.vectors[0], inverse, rec.vectors[1])


@njit(cache=True)
def _record_covariance(core: Core, rec: Recorder, k: int) -> None:
    """Pose covariance (position, attitude) and every sigma of output k."""
    P = core.P
    for i in range(15):
        rec.sigma_state[k, i] = np.sqrt(P[i, i])
    for i in range(6):
        a = i if i < 3 else i + 3
        for j in range(6):
            b = j if j < 3 else j + 3
            rec.pose_cov[k, i, j] = P[a, b]


@njit(cache=True)
def _handle(core: Core, rec: Recorder, par: Parameters, m: Measurements, ev: Events, e: int, rate: Vector) -> None:
    """Apply event e at the state's time; rate: bias-free body rate."""
    kind, row = ev.kind[e], ev.row[e]
    nav, R = core.nav, rec.scratch[0]
    if ev.verdict[e] >= 0:
        _record_only(rec, e, kind, ev.verdict[e])
        return
    propagate(core, par.noise)
    if kind == OUTPUT:
        k = rec.count[0]
        rec.count[0] = k + 1
        rec.t[k] = ev.t[e]
        rec.nav[k] = nav
        _record_covariance(core, rec, k)
        return
    core.H[:] = 0.0
    if kind == MOTION:
        _apply_motion(core, rec, par, e, ev.t[e], rate)
    elif kind == _POSE_FIX:
        _apply_pose(core, rec, par, m, e, row)
    elif kind == _GNSS_POSITION:
        R[:] = m.gnss_cov[row]
        _set_residual(rec, gnss_position(nav, _attitude(nav), core.H, m.gnss_llh[row], par.gnss_arm))
        _decide(core, rec, par, e, kind, 3, 0, 9)
    elif kind == _GNSS_VELOCITY:
        R[:] = m.vel_cov[row]
        _set_residual(rec, gnss_velocity(nav, _attitude(nav), core.H, m.vel[row], par.gnss_arm, rate))
        _decide(core, rec, par, e, kind, 3, 3, 12)
    elif kind == _GNSS_YAW:
        R[0, 0] = m.yaw_var[row]
        rec.vectors[0, 0] = wrap(m.yaw[row] - yaw_row(_attitude(nav), core.H, 0))
        _decide(core, rec, par, e, kind, 1, 6, 9)
    elif kind == _WHEEL:
        R[0, 0] = m.wheel_var[row]
        rec.vectors[0, 0] = m.wheel[row] - body_velocity(nav, _attitude(nav), core.H, par.axle, rate)[0]
        _decide(core, rec, par, e, kind, 1, 3, 12)


@njit(cache=True)
def _interval(core: Core, par: Parameters, w: Vector, f: Vector) -> Interval:
    """Rates and forces over the interval that ends with sample (w, f).

    rate samples: the parabola through the last three, when evenly spaced. increments: the line through the two latest
    means, whose integral over the interval is the increment and whose coning term is the two-sample one (Savage 1998).
    """
    last, older = core.last[0], core.last[1]
    w0: Vector = (last[0], last[1], last[2])
    f0: Vector = (last[3], last[4], last[5])
    flat: Vector = (0.0, 0.0, 0.0)
    if par.increments:
        return blend(w0, w, 0.5), blend(w0, w, 1.5), blend(f0, f, 0.5), blend(f0, f, 1.5), flat, flat
    if core.clock[4] == 0:
        return w0, w, f0, f, flat, flat
    w_bend: Vector = (
        0.5 * (w[0] - 2.0 * w0[0] + older[0]),
        0.5 * (w[1] - 2.0 * w0[1] + older[1]),
        0.5 * (w[2] - 2.0 * w0[2] + older[2]),
    )
    f_bend: Vector = (
        0.5 * (f[0] - 2.0 * f0[0] + older[3]),
        0.5 * (f[1] - 2.0 * f0[1] + older[4]),
        0.5 * (f[2] - 2.0 * f0[2] + older[5]),
    )
    return w0, w, f0, f, w_bend, f_bend


@njit(cache=True)
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

    Events lie at or after core.clock[0]. Between two samples the signals are taken as linear, so an event is met at its
    own time, not at a sample's.
    """
    e = first_event
    events = len(ev.t)
    for i in range(len(imu_t)):
        t = imu_t[i]
        w, f = _row(gyro, i), _row(accel, i)
        start = core.clock[1]
        whole = t - start
        # the sample before the last one serves where the spacing is even to a quarter
        core.clock[4] = int(core.clock[5] > 0 and 3 * whole <= 4 * core.clock[5] <= 5 * whole)
        interval = _interval(core, par, w, f)
        while core.clock[0] < t:
            stop = ev.t[e] if e < events and ev.t[e] < t else t
            now = core.clock[0]
            if stop > now:
                if whole > par.max_gap_ns:
                    _coast(core, par, (stop - now) * 1e-9)
                else:
                    _advance(core, interval, (now - start) / whole, (stop - start) / whole, (stop - now) * 1e-9)
                core.clock[0] = stop
            if stop == t:
                break
            rate = blend(interval[0], interval[1], (stop - start) / whole)
            bg: Vector = (core.nav[10], core.nav[11], core.nav[12])
            _handle(core, rec, par, m, ev, e, axpy(-1.0, bg, rate))
            e += 1
        _remember(core, t, w, f)
        while e < events and ev.t[e] <= t:
            bias: Vector = (core.nav[10], core.nav[11], core.nav[12])
            _handle(core, rec, par, m, ev, e, axpy(-1.0, bias, interval[1]))
            e += 1
    return e


@njit(cache=True)
def _remember(core: Core, t: int, w: Vector, f: Vector) -> None:
    """Keep a sample as the last one and in the ring."""
    core.clock[5] = t - core.clock[1]
    core.clock[1] = t
    k = core.clock[3] % RING_SIZE
    core.ring_t[k] = t
    core.last[1] = core.last[0]
    for j in range(3):
        core.last[0, j], core.last[0, 3 + j] = w[j], f[j]
        core.ring[k, j], core.ring[k, 3 + j] = w[j], f[j]
    core.clock[3] += 1


@njit(cache=True)
def _coast(core: Core, par: Parameters, dt: float) -> None:
    """Bridge a gap in the IMU at constant velocity and attitude, with the covariance widened."""
    propagate(core, par.noise)
    nav = core.nav
    meridian, transverse = radii(np.sin(nav[0]))
    nav[1] += nav[3] * dt / ((transverse + nav[2]) * np.cos(nav[0]))
    nav[0] += nav[4] * dt / (meridian + nav[2])
    nav[2] += nav[5] * dt
    coast(core, dt, par.coast_accel, par.coast_rate)
