"""Kernel of placing: each point brought into the map by the pose of its own moment. Arrays in and out."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@kernel()
def place_points(
    xyz: Floats, frame_ns: int, offset_ns: Any, t_ns: Ints, p: Floats, R: Floats, turn: Floats, out: Floats
) -> None:
    """Write (N, 3) points in the map of xyz (N, 3) in the body, measured at frame_ns + offset_ns (N,).

    Poses p (T, 3), R (T, 3, 3) at t_ns (T,); turn: (T - 1, 4) axis (in the body) and angle from each pose to the next.
    Between poses the place is linear and the attitude turns evenly; before the first and after the last both stand.
    """
    last = len(t_ns) - 2
    k = 0
    for n in range(len(xyz)):
        t = frame_ns + offset_ns[n]
        if t < t_ns[k] or t >= t_ns[k + 1]:
            k = min(max(np.searchsorted(t_ns, t, side="right") - 1, 0), last)
        w = min(max((t - t_ns[k]) / (t_ns[k + 1] - t_ns[k]), 0.0), 1.0)
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        ax, ay, az = turn[k, 0], turn[k, 1], turn[k, 2]
        c, s = math.cos(w * turn[k, 3]), math.sin(w * turn[k, 3])
        along = (1.0 - c) * (ax * x + ay * y + az * z)
        u0 = c * x + s * (ay * z - az * y) + along * ax
        u1 = c * y + s * (az * x - ax * z) + along * ay
        u2 = c * z + s * (ax * y - ay * x) + along * az
        for i in range(3):
            base = p[k, i] + w * (p[k + 1, i] - p[k, i])
            out[n, i] = base + R[k, i, 0] * u0 + R[k, i, 1] * u1 + R[k, i, 2] * u2
