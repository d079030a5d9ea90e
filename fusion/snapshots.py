"""Snapshots of the core, about a hundred a second, to go back to.

A snapshot is a copy of ``Core.kept``, one piece of memory that all arrays which the kernels change between calls are
views of: whatever the state grows into is in it. P, which changes with events alone, is copied when it has changed.
"""

import numpy as np

from fusion._linalg import Vector
from fusion.state import C_COUNT, C_STATE, RING_SIZE, Core
from sensors.clock import NS_PER_S
from sensors.kernel import kernel

SPACING_NS = 8_000_000
"""Snapshots are taken at IMU samples, so far apart or more."""
IMU_HZ = 1000
"""Up to this rate of the IMU the history is as long as it is configured; beyond it is shorter."""
_SCRATCH = ("phi", "M", "Mt", "H", "W", "R", "L", "eigen", "residual", "dx", "turned", "tape", "tape_end")
_SNAPSHOTS = ("kept", "saved", "saved_cov", "saved_t", "saves")
_ELSEWHERE = {"P", "ring", "ring_t", *_SCRATCH, *_SNAPSHOTS}
"""Arrays that are not in ``kept``: P, scratch, and the ring, whose samples are put there again."""

# entries of Core.saves: numbers of the newest snapshot, of the first that may be gone back to, and of the newest copy
# of P; whether P has changed since
S_NEWEST, S_FIRST, S_COPY, S_CHANGED = range(4)


def with_snapshots(core: Core, history_s: float) -> Core:
    """The same state in a core that takes snapshots over so many seconds, and has a longer ring."""
    count = round(history_s * NS_PER_S) // SPACING_NS + 2
    ring = 1 << (RING_SIZE + round(history_s * IMU_HZ) - 1).bit_length()
    arrays = {name: array for name, array in core._asdict().items() if name not in _ELSEWHERE}
    kept = np.zeros(sum(a.size for a in arrays.values()), np.int64)
    views, first = {}, 0
    for name, array in arrays.items():
        views[name] = kept[first : first + array.size].view(array.dtype).reshape(array.shape)
        views[name][...] = array
        first += array.size
    threaded = core._replace(
        **views,
        ring=np.zeros((ring, 6)),
        ring_t=np.zeros(ring, np.int64),
        kept=kept,
        saved=np.zeros((count, len(kept)), np.int64),
        saved_cov=np.zeros((count, *core.P.shape)),
        saved_t=np.zeros((count, 2), np.int64),
        saves=np.array([-1, 0, -1, 1]),
    )
    take(threaded)
    return threaded


@kernel()
def save(core: Core, rate: Vector, gap: bool) -> None:
    """Take a snapshot at an IMU sample, before the events of its time, unless the last one is near.

    rate: body rate that these events see, rad/s; gap: the sample ends a gap, in which P has changed.
    """
    saves, now = core.saves, core.clock[C_STATE]
    if gap:
        saves[S_CHANGED] = 1
    if saves[S_NEWEST] >= saves[S_FIRST] and now - core.saved_t[saves[S_NEWEST] % len(core.saved_t), 0] < SPACING_NS:
        return
    core.rate[0], core.rate[1], core.rate[2] = rate
    take(core)


@kernel()
def take(core: Core) -> None:
    """Take a snapshot."""
    saves, size = core.saves, len(core.saved_t)
    saves[S_NEWEST] += 1
    saves[S_FIRST] = max(saves[S_FIRST], saves[S_NEWEST] - size + 1)
    if saves[S_CHANGED] != 0:
        saves[S_COPY] += 1
        saves[S_CHANGED] = 0
        copy = core.saved_cov[saves[S_COPY] % size]
        for i in range(copy.shape[0]):
            for j in range(copy.shape[1]):
                copy[i, j] = core.P[i, j]
    k = saves[S_NEWEST] % size
    core.saved_t[k, 0], core.saved_t[k, 1] = core.clock[C_STATE], saves[S_COPY]
    row = core.saved[k]
    for i in range(len(row)):
        row[i] = core.kept[i]


@kernel()
def snapshot_before(core: Core, samples: int, t: int) -> int:
    """Number of the newest snapshot from which an event at t can be met, after so many IMU samples; -1: none.

    One at t itself will do if there is a sample after it to go on with.
    """
    size, number = len(core.saved_t), core.saves[S_NEWEST]
    while number >= core.saves[S_FIRST]:
        k = number % size
        behind, then = samples - core.saved[k, C_COUNT], core.saved_t[k, 0]
        if behind > len(core.ring_t) - RING_SIZE:
            return -1
        if then < t or (then == t and behind > 0):
            return int(number)
        number -= 1
    return -1


@kernel()
def restore(core: Core, number: int) -> None:
    """Go back to a snapshot; later ones are forgotten."""
    size, saves = len(core.saved_t), core.saves
    k = number % size
    row = core.saved[k]
    for i in range(len(row)):
        core.kept[i] = row[i]
    copy = core.saved_cov[core.saved_t[k, 1] % size]
    for i in range(copy.shape[0]):
        for j in range(copy.shape[1]):
            core.P[i, j] = copy[i, j]
    saves[S_NEWEST], saves[S_COPY], saves[S_CHANGED] = number, core.saved_t[k, 1], 0
