"""The latest second of a drive, for a filter that may have to go back: IMU samples, and events in stamp order.

``fusion.snapshots`` keeps the state over that second; the kernel of ``fusion.arrival`` plays samples and events again.
"""

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion.events import MOTION, Events, Measurements
from fusion.sources import Sources, put
from fusion.state import Floats, Nanoseconds
from sensors.clock import NS_PER_S
from sensors.records import Imu

Code = TypeVar("Code", np.int8, np.int64)
Number = TypeVar("Number", np.int64, np.float64)

EVENTS = 8192
"""Events in a second of history; with more of them it is shorter."""
NEW = 4096
"""Measurements that come in one call."""
PLAYED = 64
"""IMU samples, and measurements due at the same time, that are taken at a time."""
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
    M_DECIDED,
) = range(12)

# columns of History.inbox
I_T, I_KIND, I_ROW, I_VERDICT, I_DUE, I_ARRIVAL, I_LOG_ROW = range(7)


class Samples(NamedTuple):
    """IMU samples: t (N,) ns, gyro (N, 3) rad/s, accel (N, 3) m/s^2."""

    t: Nanoseconds
    gyro: Floats
    accel: Floats


class History(NamedTuple):
    """What the filter plays again.

    mark (12,) int64: IMU samples so far, events, the first event not met, free rows, the next output and motion tick
    ns, their periods ns (0: none), time of the first state ns, outputs up to this time are not recorded ns, length ns;
    motion ticks up to this time were decided before a new start ns.
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


def columns_for(m: Measurements, length_s: float) -> Measurements:
    """Columns like those of m, with as many rows as a history of so many seconds needs."""
    return Measurements(*(np.zeros((_events_in(length_s) + NEW, *column.shape[1:])) for column in m))


def new_history(ring: int, columns: Measurements, length_s: float) -> History:
    """An empty history. ring: slots of Core.ring; columns: of ``columns_for``."""
    size = _events_in(length_s)
    samples = Samples(np.zeros(ring, np.int64), np.zeros((ring, 3)), np.zeros((ring, 3)))
    mark = np.zeros(12, np.int64)
    mark[M_LENGTH], mark[M_FREE] = round(length_s * NS_PER_S), size + NEW
    return History(
        mark=mark,
        samples=samples,
        played=Samples(read_only(samples.t), read_only(samples.gyro), read_only(samples.accel)),
        events=Events(
            np.zeros(size, np.int64), np.zeros(size, np.int8), np.zeros(size, np.int64), np.zeros(size, np.int8)
        ),
        arrival_ns=np.zeros(size, np.int64),
        log_row=np.zeros(size, np.int64),
        m=Measurements(*(read_only(column) for column in columns)),
        free=np.arange(size + NEW),
        inbox=np.zeros((NEW, 7), np.int64),
    )


def _events_in(length_s: float) -> int:
    return 1 << (max(EVENTS, round(EVENTS * length_s)) - 1).bit_length()


def enter(history: History, columns: Measurements, found: Sources, due: Nanoseconds) -> int:
    """Put measurements (M,), due at these times, into the inbox and into free rows of the columns; returns M."""
    mark, inbox, count = history.mark, history.inbox, len(found.t_ns)
    if count == 0:
        return 0
    mark[M_FREE] -= count
    rows = history.free[mark[M_FREE] : mark[M_FREE] + count]
    put(found, columns, rows)
    inbox[:count, I_T], inbox[:count, I_KIND], inbox[:count, I_ROW] = found.t_ns, found.kind, rows
    inbox[:count, I_VERDICT], inbox[:count, I_DUE] = found.verdict, due
    inbox[:count, I_ARRIVAL], inbox[:count, I_LOG_ROW] = found.arrival_ns, found.log_row
    return count


def waiting(history: History) -> Sources:
    """The measurements that are not met: the IMU has not reached them, or the filter gave up at the first of them."""
    first, e = int(history.mark[M_NEXT]), history.events
    rows = first + np.flatnonzero(e.kind[first : int(history.mark[M_EVENTS])] < MOTION)
    stamps = e.t[rows], history.arrival_ns[rows], e.kind[rows], e.row[rows], history.log_row[rows], e.verdict[rows]
    return Sources(history.m, *stamps)


def unplayed(history: History, played: int) -> Imu:
    """The samples in the ring after so many that were played."""
    ring = history.samples
    k = np.arange(played, history.mark[M_SAMPLES]) & (len(ring.t) - 1)
    return Imu(ring.t[k], ring.t[k], ring.gyro[k], ring.accel[k])


def with_room(history: History, more: int) -> History:
    """The history with room for so many more events that wait for the IMU: a long gap is full of outputs."""
    needed = int(history.mark[M_EVENTS] - history.mark[M_NEXT]) + more
    if 4 * needed <= 3 * len(history.arrival_ns):
        return history
    size, e = 1 << (2 * needed).bit_length(), history.events
    arrival_ns, log_row = _longer(history.arrival_ns, size), _longer(history.log_row, size)
    events = Events(_longer(e.t, size), _longer(e.kind, size), _longer(e.row, size), _longer(e.verdict, size))
    return history._replace(events=events, arrival_ns=arrival_ns, log_row=log_row)


def _longer(column: NDArray[Code], size: int) -> NDArray[Code]:
    longer = np.zeros(max(size, len(column)), column.dtype)
    longer[: len(column)] = column
    return longer


def read_only(array: NDArray[Number]) -> NDArray[Number]:
    """The same numbers, contiguous and not to be written."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view
