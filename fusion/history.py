"""The latest second of a filter that may have to go back: snapshots of the core, IMU samples, events in stamp order.

A snapshot is a copy of ``Core.kept``, one piece of memory that all arrays which the kernels change between calls are
views of: whatever the state grows into is in it. The filter goes back to a snapshot and plays samples and events again.
"""

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion._linalg import Vector
from fusion.events import Events, Measurements
from fusion.state import C_COUNT, C_STATE, RING_SIZE, Core, Floats, Nanoseconds
from sensors.clock import NS_PER_S
from sensors.kernel import kernel

Integer = TypeVar("Integer", np.int8, np.int64)
Number = TypeVar("Number", np.int64, np.float64)

SPACING_NS = 8_000_000
"""Snapshots are taken at IMU samples, so far apart or more."""
IMU_HZ = 1000
"""Up to this rate of the IMU the history is as long as it is configured; beyond it is shorter."""
EVENTS = 4096
"""Events in a second of history; with more of them it is shorter."""
NEW = 4096
"""Measurements that come in one call."""
PLAYED = 64
"""IMU samples that are played at a time."""
_UNCHANGED = {"ring", "ring_t", "phi", "M", "Mt", "H", "W", "R", "L", "eigen", "residual", "dx"}
"""Arrays of the core that no snapshot needs: scratch, and the ring, whose samples are put there again."""

# entries of Core.saves: number of the newest snapshot, and of the first that may be gone back to
S_NEWEST, S_FIRST = range(2)

# entries of History.mark
(
    M_SAMPLES,
    M_EVENTS,
    M_NEXT,
    M_FREE,
    M_OUTPUT,
    M_TICK,
    M_OUTPUT_PERIOD,
    M_TICK_PERIOD,
    M_START,
    M_SILENT,
    M_LENGTH,
) = range(11)

# columns of History.inbox
I_T, I_KIND, I_ROW, I_VERDICT, I_DUE, I_ARRIVAL, I_LOG_ROW = range(7)


class Samples(NamedTuple):
    """IMU samples: t (N,) ns, gyro (N, 3) rad/s, accel (N, 3) m/s^2."""

    t: Nanoseconds
    gyro: Floats
    accel: Floats


class History(NamedTuple):
    """What the filter plays again.

    mark (11,) int64: IMU samples so far, events, the first event not met, free rows, the next output and motion tick
    ns, their periods ns (0: none), time of the first state ns, outputs up to this time are not recorded ns, length ns.
    samples (N,): a ring with the slots of Core.ring; played: the same memory, to be read.
    events (E,): sorted by time and kind, the first ``mark[M_EVENTS]`` of them; arrival_ns, log_row (E,): of each.
    m: the measurements' columns (E + NEW rows); free (E + NEW,): their rows that no event needs.
    inbox (NEW, 7) int64: measurements that have just come (I_*).
    """

    mark: Nanoseconds
    samples: Samples
    played: Samples
    events: Events
    arrival_ns: Nanoseconds
    log_row: Nanoseconds
    m: Measurements
    free: Nanoseconds
    inbox: Nanoseconds


def with_snapshots(core: Core, history_s: float) -> Core:
    """The same state in a core that takes snapshots over so many seconds, and has a longer ring."""
    count = round(history_s * NS_PER_S) // SPACING_NS + 2
    ring = 1 << (RING_SIZE + round(history_s * IMU_HZ) - 1).bit_length()
    arrays = {name: a for name, a in core._asdict().items() if name not in _UNCHANGED and not name.startswith("save")}
    del arrays["kept"]
    kept = np.zeros(sum(a.size for a in arrays.values()), np.int64)
    views, first = {}, 0
    for name, array in arrays.items():
        views[name] = kept[first : first + array.size].view(array.dtype).reshape(array.shape)
        views[name][...] = array
        first += array.size
    saved = np.zeros((count, len(kept)), np.int64)
    saved_t = np.zeros(count, np.int64)
    saved[0], saved_t[0] = kept, core.clock[C_STATE]
    return core._replace(
        **views,
        ring=np.zeros((ring, 6)),
        ring_t=np.zeros(ring, np.int64),
        kept=kept,
        saved=saved,
        saved_t=saved_t,
        saves=np.zeros(2, np.int64),
    )


def columns_for(m: Measurements, length_s: float) -> Measurements:
    """Columns like those of m, with as many rows as a history of so many seconds needs."""
    return Measurements(*(np.zeros((_events_in(length_s) + NEW, *column.shape[1:])) for column in m))


def new_history(ring: int, columns: Measurements, length_s: float) -> History:
    """An empty history. ring: slots of Core.ring; columns: of ``columns_for``."""
    size = _events_in(length_s)
    samples = Samples(np.zeros(ring, np.int64), np.zeros((ring, 3)), np.zeros((ring, 3)))
    mark = np.zeros(11, np.int64)
    mark[M_LENGTH], mark[M_FREE] = round(length_s * NS_PER_S), size + NEW
    return History(
        mark=mark,
        samples=samples,
        played=Samples(*(read_only(a) for a in samples)),
        events=Events(*(np.zeros(size, dtype) for dtype in (np.int64, np.int8, np.int64, np.int8))),
        arrival_ns=np.zeros(size, np.int64),
        log_row=np.zeros(size, np.int64),
        m=Measurements(*(read_only(column) for column in columns)),
        free=np.arange(size + NEW),
        inbox=np.zeros((NEW, 7), np.int64),
    )


def _events_in(length_s: float) -> int:
    return 1 << (max(EVENTS, round(EVENTS * length_s)) - 1).bit_length()


def with_room(history: History, more: int) -> History:
    """The history with room for so many more events that wait for the IMU: a long gap is full of outputs."""
    waiting = int(history.mark[M_EVENTS] - history.mark[M_NEXT])
    if 4 * (waiting + more) <= 3 * len(history.arrival_ns):
        return history
    size = 1 << (2 * (waiting + more)).bit_length()
    events = Events(*(_longer(column, size) for column in history.events))
    arrival_ns, log_row = _longer(history.arrival_ns, size), _longer(history.log_row, size)
    return history._replace(events=events, arrival_ns=arrival_ns, log_row=log_row)


def _longer(column: NDArray[Integer], size: int) -> NDArray[Integer]:
    longer = np.zeros(max(size, len(column)), column.dtype)
    longer[: len(column)] = column
    return longer


def read_only(array: NDArray[Number]) -> NDArray[Number]:
    """The same numbers, contiguous and not to be written."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


@kernel()
def save(core: Core, rate: Vector) -> None:
    """Take a snapshot at an IMU sample, before the events of its time, unless the last one is near.

    rate: body rate that these events see, rad/s. A core without history takes none.
    """
    size = len(core.saved_t)
    if size == 0:
        return
    now, newest = core.clock[C_STATE], core.saves[S_NEWEST]
    if newest >= core.saves[S_FIRST] and now - core.saved_t[newest % size] < SPACING_NS:
        return
    core.rate[0], core.rate[1], core.rate[2] = rate
    newest += 1
    core.saves[S_NEWEST] = newest
    core.saves[S_FIRST] = max(core.saves[S_FIRST], newest - size + 1)
    k = newest % size
    core.saved_t[k] = now
    for i in range(len(core.kept)):
        core.saved[k, i] = core.kept[i]


@kernel()
def snapshot_before(core: Core, samples: int, t: int) -> int:
    """Number of the newest snapshot from which an event at t can be met, after so many IMU samples; -1: none.

    One at t itself will do if there is a sample after it to go on with.
    """
    size, number = len(core.saved_t), core.saves[S_NEWEST]
    while number >= core.saves[S_FIRST]:
        k = number % size
        behind = samples - core.saved[k, C_COUNT]
        if behind > len(core.ring_t) - RING_SIZE:
            return -1
        if core.saved_t[k] < t or (core.saved_t[k] == t and behind > 0):
            return int(number)
        number -= 1
    return -1


@kernel()
def restore(core: Core, number: int) -> None:
    """Go back to a snapshot; later ones are forgotten."""
    k = number % len(core.saved_t)
    for i in range(len(core.kept)):
        core.kept[i] = core.saved[k, i]
    core.saves[S_NEWEST] = number
