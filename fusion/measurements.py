"""Measurement models: residual and Jacobian of each sensor, written into H (3, 16); residuals are returned.

Each function gives measured minus predicted (three numbers) and fills the rows of H that it uses; columns that a sensor
does not see stay zero. Attitude error is on the left in ENU, so ``d(R l) = -[R l]x dtheta``; a gyro bias error lowers
the true rate, so ``d(omega) = -dbg``.
"""

import math

from fusion._linalg import Matrix, Vector, cross, matvec, matvec_t
from fusion.state import E_WHEEL_SCALE, WHEEL_SCALE, Floats
from sensors._kernels import EARTH_RATE, radii
from sensors.kernel import kernel

Pair = tuple[float, float]


@kernel()
def _minus_skew(H: Floats, row: int, column: int, v: Vector) -> None:
    """Write -[v]x at (row, column)."""
    H[row, column + 1], H[row, column + 2] = v[2], -v[1]
    H[row + 1, column], H[row + 1, column + 2] = -v[2], v[0]
    H[row + 2, column], H[row + 2, column + 1] = v[1], -v[0]


@kernel()
def offset_enu(nav: Floats, lat: float, lon: float, height: float) -> Vector:
    """The state's position seen from a point nearby, ENU m (to first order, as the error state is).

    Metres are those at the state's height: a map's ground may lie hundreds of metres below it.
    """
    meridian, transverse = radii(math.sin(lat))
    return (
        (nav[1] - lon) * (transverse + nav[2]) * math.cos(lat),
        (nav[0] - lat) * (meridian + nav[2]),
        nav[2] - height,
    )


@kernel()
def gnss_position(nav: Floats, r: Matrix, H: Floats, llh: Vector, arm: Vector) -> Vector:
    """Antenna position llh (3,): ENU m. H = [I 0 -[R l]x]."""
    lever = matvec(r, arm)
    east, north, up = offset_enu(nav, llh[0], llh[1], llh[2])
    for i in range(3):
        H[i, i] = 1.0
    _minus_skew(H, 0, 6, lever)
    return -east - lever[0], -north - lever[1], -up - lever[2]


@kernel()
def gnss_velocity(nav: Floats, r: Matrix, H: Floats, vel: Vector, arm: Vector, rate: Vector) -> Vector:
    """Antenna velocity vel (3,) ENU m/s; rate: bias-free body rate against inertial space.

    v + R (omega x l) - omega_ie x R l; H = [0 I -[R (omega x l)]x R [l]x].
    """
    swing = matvec(r, cross(rate, arm))
    lever = matvec(r, arm)
    earth: Vector = (0.0, EARTH_RATE * math.cos(nav[0]), EARTH_RATE * math.sin(nav[0]))
    turned = cross(earth, lever)
    for i in range(3):
        H[i, 3 + i] = 1.0
        row: Vector = (r[3 * i], r[3 * i + 1], r[3 * i + 2])
        H[i, 9], H[i, 10], H[i, 11] = cross(row, arm)  # row' [l]x = (row x l)'
    _minus_skew(H, 0, 6, swing)
    return (
        vel[0] - nav[3] - swing[0] + turned[0],
        vel[1] - nav[4] - swing[1] + turned[1],
        vel[2] - nav[5] - swing[2] + turned[2],
    )


@kernel()
def yaw_row(r: Matrix, H: Floats, row: int) -> float:
    """Yaw of the body (ccw from east) and its Jacobian against the attitude error."""
    horizontal = r[0] * r[0] + r[3] * r[3]
    H[row, 6] = -r[6] * r[0] / horizontal
    H[row, 7] = -r[6] * r[3] / horizontal
    H[row, 8] = 1.0
    return math.atan2(r[3], r[0])


@kernel()
def heading(r: Matrix) -> Pair:
    """Cosine and sine of the body's yaw."""
    length = math.sqrt(r[0] * r[0] + r[3] * r[3])
    return r[0] / length, r[3] / length


@kernel()
def wrap(angle: float) -> float:
    """Angle in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@kernel()
def pose_fix(
    r: Matrix, H: Floats, nav: Floats, llh: Vector, yaw: float, tilt: Pair, arm: Vector, ahead: Pair
) -> Vector:
    """EgoVM's (x, y, yaw), along and left of the direction ahead (cos, sin) and yaw: m, m, rad.

    llh (3,): the fix on the map's ground surface; tilt (2,): horizontal metres per metre of height between the local
    vertical and the map's, so that height does not leak into x and y.
    """
    lever = matvec(r, arm)
    point = offset_enu(nav, llh[0], llh[1], llh[2])
    east, north, up = point[0] + lever[0], point[1] + lever[1], point[2] + lever[2]
    east += tilt[0] * up
    north += tilt[1] * up
    c, s = ahead
    for row, (a, b) in ((0, (c, s)), (1, (-s, c))):
        direction: Vector = (a, b, a * tilt[0] + b * tilt[1])
        H[row, 0], H[row, 1], H[row, 2] = direction
        H[row, 6], H[row, 7], H[row, 8] = cross(lever, direction)  # -d' [l]x = (l x d)'
    predicted = yaw_row(r, H, 2)
    return -(c * east + s * north), s * east - c * north, wrap(yaw - predicted)


@kernel()
def body_velocity(nav: Floats, r: Matrix, H: Floats, arm: Vector, rate: Vector) -> Vector:
    """Velocity of a body point (the rear axle) in body axes, m/s, with its Jacobian: R'v + omega x l.

    H = [0 R' R'[v]x [l]x]; a residual is measured minus this.
    """
    v: Vector = (nav[3], nav[4], nav[5])
    in_body = matvec_t(r, v)
    swing = cross(rate, arm)
    for i in range(3):
        axis: Vector = (r[i], r[3 + i], r[6 + i])
        H[i, 3], H[i, 4], H[i, 5] = axis
        H[i, 6], H[i, 7], H[i, 8] = cross(axis, v)  # a' [v]x = (a x v)'
    _minus_skew(H, 0, 9, (-arm[0], -arm[1], -arm[2]))
    return in_body[0] + swing[0], in_body[1] + swing[1], in_body[2] + swing[2]


@kernel()
def wheel_speed(nav: Floats, r: Matrix, H: Floats, speed: float, axle: Vector, rate: Vector) -> float:
    """Forward velocity of the rear axle times one plus the wheel's scale error, m/s."""
    ahead: float = body_velocity(nav, r, H, axle, rate)[0]
    times = 1.0 + nav[WHEEL_SCALE]
    for j in range(E_WHEEL_SCALE):
        H[0, j] *= times
        H[1, j] = H[2, j] = 0.0
    H[0, E_WHEEL_SCALE] = ahead
    return float(speed - times * ahead)
