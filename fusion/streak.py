"""Rejections in a row that say the same thing: what began as a jump while the filter was tracking stays one.

While fixes are rejected P grows, and any jump would pass in the end: a steady alias would capture the filter.
Growth of P explains how far the state has drifted since, not what was there when the streak began. So a fix that goes
on as the rejected ones before it did must be explained well (``gates.reentry``), not just be possible. It is judged as
ever where it differs from them (the alias has ended), after a pause, and where the streak began without a position to
hold on to: after an outage it is the state that has moved.
"""

from fusion.events import Parameters
from fusion.state import D_HELD, D_LAST, D_STREAK, D_TRACKING, Core
from sensors.kernel import kernel

PAUSE_NS = 5_000_000_000
"""A streak with a longer pause in it is none."""
TRACKING_NS = 2_000_000_000
"""The filter was tracking if a position was applied within so long before the streak."""
SAME = 9.21
"""Largest squared distance, in variances, of a fix that goes on as the one before it: 99 % of two dimensions."""


@kernel()
def goes_on(core: Core, which: int, now: int) -> bool:
    """Whether the position core.fresh of sensor which (0 GNSS, 1 pose fix) says what the last rejected one said."""
    clock, last, fresh = core.doubt_clock, core.doubt[which], core.fresh
    if clock[which, D_STREAK] == 0 or now - clock[which, D_LAST] > PAUSE_NS:
        return False
    east, north = fresh[0] - last[8], fresh[1] - last[9]
    ee, en, nn = fresh[2] + last[10], fresh[3] + last[11], fresh[4] + last[12]
    distance: float = (nn * east * east - 2.0 * en * east * north + ee * north * north) / (ee * nn - en * en)
    return distance <= SAME


@kernel()
def threshold_of(core: Core, par: Parameters, which: int, dof: int, now: int) -> float:
    """The chi-square gate of the position core.fresh of sensor which."""
    clock = core.doubt_clock
    steady = clock[which, D_STREAK] >= par.streak and clock[which, D_TRACKING] != 0
    if steady and goes_on(core, which, now):
        return par.reentry[dof - 1]
    return par.gate[dof - 1]


@kernel()
def tally(core: Core, which: int, passed: bool, now: int) -> None:
    """Count the position core.fresh of sensor which, passed or rejected at time now."""
    clock = core.doubt_clock
    if passed:
        clock[which, D_STREAK] = 0
        clock[which, D_HELD] = now
        return
    if not goes_on(core, which, now):
        clock[which, D_STREAK] = 0
        held = max(clock[0, D_HELD], clock[1, D_HELD])
        clock[which, D_TRACKING] = int(now - held <= TRACKING_NS)
    clock[which, D_STREAK] += 1
    clock[which, D_LAST] = now
    for i in range(5):
        core.doubt[which, 8 + i] = core.fresh[i]
