"""Back from a wrong state: when GNSS positions and pose fixes are both rejected and agree, the state gives way.

A rejection alone proves nothing: a wrong fix and an alias of the map are as steady as the truth. Two independent
sensors that say the same place, while neither was accepted in between, outvote the state. Outvoted again soon, it
starts again.
"""

import math

from fusion._linalg import Quaternion, Vector, attitude, matvec, multiply
from fusion.events import Parameters
from fusion.gating import inject
from fusion.measurements import Pair, wrap
from fusion.mechanization import refresh
from fusion.state import (
    C_COUNT,
    D_AGREED,
    D_COUNT,
    D_GAVE,
    D_TIME,
    E_WHEEL_SCALE,
    ERROR_SIZE,
    RING_SIZE,
    Core,
    Floats,
)
from sensors.kernel import kernel

FRESH_NS = 500_000_000
"""Rejections of both sensors within this belong together."""
AGREEING = 2.3
"""Largest squared distance of what they say, in variances as the filter inflates them: a quarter of 99 %."""
FAR_SHARE, FAR_M = 0.1, 3.0
"""Innovations agree also where they differ by such a share of what they exceed FAR_M by: a state that is far off has a
wrong attitude as well, which moves the antenna against the camera, and runs away between the two, -, m."""
VAGUE_VAR = 0.3**2
"""Sensors that know less than this together agree by chance, m^2."""
VELOCITY_VAR = 1.0**2
"""Doubt of the velocity, (m/s)^2."""
ATTITUDE_VAR = 0.02**2
"""Doubt of the attitude, rad^2."""
TILT_PER_SPEED = 1.0 / 20.0
"""Velocity that is off by so much comes of such a tilt over the two seconds that a vote takes, rad per m/s."""
MOST_TILT_VAR = 0.5**2
"""But of no more than this, rad^2."""
WHEEL_SCALE_VAR = 0.02**2
"""Doubt of the wheel's scale."""
COURSE_SPEED, COURSE_NEAR = 3.0, 0.05
"""At this speed and more a vehicle's course is its yaw to within so much, m/s, rad."""
UPWARDS_RATE = 10.0
"""Rejections of a receiver come so often, roughly: how far the height runs away between two tells its speed, 1/s."""
AGAIN_NS = 10_000_000_000
"""A state that is outvoted again within this is not mended by a wider P: it starts again."""
START_VARS = (2.0**2, 2.0**2, 0.15**2, 0.05**2, 0.01**2, 0.3**2)
"""Then: position m^2, velocity (m/s)^2, tilt and yaw rad^2, gyro bias (rad/s)^2, accelerometer bias (m/s^2)^2."""


@kernel()
def believed(core: Core, which: int) -> None:
    """A position of sensor which (0 GNSS, 1 pose fix) was accepted."""
    core.doubt_clock[which, D_COUNT] = 0
    core.doubt_clock[0, D_AGREED] = 0


@kernel()
def in_doubt(core: Core, which: int, now: int) -> bool:
    """Whether the last position of sensor which was rejected, just now."""
    clock = core.doubt_clock
    fresh: bool = clock[which, D_COUNT] > 0 and now - clock[which, D_TIME] <= FRESH_NS
    return fresh


@kernel()
def doubted(core: Core, par: Parameters, which: int, z: Vector, ahead: Pair, now: int) -> None:
    """A position of sensor which was rejected: innovation z and core.R in axes whose first lies at ahead (cos, sin).

    After so many rejections in a row that agree with the other sensor's, P becomes wide enough for both.
    """
    c, s = ahead
    R, doubt, clock = core.R, core.doubt, core.doubt_clock
    mine, other = doubt[which], doubt[1 - which]
    climb = z[2] - mine[2] if which == 0 and clock[0, D_COUNT] > 0 else 0.0
    east, north = c * z[0] - s * z[1], s * z[0] + c * z[1]
    mine[6] = mine[7] = 0.0
    if clock[which, D_COUNT] > 0 and 0 < now - clock[which, D_TIME] <= FRESH_NS:
        dt = (now - clock[which, D_TIME]) * 1e-9
        mine[6], mine[7] = (east - mine[0]) / dt, (north - mine[1]) / dt
    mine[0], mine[1], mine[2] = east, north, z[2]
    mine[3] = c * c * R[0, 0] - 2.0 * c * s * R[0, 1] + s * s * R[1, 1]
    mine[4] = c * s * (R[0, 0] - R[1, 1]) + (c * c - s * s) * R[0, 1]
    mine[5] = s * s * R[0, 0] + 2.0 * c * s * R[0, 1] + c * c * R[1, 1]
    clock[which, D_COUNT] += 1
    clock[which, D_TIME] = now
    if clock[1 - which, D_COUNT] == 0 or now - clock[1 - which, D_TIME] > FRESH_NS:
        clock[0, D_AGREED] = 0
        if not (_fits_but_for_height(core, par, z) if which == 0 else _fits_but_for_yaw(core, par, z)):
            clock[which, D_COUNT] = max(clock[which, D_COUNT] - 2, 1)
        elif clock[which, D_COUNT] >= par.outvoted:
            if which == 0:
                _give_way_upwards(core.P, z[2], climb)
            else:
                _give_way_turning(core.P, z[2])
            clock[which, D_COUNT] = 0
        return
    age = (now - clock[1 - which, D_TIME]) * 1e-9
    east_apart, north_apart = _apart_by_yaw(core, par, doubt[1, 2])
    sign = 1.0 if which == 0 else -1.0
    east -= other[0] + age * other[6] + sign * east_apart
    north -= other[1] + age * other[7] + sign * north_apart
    ee, en, nn = mine[3] + other[3], mine[4] + other[4], mine[5] + other[5]
    sharp = ee + nn <= VAGUE_VAR
    far = FAR_SHARE * max(math.hypot(other[0], other[1]) - FAR_M, 0.0)
    ee += far * far
    nn += far * far
    distance = (nn * east * east - 2.0 * en * east * north + ee * north * north) / (ee * nn - en * en)
    agree = distance <= AGREEING and sharp
    clock[0, D_AGREED] = max(clock[0, D_AGREED] + (1 if agree else -2), 0)
    if clock[0, D_AGREED] >= par.outvoted:
        if now - clock[1, D_GAVE] <= AGAIN_NS:
            _start_again(core, par, now)
        else:
            _give_way(core.P, doubt)
        clock[1, D_GAVE] = now
        clock[0, D_COUNT] = clock[1, D_COUNT] = clock[0, D_AGREED] = 0


@kernel()
def _apart_by_yaw(core: Core, par: Parameters, yaw: float) -> Pair:
    """East and north by which the antenna's innovation exceeds the pose's where the state's yaw is wrong by so much."""
    a, b = par.gnss_arm, par.pose_arm
    arm = matvec(attitude(core.nav), (a[0] - b[0], a[1] - b[1], a[2] - b[2]))
    c, s = math.cos(yaw) - 1.0, math.sin(yaw)
    return c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]


@kernel()
def _fits_but_for_height(core: Core, par: Parameters, z: Vector) -> bool:
    """Whether a rejected GNSS position would pass the gate without its height: nothing else says anything of that."""
    P, R = core.P, core.R
    ee, en, nn = P[0, 0] + R[0, 0], P[0, 1] + R[0, 1], P[1, 1] + R[1, 1]
    distance = (nn * z[0] * z[0] - 2.0 * en * z[0] * z[1] + ee * z[1] * z[1]) / (ee * nn - en * en)
    fits: bool = distance <= par.gate[1]
    return fits


@kernel()
def _fits_but_for_yaw(core: Core, par: Parameters, z: Vector) -> bool:
    """Whether a rejected pose fix would pass the gate without its yaw, and the course of the state, which GNSS holds
    by then, is on its side: a map's alias turns nothing that moves."""
    nav, P, R = core.nav, core.P, core.R
    speed = math.hypot(nav[3], nav[4])
    r = attitude(nav)
    course = math.atan2(nav[4], nav[3]) - math.atan2(r[3], r[0])
    var = P[0, 0] + P[1, 1] + R[0, 0] + R[1, 1]
    fits = z[0] * z[0] + z[1] * z[1] <= par.gate[1] * var and speed >= COURSE_SPEED
    turned: bool = abs(wrap(course - z[2])) <= COURSE_NEAR and abs(wrap(course)) > COURSE_NEAR
    return fits and turned


@kernel()
def _give_way_turning(P: Floats, turn: float) -> None:
    """Widen the yaw by how far it is off, rad, the gyro's bias, which may have turned it while votes were counted, and
    the tilt, which went through the same turn."""
    P[8, 8] += turn * turn + ATTITUDE_VAR
    P[11, 11] += 0.25 * turn * turn
    P[6, 6] += ATTITUDE_VAR
    P[7, 7] += ATTITUDE_VAR


@kernel()
def _give_way_upwards(P: Floats, up: float, climb: float) -> None:
    """Widen the height by how far it is off, m, the rest by what may have caused it. climb: since the last, m."""
    P[2, 2] += up * up
    P[5, 5] += VELOCITY_VAR + (climb * UPWARDS_RATE) ** 2
    P[14, 14] += START_VARS[5]


@kernel()
def _give_way(P: Floats, doubt: Floats) -> None:
    """Widen P to what both sensors say: how far off the state is, and how fast it runs away."""
    place = doubt[1, 0] * doubt[1, 0] + doubt[1, 1] * doubt[1, 1]
    P[0, 0] += place
    P[1, 1] += place
    P[2, 2] += doubt[0, 2] * doubt[0, 2]
    run = doubt[0, 6] * doubt[0, 6] + doubt[0, 7] * doubt[0, 7]
    for i in range(3):
        P[3 + i, 3 + i] += VELOCITY_VAR + run
        P[6 + i, 6 + i] += ATTITUDE_VAR + min(run * TILT_PER_SPEED * TILT_PER_SPEED, MOST_TILT_VAR)
    P[E_WHEEL_SCALE, E_WHEEL_SCALE] += WHEEL_SCALE_VAR
    P[8, 8] += doubt[1, 2] * doubt[1, 2]


@kernel()
def _start_again(core: Core, par: Parameters, now: int) -> None:
    """A new state where both sensors say: levelled by the force since a second, yaw of the pose fix, no biases.

    The speed is the state's and that at which it runs away from them. Of P only the block behind the biases is kept
    (the wheel's scale), in doubt.
    """
    nav, P, dx, doubt = core.nav, core.P, core.dx, core.doubt
    r = attitude(nav)
    yaw = math.atan2(r[3], r[0]) + doubt[1, 2]
    for i in range(ERROR_SIZE):
        dx[i] = 0.0
        for j in range(P.shape[1]):
            if i < E_WHEEL_SCALE or j < E_WHEEL_SCALE:
                P[i, j] = 0.0
    dx[0], dx[1], dx[2] = doubt[0, 0], doubt[0, 1], doubt[0, 2]
    dx[3], dx[4], dx[5] = doubt[0, 6], doubt[0, 7], -nav[5]
    inject(nav, core.earth, dx)
    refresh(nav, core.earth)
    nav[6], nav[7], nav[8], nav[9] = _levelled(_mean_force(core, par.still_window_ns, now), yaw)
    for i in range(10, 16):
        nav[i] = 0.0
    for i in range(3):
        P[i, i], P[3 + i, 3 + i], P[6 + i, 6 + i] = START_VARS[0], START_VARS[1], START_VARS[2]
        P[9 + i, 9 + i], P[12 + i, 12 + i] = START_VARS[4], START_VARS[5]
    P[8, 8] = START_VARS[3]
    P[E_WHEEL_SCALE, E_WHEEL_SCALE] += WHEEL_SCALE_VAR


@kernel()
def _mean_force(core: Core, window_ns: int, now: int) -> Vector:
    """Of the IMU samples of a window before now, body axes, m/s^2."""
    x, y, z = 0.0, 0.0, 0.0
    count = core.clock[C_COUNT]
    for back in range(min(count, RING_SIZE)):
        i = (count - 1 - back) % RING_SIZE
        if back > 0 and core.ring_t[i] <= now - window_ns:
            break
        x, y, z = x + core.ring[i, 3], y + core.ring[i, 4], z + core.ring[i, 5]
    return x, y, z


@kernel()
def _levelled(force: Vector, yaw: float) -> Quaternion:
    """q_enu_body with the force upwards and a yaw from east."""
    x, y, z = force
    roll, pitch = math.atan2(y, z), math.atan2(-x, math.hypot(y, z))
    about_x: Quaternion = (math.sin(0.5 * roll), 0.0, 0.0, math.cos(0.5 * roll))
    about_y: Quaternion = (0.0, math.sin(0.5 * pitch), 0.0, math.cos(0.5 * pitch))
    about_z: Quaternion = (0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))
    q: Quaternion = multiply(multiply(about_z, about_y), about_x)
    return q
