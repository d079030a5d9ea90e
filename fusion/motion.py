"""What a land vehicle cannot do: slip sideways, or move while it stands."""

import numpy as np

from fusion._linalg import Vector, attitude, matvec, matvec_t
from fusion.events import Parameters
from fusion.gating import correct, innovate, whiten
from fusion.health import in_question
from fusion.measurements import body_velocity
from fusion.result import Sensor
from fusion.state import C_COUNT, C_TICK, E_WHEEL_SCALE, H_START, RING_SIZE, Core, Floats, Nanoseconds
from fusion.tape import note_correction
from sensors._kernels import EARTH_RATE
from sensors.kernel import kernel

_ZERO_VELOCITY = int(Sensor.ZERO_VELOCITY)
_NON_HOLONOMIC = int(Sensor.NON_HOLONOMIC)
_AXES = np.int64(3)
"""Not a literal, for which numba would compile the update a second time."""

QUIETEST_FORCE = 0.003
"""No IMU rests quieter than this (a stuck one does), m/s^2."""
QUIETEST_TURN = 1e-4
"""The same for the yaw rate, rad/s."""
PLACED = 0.3
"""Residuals of the non-holonomic update are learned from while the place is known so well, m: by GNSS or a map."""
REMEMBERED = 60.0
"""So many blocks of residuals are looked back on."""
JUMPED_VAR = 0.001**2
"""Doubt of a gyro's bias at every tick at rest that does not fit it, (rad/s)^2."""
PRIOR_BLOCKS = 3.0
"""What is thought of the rear axle at first counts as so many blocks."""


@kernel()
def clear(a: Floats) -> None:
    """Set a matrix to zero (a plain loop: cheaper here than a slice)."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            a[i, j] = 0.0


@kernel()
def shaking(
    ring: Floats, ring_t: Nanoseconds, clock: Nanoseconds, nav: Floats, recent: Floats, window_ns: int, now: int
) -> tuple[bool, float, float, float, Vector]:
    """Whether samples fill the window before now; variances of |specific force| (m/s^2)^2 and yaw rate (rad/s)^2; by
    how much the horizontal force of its last quarter differs from that of the rest, squared; and that last force.

    A smooth start changes the norm by next to nothing: gravity hides it. recent (3,): becomes the mean rate since the
    last motion tick, rad/s.
    """
    count = clock[C_COUNT]
    recent[0] = recent[1] = recent[2] = 0.0
    norm, norm2, turn, turn2 = 0.0, 0.0, 0.0, 0.0
    ahead, left, up, late_ahead, late_left, late_up = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    n, fresh, late = 0, 0, 0
    oldest, quarter = now, now - window_ns // 4
    for back in range(min(count, RING_SIZE)):
        i = (count - 1 - back) & (len(ring_t) - 1)
        t = ring_t[i]
        if t <= now - window_ns:
            break
        oldest = t
        n += 1
        rate = ring[i, 2] - nav[12]
        turn += rate
        turn2 += rate * rate
        if t > clock[C_TICK]:
            fresh += 1
            for k in range(3):
                recent[k] += ring[i, k]
        f2 = ring[i, 3] ** 2 + ring[i, 4] ** 2 + ring[i, 5] ** 2
        norm += np.sqrt(f2)
        norm2 += f2
        ahead += ring[i, 3]
        left += ring[i, 4]
        up += ring[i, 5]
        if t > quarter:
            late, late_ahead, late_left, late_up = n, ahead, left, up
    if n < 5 or fresh == 0 or late in (0, n) or now - oldest < 0.8 * window_ns:
        return False, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0)
    for k in range(3):
        recent[k] /= fresh
    early = n - late
    force: Vector = (late_ahead / late, late_left / late, late_up / late)
    drift = (force[0] - (ahead - late_ahead) / early) ** 2 + (force[1] - (left - late_left) / early) ** 2
    return True, norm2 / n - (norm / n) ** 2, turn2 / n - (turn / n) ** 2, drift, force


@kernel()
def still(quietest: Floats, par: Parameters, force_var: float, turn_var: float) -> bool:
    """Whether a window is as quiet as rest: below the limits and not much above the quietest so far (2,).

    A car in a queue creeps as smoothly as another one idles; only its own rest tells.
    """
    quietest[0] = max(min(quietest[0], force_var), QUIETEST_FORCE**2)
    quietest[1] = max(min(quietest[1], turn_var), QUIETEST_TURN**2)
    ratio = par.still_ratio * par.still_ratio
    if turn_var >= min(par.still_rate_var, ratio * quietest[1]):
        return False
    return bool(force_var < min(par.still_accel_var, ratio * quietest[0]))


@kernel()
def unaccelerated(core: Core, par: Parameters, force: Vector) -> bool:
    """Whether a specific force (body, m/s^2) is gravity's alone, as far as tilt and accelerometer bias are known.

    Even braking is as quiet as rest. The acceleration's error is -[f]x dtheta - R dba with f nearly upright.
    """
    nav, P = core.nav, core.P
    r = attitude(nav)
    east, north, up = matvec(r, (force[0] - nav[13], force[1] - nav[14], force[2] - nav[15]))
    pulled, variance = 0.0, 0.0
    for row, tilted, seen in ((0, 7, east), (1, 6, north)):
        sign = up if row == 0 else -up
        pulled += seen * seen
        variance += up * up * P[tilted, tilted]
        for j in range(3):
            a = r[3 * row + j]
            variance -= 2.0 * sign * a * P[tilted, 12 + j]
            for k in range(3):
                variance += a * r[3 * row + k] * P[12 + j, 12 + k]
    return bool(np.sqrt(pulled) < np.sqrt(par.still_drift_var) + 3.0 * np.sqrt(max(variance, 0.0)))


@kernel()
def learn(slipped: Floats, residual: Floats, ticks: int, placed: bool) -> None:
    """Take a lateral and a vertical residual, m/s, into slipped (3, 2) while the place is known from elsewhere.

    Rows: sums of the block of ticks that is going on; sums of squared means of blocks, the latest REMEMBERED of them;
    ticks in the block, blocks. What is white averages out over a block; slip in curves, bumps and a mounting that is
    off do not.
    """
    if not placed:
        slipped[0, 0] = slipped[0, 1] = slipped[2, 0] = 0.0
        return
    slipped[0, 0] += residual[0]
    slipped[0, 1] += residual[1]
    slipped[2, 0] += 1.0
    if slipped[2, 0] < ticks:
        return
    full = slipped[2, 1] >= REMEMBERED
    for k in range(2):
        if full:
            slipped[1, k] *= 1.0 - 1.0 / REMEMBERED
        slipped[1, k] += (slipped[0, k] / ticks) ** 2
        slipped[0, k] = 0.0
    slipped[2, 0] = 0.0
    slipped[2, 1] = min(slipped[2, 1] + 1.0, REMEMBERED)


@kernel()
def learned(slipped: Floats, k: int, par: Parameters) -> float:
    """Variance of one update that makes those of a block say as much as their mean does: ticks times its square."""
    prior = PRIOR_BLOCKS * par.unknown_var
    return float((prior + slipped[1, k] * par.learning_ticks) / (PRIOR_BLOCKS + slipped[2, 1]))


@kernel(inline="always")
def motion(core: Core, par: Parameters, now: int, rate: Vector) -> tuple[int, int]:
    """Residual, H and R of what the motion allows: sensor and degrees of freedom, 0 for nothing.

    Zero velocity at rest (with the gyro's bias from its mean rate); else no lateral and vertical velocity of the rear
    axle.
    """
    nav, P, R, residual = core.nav, core.P, core.R, core.residual
    speed = np.sqrt(nav[3] ** 2 + nav[4] ** 2 + nav[5] ** 2)
    quiet = False
    # right after a start the speed is known so badly that a steady creep would pass for rest
    settled = now - core.health[H_START] >= par.still_wait_ns
    if par.zero_velocity and settled and speed < par.still_max_speed + 3.0 * np.sqrt(P[3, 3] + P[4, 4]):
        full, norm, turning, drift, force = shaking(
            core.ring, core.ring_t, core.clock, nav, residual, par.still_window_ns, now
        )
        quiet = full and still(core.quietest, par, norm, turning) and drift < par.still_drift_var
        quiet = quiet and unaccelerated(core, par, force)
        if quiet:
            _zero_rate(core, par, (residual[0], residual[1], residual[2]), now)
    core.clock[C_TICK] = now
    clear(R)
    clear(core.H)
    if quiet:
        for i in range(3):
            core.H[i, 3 + i] = 1.0
            R[i, i] = par.zero_velocity_var
            residual[i] = -nav[3 + i]
        return _ZERO_VELOCITY, 3
    if not par.non_holonomic or speed < par.min_speed:
        return _NON_HOLONOMIC, 0
    velocity = body_velocity(nav, attitude(nav), core.H, par.axle, rate)
    ahead, left, up = velocity
    pitch, turn, k = 0.0, 0.0, par.layout.mounting
    if k >= 0:
        pitch, turn = nav[k + 1], nav[k + 2]
    for j in range(E_WHEEL_SCALE):  # lateral and vertical rows first
        h = core.H[0, j]
        core.H[0, j], core.H[1, j], core.H[2, j] = core.H[1, j] - turn * h, core.H[2, j] + pitch * h, 0.0
    if k >= 0:
        core.H[0, k + 1], core.H[1, k] = -ahead, ahead
    residual[0], residual[1] = turn * ahead - left, -pitch * ahead - up
    extra = (par.per_speed * speed) ** 2
    R[0, 0], R[1, 1] = par.lateral_var + extra, par.vertical_var + extra
    if par.learning_ticks > 0:
        learn(core.slipped, residual, par.learning_ticks, P[0, 0] + P[1, 1] < PLACED**2)
        for i in range(2):
            R[i, i] = max(R[i, i], learned(core.slipped, i, par))
    return _NON_HOLONOMIC, 2


@kernel(inline="always")
def _zero_rate(core: Core, par: Parameters, mean: Vector, now: int) -> None:
    """At rest the gyro shows its bias and the earth's turning: mean = bg + R' omega_ie. Gated, but not recorded.

    What fails the gate is a creep along a bend; but where positions contradict the state, or did of late, its bias.
    """
    nav, R, residual = core.nav, core.R, core.residual
    earth = matvec_t(attitude(nav), (0.0, EARTH_RATE * np.cos(nav[0]), EARTH_RATE * np.sin(nav[0])))
    clear(R)
    clear(core.H)
    for i in range(3):
        core.H[i, 9 + i] = 1.0
        R[i, i] = par.zero_rate_var
        residual[i] = mean[i] - earth[i] - nav[10 + i]
    if innovate(core.P, core.H, core.W, _AXES, R, core.L) and whiten(_AXES, residual, core.L) <= par.gate[2]:
        correct(nav, core.earth, core.P, core.W, core.dx, residual, _AXES)
        if len(core.tape):
            note_correction(core, _AXES)
    elif in_question(core.health, par.health.settled_ns, now):
        for i in range(3):
            core.P[9 + i, 9 + i] += JUMPED_VAR
