"""How a state that must be wrong gives way: P widens to what contradicts it, or the state starts again."""

import math

from fusion._linalg import Quaternion, Vector, attitude, multiply
from fusion.blocks import renew
from fusion.events import Parameters
from fusion.gating import inject
from fusion.mechanization import refresh
from fusion.state import C_COUNT, E_WHEEL_SCALE, Core, Floats
from fusion.tape import note_fade
from sensors.kernel import kernel

VELOCITY_VAR = 1.0**2
"""Doubt of the velocity, (m/s)^2."""
ATTITUDE_VAR = 0.02**2
"""Doubt of the attitude, rad^2."""
TILT_PER_SPEED = 1.0 / 20.0
"""Velocity that is off by so much comes of such a tilt over the two seconds that a vote takes, rad per m/s."""
MOST_TILT_VAR = 0.5**2
"""But of no more than this, rad^2."""
ALONE_DOUBLING_S = 4.0
"""GNSS alone, rejected all the time: the state's sigmas double in this time."""
GYRO_BIAS_VAR = 0.0005**2
"""Doubt of the gyro's bias, (rad/s)^2."""
ACCEL_BIAS_VAR = 0.05**2
"""Doubt of the accelerometer's bias, (m/s^2)^2."""
WHEEL_SCALE_VAR = 0.02**2
"""Doubt of the wheel's scale."""
UPWARDS_RATE = 10.0
"""Rejections of a receiver come so often, roughly: how far the height runs away between two tells its speed, 1/s."""
START_VARS = (2.0**2, 2.0**2, 0.15**2, 0.05**2, 0.01**2, 0.3**2)
"""Of a state that starts again: position m^2, velocity (m/s)^2, tilt and yaw rad^2, gyro bias (rad/s)^2,
accelerometer bias (m/s^2)^2."""


@kernel()
def forget(P: Floats, seconds: float) -> None:
    """Widen position, velocity and attitude for the time that GNSS alone has contradicted them."""
    grown = 4.0 ** (seconds / ALONE_DOUBLING_S)
    for i in range(9):
        for j in range(9):
            P[i, j] *= grown


@kernel()
def doubt_all(P: Floats) -> None:
    """Widen what a wrong state has been taken in by: tilt, biases, the wheel's scale."""
    for i in range(3):
        P[6 + i, 6 + i] += ATTITUDE_VAR
        P[9 + i, 9 + i] += GYRO_BIAS_VAR
        P[12 + i, 12 + i] += ACCEL_BIAS_VAR
    P[E_WHEEL_SCALE, E_WHEEL_SCALE] += WHEEL_SCALE_VAR


@kernel()
def give_way(P: Floats, doubt: Floats) -> None:
    """Widen P to what both sensors say: how far off the state is, and how fast it runs away."""
    place = doubt[1, 0] * doubt[1, 0] + doubt[1, 1] * doubt[1, 1]
    P[0, 0] += place
    P[1, 1] += place
    P[2, 2] += doubt[0, 2] * doubt[0, 2]
    run = doubt[0, 6] * doubt[0, 6] + doubt[0, 7] * doubt[0, 7]
    for i in range(3):
        P[3 + i, 3 + i] += VELOCITY_VAR + run
        P[6 + i, 6 + i] += min(run * TILT_PER_SPEED * TILT_PER_SPEED, MOST_TILT_VAR)
    doubt_all(P)
    P[8, 8] += doubt[1, 2] * doubt[1, 2]


@kernel()
def give_way_turning(P: Floats, turn: float) -> None:
    """Widen the yaw by how far it is off, rad, the gyro's bias, which may have turned it while votes were counted, and
    the tilt, which went through the same turn."""
    P[8, 8] += turn * turn + ATTITUDE_VAR
    P[11, 11] += 0.25 * turn * turn
    P[6, 6] += ATTITUDE_VAR
    P[7, 7] += ATTITUDE_VAR


@kernel()
def give_way_upwards(P: Floats, up: float, climb: float) -> None:
    """Widen the height by how far it is off, m, the rest by what may have caused it. climb: since the last, m."""
    P[2, 2] += up * up
    P[5, 5] += VELOCITY_VAR + (climb * UPWARDS_RATE) ** 2
    P[14, 14] += START_VARS[5]


@kernel()
def start_again(core: Core, par: Parameters, now: int) -> None:
    """A new state where both sensors say: levelled by the force since a second, yaw of the pose fix, no biases.

    The speed is the state's and that at which it runs away from them. Of P only what stands behind the biases is kept,
    the wheel's scale in doubt; errors that last are not known any more.
    """
    nav, P, dx, doubt = core.nav, core.P, core.dx, core.doubt
    r = attitude(nav)
    yaw = math.atan2(r[3], r[0]) + doubt[1, 2]
    for i in range(len(dx)):
        dx[i] = 0.0
        for j in range(len(dx)):
            if i < E_WHEEL_SCALE or j < E_WHEEL_SCALE:
                P[i, j] = 0.0
    if len(core.tape):
        note_fade(core, 0, E_WHEEL_SCALE, 0.0)
    dx[0], dx[1], dx[2] = doubt[0, 0], doubt[0, 1], doubt[0, 2]
    dx[3], dx[4], dx[5] = doubt[0, 6], doubt[0, 7], -nav[5]
    inject(nav, core.earth, dx)
    refresh(nav, core.earth)
    nav[6], nav[7], nav[8], nav[9] = levelled(_mean_force(core, par.still_window_ns, now), yaw)
    for i in range(10, 16):
        nav[i] = 0.0
    for i in range(3):
        P[i, i], P[3 + i, 3 + i], P[6 + i, 6 + i] = START_VARS[0], START_VARS[1], START_VARS[2]
        P[9 + i, 9 + i], P[12 + i, 12 + i] = START_VARS[4], START_VARS[5]
    P[8, 8] = START_VARS[3]
    P[E_WHEEL_SCALE, E_WHEEL_SCALE] += WHEEL_SCALE_VAR
    for first in (par.layout.gnss_error, par.layout.pose_error):
        if first >= 0:
            renew(core, first)


@kernel()
def _mean_force(core: Core, window_ns: int, now: int) -> Vector:
    """Of the IMU samples of a window before now, body axes, m/s^2."""
    x, y, z = 0.0, 0.0, 0.0
    count, size = core.clock[C_COUNT], len(core.ring_t)
    for back in range(min(count, size)):
        i = (count - 1 - back) & (size - 1)  # a power of two
        if back > 0 and core.ring_t[i] <= now - window_ns:
            break
        x, y, z = x + core.ring[i, 3], y + core.ring[i, 4], z + core.ring[i, 5]
    return x, y, z


@kernel()
def levelled(force: Vector, yaw: float) -> Quaternion:
    """q_enu_body with the force upwards and a yaw from east."""
    x, y, z = force
    roll, pitch = math.atan2(y, z), math.atan2(-x, math.hypot(y, z))
    about_x: Quaternion = (math.sin(0.5 * roll), 0.0, 0.0, math.cos(0.5 * roll))
    about_y: Quaternion = (0.0, math.sin(0.5 * pitch), 0.0, math.cos(0.5 * pitch))
    about_z: Quaternion = (0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))
    q: Quaternion = multiply(multiply(about_z, about_y), about_x)
    return q
