"""Loops over a reference (numba): arrays in and out."""

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]


@kernel(allocates=True)
def sample_track(
    known: Nanoseconds, p: Floats, t_ns: Nanoseconds, gap_ns: int, base_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.bool_], Floats, Floats]:
    """A track of rows (known (K,), p (K, 3)) at times t_ns (N,), fastest where these increase.

    Returns the row before each time (N,), whether the time lies on a row or between two that are no gap apart (N,),
    the position (N, 3) and the mean velocity (N, 3) over base_ns each way, within the rows between two gaps.
    """
    n, rows = len(t_ns), len(known)
    left, inside = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    position, velocity = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    before, after = np.empty(3), np.empty(3)
    row = first = last = 0  # at t, and where the base begins and ends
    latest = known[0]
    for i in range(n):
        t = t_ns[i]
        if t < known[0] or t > known[rows - 1]:
            continue
        if t < latest:
            row = first = last = np.searchsorted(known, t, side="right") - 1
            while first > 0 and known[first] > t - base_ns and known[first] - known[first - 1] <= gap_ns:
                first -= 1
        latest = t
        while row + 1 < rows and known[row + 1] <= t:
            if known[row + 1] - known[row] > gap_ns:
                first = row + 1
            row += 1
        left[i] = row
        inside[i] = t == known[row] or known[row + 1] - known[row] <= gap_ns
        if not inside[i]:
            continue
        while first < row and known[first + 1] <= t - base_ns:
            first += 1
        last = max(last, row)
        while last + 1 < rows and known[last] < t + base_ns and known[last + 1] - known[last] <= gap_ns:
            last += 1
        start, end = max(t - base_ns, known[first]), min(t + base_ns, known[last])
        _hermite(known, p, row, t, gap_ns, position[i])
        if end > start:
            _hermite(known, p, first, start, gap_ns, before)
            _hermite(known, p, max(last - 1, 0), end, gap_ns, after)
            for axis in range(3):
                velocity[i, axis] = (after[axis] - before[axis]) / (1e-9 * (end - start))
    return left, inside, position, velocity


@kernel(allocates=True)
def _hermite(known: Nanoseconds, p: Floats, row: int, t: int, gap_ns: int, out: Floats) -> None:
    """Into out (3,): the cubic between row and the next, its end velocities those of parabolas through three rows.

    Beside a gap the end velocity is that of the one parabola left, or of the straight line.
    """
    if t == known[row]:
        out[:] = p[row]
        return
    h = 1e-9 * (known[row + 1] - known[row])
    u = 1e-9 * (t - known[row]) / h
    joined_left = row > 0 and known[row] - known[row - 1] <= gap_ns
    joined_right = row + 2 < len(known) and known[row + 2] - known[row + 1] <= gap_ns
    for axis in range(3):
        slope = (p[row + 1, axis] - p[row, axis]) / h
        v0 = v1 = slope
        if joined_left:
            width = 1e-9 * (known[row] - known[row - 1])
            v0 = (h * (p[row, axis] - p[row - 1, axis]) / width + width * slope) / (h + width)
        if joined_right:
            width = 1e-9 * (known[row + 2] - known[row + 1])
            v1 = (h * (p[row + 2, axis] - p[row + 1, axis]) / width + width * slope) / (h + width)
        if joined_left and not joined_right:
            v1 = 2 * slope - v0
        if joined_right and not joined_left:
            v0 = 2 * slope - v1
        bend = u * (1 - u) * ((1 - u) * (v0 - slope) - u * (v1 - slope))
        out[axis] = p[row, axis] + h * (u * slope + bend)
