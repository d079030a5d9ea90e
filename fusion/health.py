"""How the filter is doing: one state of health, why, and how far each sensor is to be trusted.

Everything is judged from what the filter knows: the ages of the last measurements that its state explains, streaks of
those that it does not, its own sigmas, and what no vehicle can do. The clocks live in the core (``Core.health``,
``Core.trust``) and change with every measurement, so that pieces, streaming and rewinding give the same bits.
"""

import math
from enum import IntEnum
from typing import NamedTuple

from fusion._linalg import Vector, attitude
from fusion.result import Sensor
from fusion.state import (
    ERROR_SIZE,
    H_BACK,
    H_CAUSE,
    H_COUNT,
    H_FED,
    H_HELD,
    H_LAST,
    H_RESTARTS,
    H_SINCE,
    H_START,
    H_STATE,
    H_WIDE,
    NAV_SIZE,
    T_DOUBT,
    T_GOOD,
    T_SEEN,
    Core,
)
from sensors.kernel import kernel

SOURCES = (Sensor.GNSS_POSITION, Sensor.GNSS_VELOCITY, Sensor.GNSS_YAW, Sensor.POSE_FIX, Sensor.WHEEL)
"""Sensors with a level; their codes count from zero and are the rows of Core.trust."""


class Health(IntEnum):
    """State of health, worst first where several hold: diverged, dead reckoning, degraded, recovered, healthy."""

    INITIALIZING = 0
    """There is no state: before the first alignment, or between a divergence and the next."""
    HEALTHY = 1
    DEGRADED = 2
    """A sensor that the drive has is not good, or the stated sigma is large; the cause says which."""
    DEAD_RECKONING = 3
    """No position was applied for a while."""
    DIVERGED = 4
    """Not to be used; the cause says why."""
    RECOVERED = 5
    """All is well again, but only for a short time."""


class Cause(IntEnum):
    """Why the state is degraded or diverged."""

    NONE = 0
    GNSS_POSITION = 1
    GNSS_VELOCITY = 2
    GNSS_YAW = 3
    POSE_FIX = 4
    WHEEL = 5
    SIGMA = 6
    """Position or yaw is known badly."""
    NOT_FINITE = 7
    """The state is not finite, or a variance not a number above zero."""
    TOO_FAST = 8
    """Faster than any land vehicle."""
    COVARIANCE = 9
    """Position or yaw is not known at all."""
    REJECTED = 10
    """No position was explained by the state for long."""
    TILTED = 11
    """A land vehicle on its side: the IMU's axes are others."""


class Level(IntEnum):
    """How far a sensor is to be trusted."""

    ABSENT = 0
    """The filter has judged none of its measurements."""
    STALE = 1
    """None that could be used for a while."""
    SUSPECT = 2
    """The state does not explain them."""
    GOOD = 3


class HealthLimits(NamedTuple):
    """fusion.config.HealthModel in SI units."""

    explained: Vector
    """Chi-square thresholds for 1, 2 and 3 degrees of freedom: beyond, the state does not explain a measurement."""
    stale_ns: tuple[int, int, int, int, int]
    suspect: int
    dead_reckoning_ns: int
    recovered_ns: int
    sigma_var: float
    sigma_yaw_var: float
    lost_ns: int
    lost: int
    max_speed2: float
    least_upright: float
    blown_var: float
    blown_yaw_var: float
    restart: bool
    pause_ns: int
    alone_ns: int
    wide_yaw_var: float
    far_m: float
    course_speed2: float


_INITIALIZING, _HEALTHY, _DEGRADED = int(Health.INITIALIZING), int(Health.HEALTHY), int(Health.DEGRADED)
_DEAD_RECKONING, _DIVERGED, _RECOVERED = int(Health.DEAD_RECKONING), int(Health.DIVERGED), int(Health.RECOVERED)
_NONE, _SIGMA, _NOT_FINITE, _TOO_FAST = int(Cause.NONE), int(Cause.SIGMA), int(Cause.NOT_FINITE), int(Cause.TOO_FAST)
_TILTED, _COVARIANCE, _REJECTED = int(Cause.TILTED), int(Cause.COVARIANCE), int(Cause.REJECTED)
_ABSENT, _STALE, _SUSPECT, _GOOD = (int(level) for level in Level)
_GNSS, _YAW, _POSE = int(Sensor.GNSS_POSITION), int(Sensor.GNSS_YAW), int(Sensor.POSE_FIX)
_COUNT = len(SOURCES)
SIGMAS = 3.0
"""A contradiction of at most so many horizontal sigmas is one that the covariance explains by its size."""
AGREEMENT = 0.2
"""Two sensors that differ by at most this share of how far the state is off name the same place."""


def begin(core: Core, now: int, before: Core | None) -> None:
    """Set the clocks of a core that was aligned at now; before: the core that diverged, None: the first start."""
    clock = core.health
    clock[H_START] = clock[H_FED] = clock[H_HELD] = now
    clock[H_STATE] = _HEALTHY
    if before is not None:
        clock[H_BACK], clock[H_RESTARTS] = now, before.health[H_RESTARTS] + 1
        core.trust[:, T_SEEN], core.trust[:, T_GOOD] = before.trust[:, T_SEEN], before.trust[:, T_GOOD]
        core.quietest[:] = before.quietest


@kernel()
def noted(core: Core, limits: HealthLimits, sensor: int, dof: int, score: float, applied: bool, now: int) -> None:
    """A measurement of one of SOURCES was judged: its NIS (score) with so many degrees of freedom, and its fate."""
    clock, trust = core.health, core.trust
    explained = applied and score <= limits.explained[dof - 1]
    trust[sensor, T_SEEN] = now
    if explained:
        trust[sensor, T_GOOD] = now
        trust[sensor, T_DOUBT] = max(trust[sensor, T_DOUBT] - 1, 0)
    else:
        trust[sensor, T_DOUBT] = min(trust[sensor, T_DOUBT] + 1, 2 * limits.suspect)
    if sensor not in (_GNSS, _POSE):
        return
    if applied:
        clock[H_FED] = now
    if explained:
        clock[H_HELD], clock[H_COUNT] = now, 0
        return
    if clock[H_COUNT] == 0:
        clock[H_SINCE] = now
    clock[H_COUNT] += 1
    clock[H_LAST] = now


@kernel()
def level_of(core: Core, limits: HealthLimits, sensor: int, now: int) -> int:
    """The Level of one of SOURCES."""
    trust, stale = core.trust, limits.stale_ns[sensor]
    if trust[sensor, T_SEEN] == trust[sensor, T_GOOD] < 0:
        return _ABSENT
    if now - trust[sensor, T_SEEN] > stale:
        return _STALE
    if trust[sensor, T_DOUBT] >= limits.suspect or now - trust[sensor, T_GOOD] > stale:
        return _SUSPECT
    return _GOOD


@kernel()
def judge(core: Core, limits: HealthLimits, now: int) -> None:
    """Bring the state of health and its cause up to now."""
    clock = core.health
    before = clock[H_STATE]
    if core.P[8, 8] > limits.wide_yaw_var:
        clock[H_WIDE] = now
    cause = _divergence(core, limits)
    if cause != _NONE:
        state = _DIVERGED
    elif now - clock[H_FED] > limits.dead_reckoning_ns:
        state = _DEAD_RECKONING
    else:
        if before in (_DIVERGED, _DEAD_RECKONING):
            clock[H_BACK] = now
        cause = _weakness(core, limits, now)
        if cause != _NONE:
            state = _DEGRADED
        else:
            state = _RECOVERED if now - clock[H_BACK] <= limits.recovered_ns else _HEALTHY
    clock[H_STATE], clock[H_CAUSE] = state, cause


@kernel()
def _divergence(core: Core, limits: HealthLimits) -> int:
    """The Cause for which the state must not be used; NONE."""
    nav, P, clock = core.nav, core.P, core.health
    for i in range(NAV_SIZE):
        if not math.isfinite(nav[i]):
            return _NOT_FINITE
    for i in range(ERROR_SIZE):
        if not 0.0 <= P[i, i] < math.inf:
            return _NOT_FINITE
    if nav[3] * nav[3] + nav[4] * nav[4] + nav[5] * nav[5] > limits.max_speed2:
        return _TOO_FAST
    if P[0, 0] + P[1, 1] > limits.blown_var or P[8, 8] > limits.blown_yaw_var:
        return _COVARIANCE
    if _lost(core, limits):
        return _REJECTED
    return _TILTED if attitude(nav)[8] < limits.least_upright else _NONE


@kernel()
def _lost(core: Core, limits: HealthLimits) -> bool:
    """Whether positions contradict the state for too long: two sensors, one by far, or one for very long.

    What one sensor says, not far from the state and not for so long, may be a wrong fix or an alias of the map.
    """
    clock = core.health
    lasts = clock[H_LAST] - clock[H_SINCE]
    if clock[H_COUNT] < limits.lost or lasts < limits.lost_ns:
        return False
    both = _heard(core, _GNSS) and _heard(core, _POSE)
    return both or lasts >= limits.alone_ns or _off(core) > limits.far_m or _doubtful(core, limits)


@kernel()
def _weak(core: Core, limits: HealthLimits) -> bool:
    """Whether the state says little: nothing held it for long, or its yaw was beyond what linear updates can mend."""
    clock = core.health
    unheld: bool = clock[H_LAST] - clock[H_HELD] >= limits.alone_ns
    return unheld or clock[H_SINCE] - clock[H_WIDE] <= limits.lost_ns


@kernel()
def _doubtful(core: Core, limits: HealthLimits) -> bool:
    """Whether a weak state's own sigma explains the size of the contradiction, if not its direction."""
    size = _off(core)
    return _weak(core, limits) and size * size <= SIGMAS * SIGMAS * (core.P[0, 0] + core.P[1, 1])


@kernel()
def _heard(core: Core, sensor: int) -> bool:
    """Whether positions of this sensor are among those that were not explained of late."""
    heard: bool = core.trust[sensor, T_SEEN] >= core.health[H_SINCE]
    return heard


@kernel()
def _off(core: Core) -> float:
    """How far off the state is by the sensor that says least, m."""
    least = math.inf
    for which, sensor in ((0, _GNSS), (1, _POSE)):
        if _heard(core, sensor):
            least = min(least, math.hypot(core.doubt[which, 0], core.doubt[which, 1]))
    return least


@kernel()
def _weakness(core: Core, limits: HealthLimits, now: int) -> int:
    """The Cause for which the state is less than healthy: the first sensor that is not good; NONE."""
    for sensor in range(_COUNT):
        if _ABSENT < level_of(core, limits, sensor, now) < _GOOD:
            return sensor + 1
    P = core.P
    return _SIGMA if P[0, 0] + P[1, 1] > limits.sigma_var or P[8, 8] > limits.sigma_yaw_var else _NONE


@kernel()
def hopeless(core: Core, limits: HealthLimits, sensor: int, now: int) -> bool:
    """Whether a position that comes now should rather begin a new alignment than be judged by this state.

    Not the second time within a pause that grows with each start, and not because of one sensor's word, unless the
    state has been without any other for so long, or so uncertain in yaw, that it weighs less.
    """
    clock = core.health
    if sensor not in (_GNSS, _POSE) or not limits.restart:
        return False
    if now - clock[H_START] < limits.pause_ns * (1 + clock[H_RESTARTS]):
        return False
    judge(core, limits, now)
    if clock[H_STATE] != _DIVERGED or clock[H_CAUSE] == _TILTED:  # tilted by gravity: it would be again
        return False
    if clock[H_CAUSE] != _REJECTED:
        return True
    far = _off(core) > limits.far_m
    if _heard(core, _GNSS) and _heard(core, _POSE):
        gnss, pose = core.doubt[0], core.doubt[1]
        return far and math.hypot(gnss[0] - pose[0], gnss[1] - pose[1]) <= AGREEMENT * _off(core)
    far_and_weak = far and _weak(core, limits)
    if sensor == _POSE:
        return far_and_weak  # nearer, an alias of the map looks the same
    if not far_and_weak and not _doubtful(core, limits) and clock[H_LAST] - clock[H_SINCE] < limits.alone_ns:
        return False
    nav = core.nav
    moving = nav[3] * nav[3] + nav[4] * nav[4] >= limits.course_speed2
    return moving or level_of(core, limits, _YAW, now) > _STALE
