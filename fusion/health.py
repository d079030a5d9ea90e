"""How the filter is doing: one state of health, why, and how far each sensor is to be trusted.

Everything is judged from what the filter knows: the ages of the last measurements that its state explains, streaks of
those that it does not, its own sigmas, and what no vehicle can do. The clocks live in the core (``Core.health``,
``Core.trust``) and change with every measurement, so that pieces, streaming and rewinding give the same bits.
"""

from fusion.divergence import HealthLimits, divergence, heard, outvoted_again, outweighed
from fusion.result import Cause, Health, Level, Sensor
from fusion.state import (
    H_BACK,
    H_CAUSE,
    H_COUNT,
    H_FED,
    H_GAVE,
    H_HELD,
    H_LAST,
    H_RESTARTS,
    H_SINCE,
    H_START,
    H_STATE,
    H_TIMES,
    H_UNSETTLED,
    H_WIDE,
    T_DOUBT,
    T_GOOD,
    T_SEEN,
    Core,
    Floats,
    Nanoseconds,
)
from sensors.kernel import kernel

SOURCES = (Sensor.GNSS_POSITION, Sensor.GNSS_VELOCITY, Sensor.GNSS_YAW, Sensor.POSE_FIX, Sensor.WHEEL)
"""Sensors with a level; their codes count from zero and are the rows of Core.trust."""

_HEALTHY, _DEGRADED, _RECOVERED = int(Health.HEALTHY), int(Health.DEGRADED), int(Health.RECOVERED)
_DEAD_RECKONING, _DIVERGED = int(Health.DEAD_RECKONING), int(Health.DIVERGED)
_NONE, _SIGMA, _REJECTED, _TILTED = int(Cause.NONE), int(Cause.SIGMA), int(Cause.REJECTED), int(Cause.TILTED)
_UNSETTLED, _LASTING_ERROR = int(Cause.UNSETTLED), int(Cause.LASTING_ERROR)
_ABSENT, _STALE, _SUSPECT, _GOOD = (int(level) for level in Level)
_GNSS, _YAW, _POSE = int(Sensor.GNSS_POSITION), int(Sensor.GNSS_YAW), int(Sensor.POSE_FIX)
_COUNT = len(SOURCES)

LONGEST = 4
"""A state is unsettled for at most so many times ``health.settled_s``."""


def begin(core: Core, now: int, before: Core | None, settled: int) -> None:
    """Set the clocks of a core that was aligned at now; before: the core that diverged, None: the first start.

    settled: so long a start after the second is not taken to be well, ns.
    """
    clock = core.health
    clock[H_START] = clock[H_FED] = clock[H_HELD] = now
    clock[H_STATE] = _HEALTHY
    if before is not None:
        clock[H_BACK], clock[H_RESTARTS] = now, before.health[H_RESTARTS] + 1
        for kept in (H_GAVE, H_UNSETTLED, H_TIMES):
            clock[kept] = before.health[kept]
        if clock[H_RESTARTS] > 1:
            unsettle(clock, settled, now)
        core.trust[:, T_SEEN], core.trust[:, T_GOOD] = before.trust[:, T_SEEN], before.trust[:, T_GOOD]
        core.quietest[:] = before.quietest


@kernel()
def noted(
    clock: Nanoseconds, trust: Nanoseconds, suspect: int, sensor: int, applied: bool, explained: bool, now: int
) -> None:
    """A measurement of one of SOURCES was judged: whether it was applied, and whether the state explains it.

    clock, trust: Core.health and Core.trust.
    """
    trust[sensor, T_SEEN] = now
    if explained:
        trust[sensor, T_GOOD] = now
        trust[sensor, T_DOUBT] = max(trust[sensor, T_DOUBT] - 1, 0)
    else:
        trust[sensor, T_DOUBT] = min(trust[sensor, T_DOUBT] + 1, 2 * suspect)
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
def unsettle(clock: Nanoseconds, settled: int, now: int) -> None:
    """The state may be wrong again soon: for longer each time, since what is wrong may be the IMU."""
    clock[H_UNSETTLED] = now + min(max(clock[H_TIMES], clock[H_RESTARTS]) - 1, LONGEST - 1) * settled


@kernel()
def gave_way(clock: Nanoseconds, settled: int, alone: bool, now: int) -> bool:
    """The state gave way to positions that contradicted it; whether it had done so shortly before.

    clock: Core.health; settled: what is shortly, ns; alone: to those of one sensor, which may have been wrong.
    """
    again: bool = now - clock[H_GAVE] <= settled
    if not again:
        clock[H_TIMES] += 1
    if alone or again or clock[H_TIMES] > 1:
        unsettle(clock, settled, now)
    clock[H_GAVE] = clock[H_BACK] = now
    return again


@kernel(inline="always")
def in_question(clock: Nanoseconds, settled: int, now: int) -> bool:
    """Whether positions contradict the state, or it gave way to them of late. clock: Core.health."""
    return bool(clock[H_COUNT] > 0 or now - clock[H_GAVE] <= settled)


@kernel()
def level_of(trust: Nanoseconds, stale: int, suspect: int, sensor: int, now: int) -> int:
    """The Level of one of SOURCES. trust: Core.trust; stale: after so many ns."""
    if trust[sensor, T_SEEN] == trust[sensor, T_GOOD] < 0:
        return _ABSENT
    if now - trust[sensor, T_SEEN] > stale:
        return _STALE
    if trust[sensor, T_DOUBT] >= suspect or now - trust[sensor, T_GOOD] > stale:
        return _SUSPECT
    return _GOOD


@kernel()
def judge(core: Core, limits: HealthLimits, now: int) -> None:
    """Bring the state of health and its cause up to now."""
    clock = core.health
    before = clock[H_STATE]
    if core.P[8, 8] > limits.wide_yaw_var:
        clock[H_WIDE] = now
    cause = divergence(core, limits)
    if cause != _NONE:
        state = _DIVERGED
    elif now - clock[H_FED] > limits.dead_reckoning_ns:
        state = _DEAD_RECKONING
    else:
        if before in (_DIVERGED, _DEAD_RECKONING):
            clock[H_BACK] = now
        cause = _weakness(core, limits, now)
        well = _RECOVERED if now - clock[H_BACK] <= limits.recovered_ns else _HEALTHY
        state = well if cause == _NONE else _DEGRADED
    clock[H_STATE], clock[H_CAUSE] = state, cause


@kernel()
def _weakness(core: Core, limits: HealthLimits, now: int) -> int:
    """The Cause for which the state is less than healthy: that it gave way, or the first sensor not good; NONE."""
    if now - core.health[H_UNSETTLED] <= limits.settled_ns:
        return _UNSETTLED
    for sensor in range(_COUNT):
        if _ABSENT < level_of(core.trust, limits.stale_ns[sensor], limits.suspect, sensor, now) < _GOOD:
            return sensor + 1
    if strained(core, limits):
        return _LASTING_ERROR
    P = core.P
    return _SIGMA if P[0, 0] + P[1, 1] > limits.sigma_var or P[8, 8] > limits.sigma_yaw_var else _NONE


@kernel()
def strained(core: Core, limits: HealthLimits) -> bool:
    """Whether what lasts of a horizontal position's error, or of a pose fix's yaw, has grown beyond what it can be.

    Its states have unit variance (``fusion.blocks``). They take in what a sensor says against the rest as long as it
    says so smoothly, and the gate sees nothing of it: a drift, or a yaw that an IMU has turned.
    """
    gnss, pose = limits.lasting
    most = 0.0
    for k in range(2):
        if gnss >= 0:
            most = max(most, abs(core.nav[gnss + k + 1]))
    for k in range(3):
        if pose >= 0:
            most = max(most, abs(core.nav[pose + k + 1]))
    return most > limits.lasting_sigmas


@kernel(inline="always")
def questionable(clock: Nanoseconds, P: Floats, limits: HealthLimits) -> bool:
    """Whether there is any need to ask ``hopeless``: positions of late were not explained, or P is wide or NaN."""
    narrow = P[8, 8] <= limits.wide_yaw_var and P[0, 0] + P[1, 1] <= limits.blown_var
    return bool(clock[H_COUNT] > 0 or not narrow)


@kernel()
def hopeless(core: Core, limits: HealthLimits, sensor: int, now: int) -> bool:
    """Whether a position that comes now should rather begin a new alignment than be judged by this state.

    sensor: GNSS position or pose fix. Not within a pause after a start, which grows with their number, unless it was
    outvoted again; and not for its tilt, which gravity gives again.
    """
    clock, nav = core.health, core.nav
    if core.P[8, 8] > limits.wide_yaw_var:
        clock[H_WIDE] = now
    if not limits.restart:
        return False
    if now - clock[H_START] < limits.pause_ns * (1 + clock[H_RESTARTS]) and not outvoted_again(core):
        return False
    cause = divergence(core, limits)
    if cause in (_NONE, _TILTED):
        return False
    judge(core, limits, now)
    if cause == _REJECTED:
        # without these the new yaw will be a course
        yaw = level_of(core.trust, limits.stale_ns[_YAW], limits.suspect, _YAW, now) > _STALE
        has_yaw = sensor == _POSE or heard(core, _POSE) or yaw
        if not has_yaw and nav[3] * nav[3] + nav[4] * nav[4] < limits.course_speed2:
            return False
        if not outweighed(core, limits):
            return False
    alone = cause == _REJECTED and not (heard(core, _GNSS) and heard(core, _POSE))
    gave_way(clock, limits.settled_ns, alone, now)
    return True
