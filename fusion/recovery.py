"""Back from a wrong state: when what is rejected cannot be wrong itself, the state gives way.

A rejection alone proves nothing: a wrong fix and an alias of the map are as steady as the truth. Two independent
sensors that say the same place, while neither was accepted in between, outvote the state. Where GNSS is alone the
state's confidence decays as long as it is contradicted: what is little off is soon believed, a wrong fix a hundred
sigmas away not before it has ended. Height and yaw, of which one sensor alone may know, give way to it where all else
fits. Outvoted again soon, the state is given up (``fusion.divergence``).
"""

import math

from fusion._linalg import Vector, attitude, matvec
from fusion.blocks import renew
from fusion.events import Parameters
from fusion.giving_way import doubt_all, forget, give_way, give_way_nearby, give_way_turning, give_way_upwards
from fusion.health import gave_way, strained
from fusion.measurements import Pair, wrap
from fusion.state import D_AGREED, D_BELIEVED, D_COUNT, D_SINCE, D_STREAK, D_TIME, H_OUTVOTED, Core
from sensors.kernel import kernel

FRESH_NS = 500_000_000
"""Rejections of both sensors within this belong together."""
AGREEING = 9.2
"""Largest squared distance of what they say, in their variances: 99 %."""
FAR_SHARE, FAR_M = 0.1, 3.0
"""Innovations agree also where they differ by such a share of what they exceed FAR_M by: a state that is far off has a
wrong attitude as well, which moves the antenna against the camera, and runs away between the two, -, m."""
VAGUE_VAR = 0.15**2
"""Sensors that know less than this together agree by chance, m^2."""
ALONE_NS = 2_000_000_000
"""GNSS is alone when no pose fix came for so long."""
LONG_NS = 8_000_000_000
"""After so long the biases are doubted as well."""
COURSE_SPEED, COURSE_NEAR = 3.0, 0.05
"""At this speed and more a vehicle's course is its yaw to within so much, m/s, rad."""


@kernel()
def believed(core: Core, par: Parameters, which: int, z: Vector, now: int) -> None:
    """A position of sensor which (0 GNSS, 1 pose fix) was accepted, with innovation z."""
    if which == 0 and _goes_on(core, par, z, now):
        gave_way(core.health, par.health.settled_ns, True, now)
    core.doubt_clock[which, D_COUNT] = 0
    core.doubt_clock[which, D_BELIEVED] = now
    core.doubt_clock[0, D_AGREED] = 0


@kernel()
def _goes_on(core: Core, par: Parameters, z: Vector, now: int) -> bool:
    """Whether GNSS alone, accepted now, says what it said while it was rejected: then it is the state that gave way."""
    clock, said = core.doubt_clock, core.doubt[0]
    if clock[0, D_COUNT] == 0 or not (_for_long(core, par, now) and _alone(core, now)):
        return False
    near: bool = math.hypot(z[0] - said[0], z[1] - said[1]) < 0.5 * math.hypot(said[0], said[1])
    return near


@kernel()
def _for_long(core: Core, par: Parameters, now: int) -> bool:
    """Whether GNSS has contradicted the state for longer than two sensors need."""
    lasts: bool = now - core.doubt_clock[0, D_SINCE] >= par.health.contradicted_ns
    return lasts


@kernel()
def _alone(core: Core, now: int) -> bool:
    """Whether no pose fix came of late."""
    alone: bool = now - max(core.doubt_clock[1, D_TIME], core.doubt_clock[1, D_BELIEVED]) > ALONE_NS
    return alone


@kernel()
def in_doubt(core: Core, which: int, now: int) -> bool:
    """Whether the last position of sensor which was rejected, just now."""
    clock = core.doubt_clock
    fresh: bool = clock[which, D_COUNT] > 0 and now - clock[which, D_TIME] <= FRESH_NS
    return fresh


@kernel()
def doubted(core: Core, par: Parameters, which: int, z: Vector, ahead: Pair, now: int) -> None:
    """A position of sensor which was rejected: innovation z and core.R (its whole covariance) in axes whose first lies
    at ahead (cos, sin).

    After so many rejections in a row that agree with the other sensor's, P becomes wide enough for both.
    """
    c, s = ahead
    R, doubt, clock = core.R, core.doubt, core.doubt_clock
    mine, other = doubt[which], doubt[1 - which]
    climb = z[2] - mine[2] if which == 0 and clock[0, D_COUNT] > 0 else 0.0
    east, north = c * z[0] - s * z[1], s * z[0] + c * z[1]
    mine[6] = mine[7] = 0.0
    if in_doubt(core, which, now) and now > clock[which, D_TIME]:
        dt = (now - clock[which, D_TIME]) * 1e-9
        mine[6], mine[7] = (east - mine[0]) / dt, (north - mine[1]) / dt
    mine[0], mine[1], mine[2] = east, north, z[2]
    mine[3] = c * c * R[0, 0] - 2.0 * c * s * R[0, 1] + s * s * R[1, 1]
    mine[4] = c * s * (R[0, 0] - R[1, 1]) + (c * c - s * s) * R[0, 1]
    mine[5] = s * s * R[0, 0] + 2.0 * c * s * R[0, 1] + c * c * R[1, 1]
    if which == 0 and clock[0, D_COUNT] > 0 and _alone(core, now):
        if clock[0, D_TIME] - clock[0, D_SINCE] < LONG_NS <= now - clock[0, D_SINCE]:
            doubt_all(core.P)
            core.slipped[:] = 0.0
        moving = math.hypot(core.nav[3], core.nav[4]) >= COURSE_SPEED
        forget(core.P, min(now - clock[0, D_TIME], ALONE_NS) * 1e-9, moving)
    if clock[which, D_COUNT] == 0:
        clock[which, D_SINCE] = now
    clock[which, D_COUNT] += 1
    clock[which, D_TIME] = now
    if not in_doubt(core, 1 - which, now):
        clock[0, D_AGREED] = 0
        if not (_fits_but_for_height(core, par, z) if which == 0 else _fits_but_for_yaw(core, par, z)):
            clock[which, D_COUNT] = max(clock[which, D_COUNT] - 2, 1)
        elif clock[which, D_COUNT] >= par.outvoted:
            if which == 0:
                give_way_upwards(core.P, z[2], climb)
                if _for_long(core, par, now) and _alone(core, now):  # all but the height has given way by now
                    gave_way(core.health, par.health.settled_ns, True, now)
            else:
                give_way_turning(core.P, z[2])
                core.slipped[:] = 0.0  # learned with a wrong yaw, it would hold on to it
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
        give_way(core.P, doubt)
        core.slipped[:] = 0.0
        if gave_way(core.health, par.health.settled_ns, False, now):
            core.health[H_OUTVOTED] = now
        clock[0, D_COUNT] = clock[1, D_COUNT] = clock[0, D_AGREED] = 0
        clock[1, D_STREAK] = 0


@kernel()
def pulled_off(core: Core, par: Parameters, now: int) -> bool:
    """Whether GNSS slid aside, pulled the state along, and left it: it has been rejected since, and what lasts of an
    error had to be more than it can be. Then the state is worth less than pose fixes nearby."""
    pulled: bool = in_doubt(core, 0, now) and _for_long(core, par, now) and strained(core, par.health)
    return pulled


@kernel()
def hold_on(core: Core, par: Parameters, place_var: float, yaw_var: float, now: int) -> None:
    """Let P give way to a pose fix so far off, m^2, rad^2, and forget what lasts of either sensor's error."""
    give_way_nearby(core.P, place_var, yaw_var)
    for first in (par.layout.gnss_error, par.layout.pose_error):
        if first >= 0:
            renew(core, first)
    core.slipped[:] = 0.0
    gave_way(core.health, par.health.settled_ns, True, now)
    core.doubt_clock[1, D_COUNT] = core.doubt_clock[1, D_STREAK] = core.doubt_clock[0, D_AGREED] = 0


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
