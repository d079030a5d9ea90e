"""Back from a wrong state: when GNSS positions and pose fixes are both rejected and agree, the state gives way.

A rejection alone proves nothing: a wrong fix and an alias of the map are as steady as the truth. Two independent
sensors that say the same place, while neither was accepted in between, outvote the state.
"""

import math

from fusion._linalg import Vector, attitude, matvec
from fusion.events import Parameters
from fusion.measurements import Pair
from fusion.state import D_AGREED, D_COUNT, D_TIME, E_WHEEL_SCALE, Core, Floats
from sensors.kernel import kernel

FRESH_NS = 500_000_000
"""Rejections of both sensors within this belong together."""
AGREEING = 2.3
"""Largest squared distance of what they say, in variances as the filter inflates them: a quarter of 99 %."""
VAGUE_VAR = 0.3**2
"""Sensors that know less than this together agree by chance, m^2."""
VELOCITY_VAR = 1.0**2
"""Doubt of the velocity, (m/s)^2."""
ATTITUDE_VAR = 0.02**2
"""Doubt of the attitude, rad^2."""
WHEEL_SCALE_VAR = 0.02**2
"""Doubt of the wheel's scale."""


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
    east, north = c * z[0] - s * z[1], s * z[0] + c * z[1]
    mine[6] = mine[7] = 0.0
    if in_doubt(core, which, now) and now > clock[which, D_TIME]:
        dt = (now - clock[which, D_TIME]) * 1e-9
        mine[6], mine[7] = (east - mine[0]) / dt, (north - mine[1]) / dt
    mine[0], mine[1], mine[2] = east, north, z[2]
    mine[3] = c * c * R[0, 0] - 2.0 * c * s * R[0, 1] + s * s * R[1, 1]
    mine[4] = c * s * (R[0, 0] - R[1, 1]) + (c * c - s * s) * R[0, 1]
    mine[5] = s * s * R[0, 0] + 2.0 * c * s * R[0, 1] + c * c * R[1, 1]
    clock[which, D_COUNT] += 1
    clock[which, D_TIME] = now
    if not in_doubt(core, 1 - which, now):
        clock[0, D_AGREED] = 0
        return
    age = (now - clock[1 - which, D_TIME]) * 1e-9
    east_apart, north_apart = _apart_by_yaw(core, par, doubt[1, 2])
    sign = 1.0 if which == 0 else -1.0
    east -= other[0] + age * other[6] + sign * east_apart
    north -= other[1] + age * other[7] + sign * north_apart
    ee, en, nn = mine[3] + other[3], mine[4] + other[4], mine[5] + other[5]
    distance = (nn * east * east - 2.0 * en * east * north + ee * north * north) / (ee * nn - en * en)
    agree = distance <= AGREEING and ee + nn <= VAGUE_VAR
    clock[0, D_AGREED] = max(clock[0, D_AGREED] + (1 if agree else -2), 0)
    if clock[0, D_AGREED] >= par.outvoted:
        _give_way(core.P, doubt)
        clock[0, D_COUNT] = clock[1, D_COUNT] = clock[0, D_AGREED] = 0


@kernel()
def _apart_by_yaw(core: Core, par: Parameters, yaw: float) -> Pair:
    """East and north by which the antenna's innovation exceeds the pose's where the state's yaw is wrong by so much."""
    a, b = par.gnss_arm, par.pose_arm
    arm = matvec(attitude(core.nav), (a[0] - b[0], a[1] - b[1], a[2] - b[2]))
    c, s = math.cos(yaw) - 1.0, math.sin(yaw)
    return c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]


@kernel()
def _give_way(P: Floats, doubt: Floats) -> None:
    """Widen P to what both sensors say."""
    place = doubt[1, 0] * doubt[1, 0] + doubt[1, 1] * doubt[1, 1]
    P[0, 0] += place
    P[1, 1] += place
    P[2, 2] += doubt[0, 2] * doubt[0, 2]
    for i in range(3):
        P[3 + i, 3 + i] += VELOCITY_VAR
        P[6 + i, 6 + i] += ATTITUDE_VAR
    P[E_WHEEL_SCALE, E_WHEEL_SCALE] += WHEEL_SCALE_VAR
    P[8, 8] += doubt[1, 2] * doubt[1, 2]
