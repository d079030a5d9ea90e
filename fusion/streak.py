"""Pose fixes that are rejected in a row and say the same thing: what began as a jump while tracking stays one.

While fixes are rejected P grows, and any jump would pass in the end: a steady alias would capture the filter.
Growth of P explains how far the state has drifted since, not what was there when the streak began. So a fix that goes
on as the rejected ones before it did must be explained well (``gates.reentry``), not just be possible. It is judged as
ever where it differs from them (the alias has ended), after a pause, and where the streak began without a position to
hold on to: after an outage it is the state that has moved. A streak outlasts the odd frame that says something else and
is rejected as well: a gross error amid an alias makes the alias no truer.

Maps repeat themselves every dash and every lane. Satellites do not: where GNSS jumps, from float to fixed, what comes
after the jump is as likely to be right. But only where it stays: one reflection is no new error that lasts.
"""

from fusion.events import Parameters
from fusion.state import D_HELD, D_LAST, D_STREAK, D_TRACKING, Core
from sensors.kernel import kernel

PAUSE_NS = 5_000_000_000
"""A streak with a longer pause in it is none."""
TRACKING_NS = 2_000_000_000
"""The filter was tracking if a position was applied within so long before the streak."""
ALIAS_M = 1.5
"""Nothing that looks alike on a road lies nearer: half of a narrow lane, or of the shortest pitch of dashes."""
INSISTING_NS = 150_000_000
"""GNSS positions have been rejected in a row for so long before one may be explained by a new error that lasts: the
third of 10 Hz, the second of 1 Hz. One reflection is over by then; a message that comes twice insists on nothing."""
SAME = 9.21
"""Largest squared distance, in variances, of a fix that goes on as the one before it: 99 % of two dimensions. The
hundredth is none the less the same alias: so is what lies within ALIAS_M of it."""


@kernel()
def threshold_of(core: Core, par: Parameters, dof: int, now: int) -> float:
    """The chi-square gate of the pose fix core.fresh."""
    steady = core.doubt_clock[1, D_STREAK] >= par.streak and core.doubt_clock[1, D_TRACKING] != 0
    return par.reentry[dof - 1] if steady and goes_on(core, now) else par.gate[dof - 1]


@kernel()
def may_renew(core: Core, which: int, now: int) -> bool:
    """Whether a rejected position of sensor which (0 GNSS, 1 pose fix) may be judged with a new error that lasts."""
    clock = core.doubt_clock
    may: bool = which == 1 or (clock[0, D_STREAK] > 0 and now - clock[0, D_LAST] >= INSISTING_NS)
    return may


@kernel()
def goes_on(core: Core, now: int) -> bool:
    """Whether the pose fix core.fresh says what the streak says, and that may be an alias."""
    last, fresh = core.doubt[1], core.fresh
    if not _lasts(core, now):
        return False
    east, north = fresh[0] - last[8], fresh[1] - last[9]
    ee, en, nn = fresh[2] + last[10], fresh[3] + last[11], fresh[4] + last[12]
    apart: float = (nn * east * east - 2.0 * en * east * north + ee * north * north) / (ee * nn - en * en)
    same = apart <= SAME or east * east + north * north <= ALIAS_M**2
    alias: bool = same and fresh[0] ** 2 + fresh[1] ** 2 > ALIAS_M**2
    return alias


@kernel()
def _lasts(core: Core, now: int) -> bool:
    """Whether there is a streak, and no pause since."""
    clock = core.doubt_clock
    lasts: bool = clock[1, D_STREAK] > 0 and now - clock[1, D_LAST] <= PAUSE_NS
    return lasts


@kernel()
def tally(core: Core, par: Parameters, which: int, passed: bool, now: int) -> None:
    """Count a position of sensor which (0 GNSS, 1 the pose fix core.fresh), passed or rejected at time now."""
    clock = core.doubt_clock
    if passed:
        clock[which, D_STREAK] = 0
        clock[which, D_HELD] = now
        return
    if which == 0:
        if clock[0, D_STREAK] == 0:
            clock[0, D_LAST] = now
        clock[0, D_STREAK] += 1
        return
    same = goes_on(core, now)
    if not _lasts(core, now):
        clock[1, D_STREAK] = 0
        clock[1, D_TRACKING] = int(now - max(clock[0, D_HELD], clock[1, D_HELD]) <= TRACKING_NS)
    elif not same:
        clock[1, D_STREAK] = max(clock[1, D_STREAK] - 2, 0)
    clock[1, D_LAST] = now
    if same or clock[1, D_STREAK] == 0:
        clock[1, D_STREAK] = min(clock[1, D_STREAK] + 1, 2 * par.streak)
        for i in range(5):
            core.doubt[1, 8 + i] = core.fresh[i]
