"""An IMU's CSV as RTKLIB's str2str logged it, with its time tag file.

Rows, without header: accelerations (g), rates (deg/s) and the IMU's own millisecond counter. The tag file says when the
logging computer had received which byte (stream.c: 60 bytes "TIMETAG RTKLIB ...", uint32 tick, uint32 time_t and double
fraction of the start in GPS time, then pairs of uint32 tick in ms and uint32 file size). The counter is laid under the
earliest arrivals, so that neither logging jitter nor the counter's drift enters the stamps.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors._kernels import STANDARD_GRAVITY
from sensors.clock import GPS_EPOCH_NS, NS_PER_S, utc_from_gps
from sensors.errors import EgolocError
from sensors.records import Imu, LeftOut
from sensors.screening import screen

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TimeTag:
    """start_ns: UTC of tick 0; tick_ms: (K,) when the file had size_bytes (K,)."""

    start_ns: int
    tick_ms: NDArray[np.int64]
    size_bytes: NDArray[np.int64]


def read_tag(path: Path) -> TimeTag:
    """An RTKLIB time tag file with 4-byte file positions."""
    data = path.read_bytes()
    if not data.startswith(b"TIMETAG RTKLIB") or len(data) < 84:
        raise EgolocError(f"{path}: expected an RTKLIB time tag file of at least one entry, got {len(data)} bytes")
    whole = int(np.frombuffer(data, "<u4", 1, 64)[0])
    fraction = float(np.frombuffer(data, "<f8", 1, 68)[0])
    entries = np.frombuffer(data[76 : 76 + (len(data) - 76) // 8 * 8], "<u4").reshape(-1, 2).astype(np.int64)
    gps = whole * NS_PER_S + round(fraction * 1e9) - GPS_EPOCH_NS
    start = int(utc_from_gps(np.array([gps]))[0])
    return TimeTag(start, entries[:, 0], entries[:, 1])


def read_imu(path: Path) -> tuple[Imu, tuple[LeftOut, ...]]:
    """IMU samples in the sensor's own axes, stamped by counter and tag; arrival_ns is when the computer had the row.

    The first and the last row may be cut off in the middle of a number and are left out.
    """
    values, ends = _imu_rows(path)
    tag = read_tag(path.with_name(path.name + ".tag"))
    counter, arrival_ms = values[:, 6], _arrival_ms(path, tag, ends)
    t_ns = tag.start_ns + np.rint(stamps_from_arrivals(counter, arrival_ms) * 1e6).astype(np.int64)
    arrival_ns = tag.start_ns + arrival_ms * 1_000_000
    keep = np.ones(len(values), bool)
    keep[[0, -1]] = False
    checks = {"first or last row of the file": keep, "not finite": np.all(np.isfinite(values), axis=1)}
    keep, left_out = screen(path.name, t_ns, arrival_ns, checks)
    if keep.sum() < 2:
        raise EgolocError(f"{path}: expected IMU rows of 7 numbers, got {len(values)}")
    accel, gyro = values[keep, :3] * STANDARD_GRAVITY, np.radians(values[keep, 3:6])
    return Imu(t_ns[keep], arrival_ns[keep], gyro, accel), left_out


def stamps_from_arrivals(counter_ms: Floats, arrival_ms: NDArray[np.int64]) -> Floats:
    """(N,) sample times, ms of the receiving clock: a line through the earliest arrivals of twenty stretches."""
    late = arrival_ms - counter_ms
    blocks = np.array_split(np.arange(len(late)), min(20, len(late)))
    earliest = np.array([block[np.argmin(late[block])] for block in blocks])
    since = counter_ms - counter_ms[0]
    slope, offset = np.polyfit(since[earliest], late[earliest], 1) if len(earliest) > 2 else (0.0, late.min())
    stamps: Floats = counter_ms + offset + slope * since
    return stamps


def _imu_rows(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    """(N, 7) numbers and (N,) position of each row's end in the file."""
    rows, ends, position, skipped = [], [], 0, 0
    for line in path.read_bytes().splitlines(keepends=True):
        position += len(line)
        try:
            row = [float(cell) for cell in line.split(b",")]
        except ValueError:
            row = []
        if len(row) == 7:
            rows.append(row)
            ends.append(position)
        else:
            skipped += 1
    if len(rows) < 3 or skipped > len(rows):
        raise EgolocError(f"{path}: expected rows ax,ay,az,gx,gy,gz,ms; {skipped} of {skipped + len(rows)} are not")
    return np.array(rows), np.array(ends, np.int64)


def _arrival_ms(path: Path, tag: TimeTag, ends: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) tick at which each row was complete. A file whose line ends were shortened from CRLF to LF is recognised."""
    shortened = int(tag.size_bytes[-1]) - int(ends[-1])
    if abs(shortened - len(ends)) <= 2:
        ends = ends + np.arange(1, len(ends) + 1)
    elif shortened < -200:
        raise EgolocError(f"{path}: the .tag file covers {tag.size_bytes[-1]} of {ends[-1]} bytes: not its tag file?")
    entry = np.minimum(np.searchsorted(tag.size_bytes, ends), len(tag.size_bytes) - 1)
    return tag.tick_ms[entry]
