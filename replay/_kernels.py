"""Loops over a reference and over outputs (numba): arrays in and out."""

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
    latest = np.iinfo(np.int64).max  # the first time is searched for, wherever it lies
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
def attitude_between(known: Nanoseconds, q: Floats, t_ns: Nanoseconds, left: NDArray[np.int64]) -> Floats:
    """(N, 4) quaternions at t_ns (N,) by normalized linear interpolation (short arc) from row left (N,) to the next."""
    n, rows = len(t_ns), len(known)
    out = np.empty((n, 4))
    for i in range(n):
        a, b = left[i], min(left[i] + 1, rows - 1)
        weight = min(max((t_ns[i] - known[a]) / max(known[b] - known[a], 1), 0.0), 1.0)
        dot = 0.0
        for k in range(4):
            dot += q[a, k] * q[b, k]
        other = -weight if dot < 0.0 else weight
        square = 0.0
        for k in range(4):
            out[i, k] = (1.0 - weight) * q[a, k] + other * q[b, k]
            square += out[i, k] ** 2
        norm = np.sqrt(square) if square > 0.0 else np.nan
        for k in range(4):
            out[i, k] /= norm
    return out


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


@kernel()
def sum_outputs(
    t_ns: Nanoseconds,
    cover_ns: Nanoseconds,
    cell: NDArray[np.int64],
    error: Floats,
    grid_ns: Nanoseconds,
    grid_cover_ns: Nanoseconds,
    grid_cell: NDArray[np.int64],
    grid_speed: Floats,
    limits: Floats,
    thresholds: Floats,
    times: Nanoseconds,
    metres: Floats,
    counts: NDArray[np.int64],
    sums: Floats,
    scored: NDArray[np.bool_],
) -> None:
    """Add outputs (N,), in time order, to the sums of their cells.

    Each stands for ]t - cover, t]; error (N, 3) m, m, deg, a NaN lon: no reference there; grid (G,): the evaluated
    epochs, in time order, each ]t - cover, t] too, with the reference's speed m/s; limits (3,), thresholds (3, 3): m,
    m, deg. Into: times (C, 4) ns and metres (C, 4) of the grid that outputs without reference, with one, within all
    limits and within those of position stand for; counts (C, 3, 4) of outputs, and below each threshold; sums (C, 3, 3)
    of |e|, of e^2 and the largest |e|; scored (N,): which outputs stand for any of the grid and have errors.
    """
    first = 0
    for i in range(len(t_ns)):
        begin = t_ns[i] - cover_ns[i]
        unknown = np.isnan(error[i, 0])
        known = not unknown and not np.isnan(error[i, 1])
        near = known and abs(error[i, 0]) < limits[0] and abs(error[i, 1]) < limits[1]
        good = near and abs(error[i, 2]) < limits[2]
        while first < len(grid_ns) and grid_ns[first] <= begin:
            first += 1
        k = first
        while k < len(grid_ns) and grid_ns[k] - grid_cover_ns[k] < t_ns[i]:
            shared = min(t_ns[i], grid_ns[k]) - max(begin, grid_ns[k] - grid_cover_ns[k])
            if shared > 0:
                path, c = 1e-9 * shared * grid_speed[k], grid_cell[k]
                scored[i] = known
                for column, holds in enumerate((unknown, known, good, near)):
                    if holds:
                        times[c, column] += shared
                        metres[c, column] += path
            k += 1
        if scored[i]:
            for axis in range(3):
                size = abs(error[i, axis])
                if np.isnan(size):
                    continue
                counts[cell[i], axis, 0] += 1
                for j in range(3):
                    counts[cell[i], axis, 1 + j] += size < thresholds[axis, j]
                sums[cell[i], axis, 0] += size
                sums[cell[i], axis, 1] += size * size
                sums[cell[i], axis, 2] = max(sums[cell[i], axis, 2], size)


@kernel(allocates=True)
def turn_states(R_map_enu: Floats, scale: Floats, q: Floats, cov: Floats) -> tuple[Floats, Floats]:
    """States from ENU to map axes: R_map_body (N, 3, 3) and the covariance (N, 6, 6) of position and attitude.

    R_map_enu: (N, 3, 3); scale: (N,) of the map's plane; q: (N, 4) q_enu_body; cov: (N, 6, 6), position ENU, attitude.
    """
    n = len(q)
    R_map_body, turned = np.empty((n, 3, 3)), np.empty((n, 6, 6))
    R_enu_body, plane, half = np.empty((3, 3)), np.empty((3, 3)), np.empty((6, 6))
    for i in range(n):
        R = R_map_enu[i]
        _matrix(q[i], R_enu_body)
        for row in range(3):
            factor = scale[i] if row < 2 else 1.0
            for column in range(3):
                plane[row, column] = factor * R[row, column]
                total = 0.0
                for k in range(3):
                    total += R[row, k] * R_enu_body[k, column]
                R_map_body[i, row, column] = total
        for row in range(3):
            for column in range(6):
                position = attitude = 0.0
                for k in range(3):
                    position += plane[row, k] * cov[i, k, column]
                    attitude += R[row, k] * cov[i, 3 + k, column]
                half[row, column], half[3 + row, column] = position, attitude
        for row in range(6):
            for column in range(3):
                position = attitude = 0.0
                for k in range(3):
                    position += half[row, k] * plane[column, k]
                    attitude += half[row, 3 + k] * R[column, k]
                turned[i, row, column], turned[i, row, 3 + column] = position, attitude
    return R_map_body, turned


@kernel(allocates=True)
def axis_sigmas(cov: Floats, arm: Floats, heading: Floats) -> Floats:
    """(2, N) m, standard deviation along and left of a heading (N,) of a point of the body at arm (N, 3), map axes.

    cov: (N, 6, 6) of position and attitude (left error: the point moves by dp + dtheta x arm).
    """
    n = len(cov)
    sigma = np.empty((2, n))
    G, GP = np.zeros((2, 6)), np.empty((2, 6))
    G[0, 0] = G[1, 1] = 1.0
    for i in range(n):
        G[0, 4], G[0, 5] = arm[i, 2], -arm[i, 1]
        G[1, 3], G[1, 5] = -arm[i, 2], arm[i, 0]
        for row in range(2):
            for column in range(6):
                total = 0.0
                for k in range(6):
                    total += G[row, k] * cov[i, k, column]
                GP[row, column] = total
        a = b = d = 0.0
        for k in range(6):
            a += GP[0, k] * G[0, k]
            b += GP[0, k] * G[1, k]
            d += GP[1, k] * G[1, k]
        c, s = np.cos(heading[i]), np.sin(heading[i])
        along, left = c * c * a + 2 * c * s * b + s * s * d, s * s * a - 2 * c * s * b + c * c * d
        sigma[0, i] = np.sqrt(along) if along >= 0.0 else np.nan
        sigma[1, i] = np.sqrt(left) if left >= 0.0 else np.nan
    return sigma


@kernel()
def _matrix(q: Floats, out: Floats) -> None:
    """Into out (3, 3): the matrix of a quaternion xyzw."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    s = 2.0 / (x * x + y * y + z * z + w * w)
    out[0, 0], out[0, 1], out[0, 2] = 1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)
    out[1, 0], out[1, 1], out[1, 2] = s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)
    out[2, 0], out[2, 1], out[2, 2] = s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)


@kernel()
def sum_drawn(weights: Floats, pair: NDArray[np.int64], columns: Floats, totals: Floats, block: int) -> None:
    """Add rows (R, K) of columns to totals (C, K), each weights (C, P) times, by its pair (R,).

    block: so many rows are read at a time, for all C: they should stay in the processor's cache. Four rows at once:
    otherwise reading and writing the totals takes most of the time.
    """
    for begin in range(0, len(pair), block):
        end = min(begin + block, len(pair))
        fours = begin + (end - begin) // 4 * 4
        for c in range(len(weights)):
            for i in range(begin, fours, 4):
                w0, w1 = weights[c, pair[i]], weights[c, pair[i + 1]]
                w2, w3 = weights[c, pair[i + 2]], weights[c, pair[i + 3]]
                for k in range(columns.shape[1]):
                    near = w0 * columns[i, k] + w1 * columns[i + 1, k]
                    totals[c, k] += near + (w2 * columns[i + 2, k] + w3 * columns[i + 3, k])
            for i in range(fours, end):
                for k in range(columns.shape[1]):
                    totals[c, k] += weights[c, pair[i]] * columns[i, k]
