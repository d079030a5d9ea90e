"""What a land vehicle cannot do: slip sideways, or move while it stands."""

import numpy as np

from fusion._linalg import Vector, attitude, matvec_t
from fusion.events import Parameters
from fusion.gating import correct, innovate, whiten
from fusion.measurements import body_velocity
from fusion.result import Sensor
from fusion.state import C_COUNT, C_TICK, E_WHEEL_SCALE, RING_SIZE, Core, Floats, Nanoseconds
from fusion.tape import note_correction
from sensors._kernels import EARTH_RATE
from sensors.kernel import kernel

_ZERO_VELOCITY = int(Sensor.ZERO_VELOCITY)
_NON_HOLONOMIC = int(Sensor.NON_HOLONOMIC)

QUIETEST_FORCE = 0.003
"""No IMU rests quieter than this (a stuck one does), m/s^2."""
QUIETEST_TURN = 1e-4
"""The same for the yaw rate, rad/s."""


@kernel()
def clear(a: Floats) -> None:
    """Set a matrix to zero (a plain loop: cheaper here than a slice)."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            a[i, j] = 0.0


@kernel()
def shaking(
    ring: Floats, ring_t: Nanoseconds, clock: Nanoseconds, nav: Floats, recent: Floats, window_ns: int, now: int
) -> tuple[bool, float, float]:
    """Whether samples fill the window before now; variances of |specific force| (m/s^2)^2 and yaw rate (rad/s)^2.

    recent (3,): becomes the mean rate since the last motion tick, rad/s.
    """
    count = clock[C_COUNT]
    recent[0] = recent[1] = recent[2] = 0.0
    norm, norm2, turn, turn2 = 0.0, 0.0, 0.0, 0.0
    n, fresh = 0, 0
    oldest = now
    for back in range(min(count, RING_SIZE)):
        i = (count - 1 - back) % RING_SIZE
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
    if n < 5 or fresh == 0 or now - oldest < 0.8 * window_ns:
        return False, 0.0, 0.0
    for k in range(3):
        recent[k] /= fresh
    return True, norm2 / n - (norm / n) ** 2, turn2 / n - (turn / n) ** 2


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


@kernel(inline="always")
def motion(core: Core, par: Parameters, now: int, rate: Vector) -> tuple[int, int]:
    """Residual, H and R of what the motion allows: sensor and degrees of freedom, 0 for nothing.

    Zero velocity at rest (with the gyro's bias from its mean rate); else no lateral and vertical velocity of the rear
    axle.
    """
    nav, P, R, residual = core.nav, core.P, core.R, core.residual
    speed = np.sqrt(nav[3] ** 2 + nav[4] ** 2 + nav[5] ** 2)
    quiet = False
    if par.zero_velocity and speed < par.still_max_speed + 3.0 * np.sqrt(P[3, 3] + P[4, 4]):
        full, force, turn = shaking(core.ring, core.ring_t, core.clock, nav, residual, par.still_window_ns, now)
        quiet = full and still(core.quietest, par, force, turn)
        if quiet:
            _zero_rate(core, par, (residual[0], residual[1], residual[2]))
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
    for j in range(E_WHEEL_SCALE):  # lateral and vertical rows first
        core.H[0, j], core.H[1, j], core.H[2, j] = core.H[1, j], core.H[2, j], 0.0
    extra = (par.per_speed * speed) ** 2
    R[0, 0], R[1, 1] = par.lateral_var + extra, par.vertical_var + extra
    residual[0], residual[1] = -velocity[1], -velocity[2]
    return _NON_HOLONOMIC, 2


@kernel(inline="always")
def _zero_rate(core: Core, par: Parameters, mean: Vector) -> None:
    """At rest the gyro shows its bias and the earth's turning: mean = bg + R' omega_ie. Gated, but not recorded."""
    nav, R, residual = core.nav, core.R, core.residual
    earth = matvec_t(attitude(nav), (0.0, EARTH_RATE * np.cos(nav[0]), EARTH_RATE * np.sin(nav[0])))
    clear(R)
    clear(core.H)
    for i in range(3):
        core.H[i, 9 + i] = 1.0
        R[i, i] = par.zero_rate_var
        residual[i] = mean[i] - earth[i] - nav[10 + i]
    if innovate(core.P, core.H, core.W, 3, R, core.L) and whiten(3, residual, core.L) <= par.gate[2]:
        correct(nav, core.earth, core.P, core.W, core.dx, residual, 3)
        if len(core.tape):
            note_correction(core.tape, core.tape_end, (core.H, core.L, core.W), residual, core.dx, 3)
