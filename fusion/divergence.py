"""When a filter has diverged: what no state and no vehicle can be, and positions that contradict it for too long."""

import math
from typing import NamedTuple

from fusion._linalg import Vector, attitude
from fusion.result import Cause, Sensor
from fusion.state import (
    ERROR_SIZE,
    H_COUNT,
    H_HELD,
    H_LAST,
    H_OUTVOTED,
    H_SINCE,
    H_WIDE,
    NAV_SIZE,
    T_SEEN,
    Core,
)
from sensors.kernel import kernel

SIGMAS = 3.0
"""A contradiction of at most so many horizontal sigmas is one that the covariance explains by its size."""
AGREEMENT = 0.2
"""Two sensors that differ by at most this share of how far the state is off name the same place."""

_NONE, _NOT_FINITE, _TOO_FAST = int(Cause.NONE), int(Cause.NOT_FINITE), int(Cause.TOO_FAST)
_COVARIANCE, _REJECTED, _TILTED = int(Cause.COVARIANCE), int(Cause.REJECTED), int(Cause.TILTED)
_GNSS, _POSE = int(Sensor.GNSS_POSITION), int(Sensor.POSE_FIX)


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
    contradicted_ns: int
    settled_ns: int
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
    lasting: tuple[int, int]
    """First states of the errors that last, of GNSS and of pose fixes (``fusion.layout``)."""
    lasting_sigmas: float


@kernel()
def divergence(core: Core, limits: HealthLimits) -> int:
    """The Cause for which the state must not be used; NONE."""
    nav, P = core.nav, core.P
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
    if lost(core, limits):
        return _REJECTED
    return _TILTED if attitude(nav)[8] < limits.least_upright else _NONE


@kernel()
def lost(core: Core, limits: HealthLimits) -> bool:
    """Whether positions contradict the state: two sensors for a second or by a second vote, one for longer and by far,
    or for very long.

    What one sensor says, not far from the state and not for so long, may be a wrong fix or an alias of the map.
    """
    clock = core.health
    lasts = clock[H_LAST] - clock[H_SINCE]
    if outvoted_again(core):
        return True
    both = heard(core, _GNSS) and heard(core, _POSE)
    if clock[H_COUNT] < limits.lost or lasts < (limits.contradicted_ns if both else limits.lost_ns):
        return False
    if both:
        return True
    return bool(lasts >= limits.alone_ns or _off(core) > limits.far_m or _doubtful(core, limits))


@kernel()
def _weak(core: Core, limits: HealthLimits) -> bool:
    """Whether the state says little: nothing held it for long, or its yaw was beyond what linear updates can mend."""
    clock = core.health
    unheld: bool = clock[H_LAST] - clock[H_HELD] >= limits.alone_ns
    return bool(unheld or clock[H_SINCE] - clock[H_WIDE] <= limits.lost_ns)


@kernel()
def _doubtful(core: Core, limits: HealthLimits) -> bool:
    """Whether a weak state's own sigma explains the size of the contradiction, if not its direction."""
    size = _off(core)
    return bool(_weak(core, limits) and size * size <= SIGMAS * SIGMAS * (core.P[0, 0] + core.P[1, 1]))


@kernel()
def outvoted_again(core: Core) -> bool:
    """Whether the positions that were not explained of late have outvoted the state, not for the first time."""
    again: bool = core.health[H_COUNT] > 0 and core.health[H_OUTVOTED] >= core.health[H_SINCE]
    return again


@kernel()
def heard(core: Core, sensor: int) -> bool:
    """Whether positions of this sensor are among those that were not explained of late."""
    lately: bool = core.trust[sensor, T_SEEN] >= core.health[H_SINCE]
    return lately


@kernel()
def _off(core: Core) -> float:
    """How far off the state is by the sensor that says least, m.

    Pose fixes: by the last one and by what they have been saying (``fusion.streak``), of which a gross frame is none.
    """
    least = math.inf
    for which, sensor in ((0, _GNSS), (1, _POSE)):
        if heard(core, sensor):
            least = min(least, math.hypot(core.doubt[which, 0], core.doubt[which, 1]))
    if heard(core, _POSE):
        least = min(least, math.hypot(core.doubt[1, 8], core.doubt[1, 9]))
    return least


@kernel()
def outweighed(core: Core, limits: HealthLimits) -> bool:
    """Whether what contradicts a lost state weighs more than the state does: then it had better begin anew.

    Two sensors that outvoted it again, or roughly agree on a place far off, do; GNSS alone does where the state is
    weak or after very long; pose fixes alone only from far off: nearer, an alias of the map is as steady as the truth.
    """
    if outvoted_again(core):
        return True
    clock = core.health
    off = _off(core)
    far = off > limits.far_m
    if heard(core, _GNSS) and heard(core, _POSE):
        gnss, pose = core.doubt[0], core.doubt[1]
        return bool(far and math.hypot(gnss[0] - pose[0], gnss[1] - pose[1]) <= AGREEMENT * off)
    if far and _weak(core, limits):
        return True
    long = clock[H_LAST] - clock[H_SINCE] >= limits.alone_ns
    return bool(heard(core, _GNSS) and (long or _doubtful(core, limits)))
