"""Kernels of frames: points from axes to axes, and along with a vehicle that moves. Arrays in and out."""

import math

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel

STRAIGHT = 1e-9
"""Slower than that nothing turns, rad/s."""


@kernel()
def transform(xyz: NDArray[np.float32], T: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Write to out (N, 3) what T (4, 4) makes of xyz (N, 3)."""
    for i in range(len(xyz)):
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        for row in range(3):
            out[i, row] = T[row, 0] * x + T[row, 1] * y + T[row, 2] * z + T[row, 3]


@kernel()
def carry(
    p: NDArray[np.float64],
    dt: NDArray[np.float64],
    v: NDArray[np.float64],
    turn_rate: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Write to out (N, 3) where points p (N, 3) of body axes dt (N,) s later lie in those of now.

    The body moves on by v (3,) m/s and turn_rate (3,) rad/s: the exponential of its twist (Rodrigues).
    """
    rate = math.sqrt(turn_rate[0] ** 2 + turn_rate[1] ** 2 + turn_rate[2] ** 2)
    still = 1.0 if rate < STRAIGHT else 1.0 / rate
    ax, ay, az = turn_rate[0] * still, turn_rate[1] * still, turn_rate[2] * still
    ahead = ax * v[0] + ay * v[1] + az * v[2]
    cx, cy, cz = ay * v[2] - az * v[1], az * v[0] - ax * v[2], ax * v[1] - ay * v[0]
    for i in range(len(p)):
        x, y, z, t = p[i, 0], p[i, 1], p[i, 2], dt[i]
        if rate < STRAIGHT:
            out[i, 0], out[i, 1], out[i, 2] = x + v[0] * t, y + v[1] * t, z + v[2] * t
            continue
        s, c = math.sin(rate * t), 1.0 - math.cos(rate * t)
        along = ax * x + ay * y + az * z
        far = ahead * t - ahead * s / rate
        out[i, 0] = x + s * (ay * z - az * y) + c * (along * ax - x) + (s * v[0] + c * cx) / rate + ax * far
        out[i, 1] = y + s * (az * x - ax * z) + c * (along * ay - y) + (s * v[1] + c * cy) / rate + ay * far
        out[i, 2] = z + s * (ax * y - ay * x) + c * (along * az - z) + (s * v[2] + c * cz) / rate + az * far
