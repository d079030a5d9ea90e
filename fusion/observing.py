"""What a sensor shows: residual, Jacobian and covariance of its measurement, with what the error states add to them."""

import math

from fusion._linalg import Matrix, Vector, attitude, cross, matvec
from fusion.blocks import allow_delay, arm_of, fade, lasting, renew, scale, see_arm, see_delay
from fusion.events import Measurements, Parameters
from fusion.measurements import Pair, gnss_position, gnss_velocity, heading, pose_fix, wheel_speed, wrap, yaw_row
from fusion.modes import observe
from fusion.motion import clear
from fusion.result import Reason, Sensor
from fusion.state import C_COUNT, C_SAMPLE, RING_SIZE, ROW, Core, Floats
from sensors.kernel import kernel

_GNSS_POSITION = int(Sensor.GNSS_POSITION)
_GNSS_VELOCITY = int(Sensor.GNSS_VELOCITY)
_GNSS_YAW = int(Sensor.GNSS_YAW)
_POSE_FIX = int(Sensor.POSE_FIX)
_ACCEPTED = int(Reason.ACCEPTED)
NORMAL_GRAVITY = 9.81
"""Near enough for the acceleration over a delay, m/s^2."""
SMOOTHED_NS = 200_000_000
"""Over so long it is averaged."""


@kernel()
def measure(
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
        z = gnss_position(nav, r, H, triple(m.gnss_llh, row), arm)
    elif kind == _GNSS_VELOCITY:
        _copy(m.vel_cov, row, R)
        z = gnss_velocity(nav, r, H, triple(m.vel, row), arm, rate)
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
    see_arm(H, layout, r, rate, of_velocity, par.level)
    if layout.gnss_delay >= 0:
        push = acceleration(core, r)
        if of_velocity:
            allow_delay(core, layout.gnss_delay, push)
        else:
            swing = matvec(r, cross(rate, arm_of(nav, layout, par.gnss_arm)))
            change: Vector = (nav[3] + swing[0], nav[4] + swing[1], nav[5] + swing[2])
            see_delay(nav, H, core.residual, layout.gnss_delay, change, push)
    if layout.gnss_error < 0 or of_velocity:
        return
    if lasts:
        stated = core.R[0, 0] + core.R[1, 1]
        if 0.25 * core.aged[2] <= stated <= 4.0 * core.aged[2]:
            fade(core, layout.gnss_error, math.exp(-par.gnss_rate * core.aged[0]))
        else:  # another kind of solution, with errors of its own
            renew(core, layout.gnss_error)
        core.aged[0], core.aged[2] = 0.0, stated
        lasting(nav, H, core.R, core.residual, core.L, layout.gnss_error, par.gnss_shares[1])
    scale(core.R, par.gnss_shares[0] + (0.0 if lasts else par.gnss_shares[1]))


@kernel(inline="always")
def _measure_pose(core: Core, par: Parameters, m: Measurements, row: int, rate: Vector, lasts: bool) -> tuple[int, int]:
    """Pose fix in vehicle axes; directions that it does not observe are dropped (``fusion.modes``).

    rate: body, rad/s.
    """
    R, nav, cov = core.R, core.nav, m.pose_cov
    r = attitude(nav)
    c, s = heading(r)
    tilt = (m.pose_tilt[row, 0], m.pose_tilt[row, 1])
    z = pose_fix(r, core.H, nav, triple(m.pose_llh, row), m.pose_yaw[row], tilt, par.pose_arm, (c, s))
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
    a, b, turn = triple(m.pose_spread, row)
    _see_matching(core, par, (c, s), rate, lasts)
    grown = 1.0
    if par.layout.pose_error >= 0:  # R has been scaled
        grown = math.sqrt(par.pose_shares[0] + (0.0 if lasts else par.pose_shares[1]))
    limits = (grown * par.pose_limits[0], grown * par.pose_limits[1], grown * par.pose_limits[2])
    spread = (grown * (c * a + s * b), grown * (c * b - s * a), grown * turn)
    observed: tuple[int, int] = observe(core, limits, par.pose_partial, spread)
    return observed


@kernel(inline="always")
def _see_matching(core: Core, par: Parameters, ahead: Pair, rate: Vector, lasts: bool) -> None:
    """What the blocks add to a pose fix (along, left, yaw)."""
    nav, H, residual, layout = core.nav, core.H, core.residual, par.layout
    c, s = ahead
    if layout.pose_delay >= 0:
        r = attitude(nav)
        swing, push = matvec(r, cross(rate, par.pose_arm)), acceleration(core, r)
        east, north = nav[3] + swing[0], nav[4] + swing[1]
        change: Vector = (c * east + s * north, c * north - s * east, r[8] * rate[2])
        bend: Vector = (c * push[0] + s * push[1], c * push[1] - s * push[0], 0.0)
        see_delay(nav, H, residual, layout.pose_delay, change, bend)
    if layout.pose_yaw >= 0:
        H[2, layout.pose_yaw] = 1.0
        residual[2] -= nav[layout.pose_yaw + 1]
    if layout.pose_error < 0:
        return
    if lasts:
        fade(core, layout.pose_error, math.exp(-par.pose_per_m * core.aged[1]))
        core.aged[1] = 0.0
        lasting(nav, H, core.R, residual, core.L, layout.pose_error, par.pose_shares[1])
    scale(core.R, par.pose_shares[0] + (0.0 if lasts else par.pose_shares[1]))


@kernel()
def acceleration(core: Core, r: Matrix) -> Vector:
    """Mean over the last samples, ENU m/s^2: one alone says more of the engine."""
    nav, count = core.nav, core.clock[C_COUNT]
    newest = core.clock[C_SAMPLE]
    x, y, z, n = 0.0, 0.0, 0.0, 0
    for back in range(min(count, RING_SIZE)):
        i = (count - 1 - back) & (len(core.ring_t) - 1)
        if core.ring_t[i] < newest - SMOOTHED_NS:
            break
        x += core.ring[i, 3]
        y += core.ring[i, 4]
        z += core.ring[i, 5]
        n += 1
    if n == 0:
        return 0.0, 0.0, 0.0
    f: Vector = (x / n - nav[13], y / n - nav[14], z / n - nav[15])
    a = matvec(r, f)
    return a[0], a[1], a[2] - NORMAL_GRAVITY


@kernel()
def triple(a: Floats, row: int) -> Vector:
    return a[row, 0], a[row, 1], a[row, 2]


@kernel()
def _copy(cov: Floats, row: int, R: Floats) -> None:
    for i in range(3):
        for j in range(3):
            R[i, j] = cov[row, i, j]
