"""Kernels of voxels: points into moments through a hash table, moments of windows of voxels. Arrays in and out.

A voxel's moments are (10,) count, sums of x, y, z and of xx, xy, xz, yy, yz, zz, m from the voxel's middle: so large
coordinates cost no digits. Table: slots (2^k, 2) int64 key and row, row -1: free; keys (M,) int64 by row.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FREE = -1
FULL, WRONG = -1, -2
"""Instead of a row: the table must grow; the point is not finite or too far."""
X_BITS, Z_BITS = 24, 15
"""Of a voxel's place, x or y and z; half of them on either side of the origin."""
MIX = 0x1E3779B97F4A7C15
"""Odd, its bits as good as random."""
MARGIN = 16
"""Places at the border that are not used: a window reaches no farther."""
HALF_X, HALF_Z = 1 << (X_BITS - 1), 1 << (Z_BITS - 1)


@kernel(inline="always")
def key_of(i: int, j: int, k: int) -> int:
    """One number of a voxel's place."""
    return ((i + HALF_X) << (X_BITS + Z_BITS)) | ((j + HALF_X) << Z_BITS) | (k + HALF_Z)


@kernel(inline="always")
def _slot(slots: Ints, key: int) -> int:
    """Where a key stands in the table, or would."""
    mask = len(slots) - 1
    mixed = key * MIX
    mixed = (mixed ^ (mixed >> 32)) * MIX  # a product carries only upwards: x must reach the low bits as well
    slot = (mixed ^ (mixed >> 32)) & mask
    while slots[slot, 1] != FREE and slots[slot, 0] != key:
        slot = (slot + 1) & mask
    return slot


@kernel(inline="always")
def _row(slots: Ints, keys: Ints, used: int, key: int) -> int:
    """Row of a voxel, `used` for a new one, FULL where there is no room."""
    slot = _slot(slots, key)
    if slots[slot, 1] == FREE:
        if used == len(keys) or 2 * used >= len(slots):
            return FULL
        slots[slot, 0], slots[slot, 1] = key, used
        keys[used] = key
        return used
    return int(slots[slot, 1])


@kernel()
def add_points(
    xyz: Floats,
    begin: int,
    voxel: float,
    origin: Ints,
    t_ns: int,
    apart_ns: int,
    slots: Ints,
    keys: Ints,
    moments: Floats,
    seen_ns: Ints,
    sightings: Any,
    used: int,
) -> tuple[int, int, int]:
    """Add points xyz[begin:] of the moment t_ns; returns the first point not added, voxels used, and the last row.

    origin: (3,) the voxel that places count from. seen_ns: (M,) the latest sighting that was counted; one counts when
    it comes apart_ns or more after the one before. The last row is FULL or WRONG where it stopped.
    """
    most_x, most_z = HALF_X - MARGIN, HALF_Z - MARGIN
    per_m = 1.0 / voxel
    last_key, row = -1, 0
    for n in range(begin, len(xyz)):
        fi = np.floor(xyz[n, 0] * per_m)
        fj = np.floor(xyz[n, 1] * per_m)
        fk = np.floor(xyz[n, 2] * per_m)
        a, b, c = fi - origin[0], fj - origin[1], fk - origin[2]
        if not (abs(a) < most_x and abs(b) < most_x and abs(c) < most_z):
            return n, used, WRONG
        key = key_of(int(a), int(b), int(c))
        if key != last_key:
            row = _row(slots, keys, used, key)
            if row == FULL:
                return n, used, FULL
            last_key = key
            new = row == used
            if new:
                used += 1
            if new or t_ns >= seen_ns[row] + apart_ns:
                seen_ns[row] = t_ns
                sightings[row] += 1
        x = xyz[n, 0] - (fi + 0.5) * voxel
        y = xyz[n, 1] - (fj + 0.5) * voxel
        z = xyz[n, 2] - (fk + 0.5) * voxel
        m = moments[row]
        m[0] += 1.0
        m[1] += x
        m[2] += y
        m[3] += z
        m[4] += x * x
        m[5] += x * y
        m[6] += x * z
        m[7] += y * y
        m[8] += y * z
        m[9] += z * z
    return len(xyz), used, row


@kernel()
def enter_keys(slots: Ints, keys: Ints, used: int) -> None:
    """Fill an empty table with the rows in use."""
    for row in range(used):
        slot = _slot(slots, keys[row])
        slots[slot, 0], slots[slot, 1] = keys[row], row


@kernel()
def add_windows(
    slots: Ints,
    rows: Ints,
    keys: Ints,
    moments: Floats,
    kept: Any,
    voxel: float,
    reach: int,
    least: float,
    corners: Ints,
    out: Floats,
) -> int:
    """Write keys (W,) of the least corners and moments (W, 10) of windows of reach^3 voxels; returns how many.

    Those with `least` points or more whose first voxel that counts is one of rows (R,): so each window comes once.
    Moments count from the middle of the corner voxel. kept: (M,) bool, voxels that count. Room for R reach^3 windows.
    """
    written = 0
    size = reach * reach * reach
    for row in rows:
        for shift in range(size):
            corner = keys[row] - _step(shift, reach)
            out[written] = 0.0
            own = False
            for member in range(size):
                # neighbours' keys differ by fixed numbers: the outermost places are never used
                other = slots[_slot(slots, corner + _step(member, reach)), 1]
                if other == FREE or not kept[other]:
                    continue
                if not own and other != row:
                    break
                own = True
                i, j, k = member // (reach * reach), member // reach % reach, member % reach
                _add_shifted(moments[other], i * voxel, j * voxel, k * voxel, out[written])
            if own and out[written, 0] >= least:
                corners[written] = corner
                written += 1
    return written


@kernel(inline="always")
def _step(member: int, reach: int) -> int:
    """From the key of a window's least corner to that of one of its voxels."""
    i, j, k = member // (reach * reach), member // reach % reach, member % reach
    return (i << (X_BITS + Z_BITS)) + (j << Z_BITS) + k


@kernel(inline="always")
def _add_shifted(m: Any, dx: float, dy: float, dz: float, out: Any) -> None:
    """Add moments that count from a place (dx, dy, dz) away."""
    n, x, y, z = m[0], m[1], m[2], m[3]
    out[0] += n
    out[1] += x + n * dx
    out[2] += y + n * dy
    out[3] += z + n * dz
    out[4] += m[4] + 2.0 * dx * x + n * dx * dx
    out[5] += m[5] + dx * y + dy * x + n * dx * dy
    out[6] += m[6] + dx * z + dz * x + n * dx * dz
    out[7] += m[7] + 2.0 * dy * y + n * dy * dy
    out[8] += m[8] + dy * z + dz * y + n * dy * dz
    out[9] += m[9] + 2.0 * dz * z + n * dz * dz
