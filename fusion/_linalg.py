"""Vectors, quaternions and 3x3 matrices of scalars for the kernels: tuples stay in registers."""

import math

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""Row-major 3x3."""


@kernel()
def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel()
def axpy(scale: float, x: Vector, y: Vector) -> Vector:
    """scale x + y."""
    return scale * x[0] + y[0], scale * x[1] + y[1], scale * x[2] + y[2]


@kernel()
def blend(a: Vector, b: Vector, weight: float) -> Vector:
    """a + weight (b - a)."""
    return a[0] + weight * (b[0] - a[0]), a[1] + weight * (b[1] - a[1]), a[2] + weight * (b[2] - a[2])


@kernel()
def matvec(m: Matrix, v: Vector) -> Vector:
    """M v."""
    return (
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
        m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
    )


@kernel()
def matvec_t(m: Matrix, v: Vector) -> Vector:
    """M' v."""
    return (
        m[0] * v[0] + m[3] * v[1] + m[6] * v[2],
        m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
        m[2] * v[0] + m[5] * v[1] + m[8] * v[2],
    )


@kernel()
def rotation(q: Quaternion) -> Matrix:
    """Row-major R of a unit quaternion xyzw."""
    x, y, z, w = q
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz = x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    return (
        1.0 - 2.0 * (yy + zz),
        2.0 * (xy - wz),
        2.0 * (xz + wy),
        2.0 * (xy + wz),
        1.0 - 2.0 * (xx + zz),
        2.0 * (yz - wx),
        2.0 * (xz - wy),
        2.0 * (yz + wx),
        1.0 - 2.0 * (xx + yy),
    )


@kernel()
def attitude(nav: NDArray[np.float64]) -> Matrix:
    """R_enu_body of nav (17,)."""
    r: Matrix = rotation((nav[6], nav[7], nav[8], nav[9]))
    return r


@kernel()
def exp_q(v: Vector) -> Quaternion:
    """Unit quaternion xyzw of a rotation vector, rad."""
    angle2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if angle2 < 1e-2:  # series: the next term is below 1e-16 relative
        k = 0.5 - angle2 * (1.0 / 48.0 - angle2 * (1.0 / 3840.0 - angle2 * (1.0 / 645120.0 - angle2 / 185794560.0)))
        w = 1.0 - angle2 * (0.125 - angle2 * (1.0 / 384.0 - angle2 * (1.0 / 46080.0 - angle2 / 10321920.0)))
    else:
        angle = math.sqrt(angle2)
        k = math.sin(0.5 * angle) / angle
        w = math.cos(0.5 * angle)
    return k * v[0], k * v[1], k * v[2], w


@kernel()
def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product a b, xyzw."""
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@kernel()
def normalize(q: Quaternion) -> Quaternion:
    """q / |q|, by one Newton step near 1 (|q|^2 within 1e-4 gives 1e-9; applied every step it converges)."""
    n2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    k = 1.5 - 0.5 * n2 if abs(n2 - 1.0) < 1e-4 else 1.0 / math.sqrt(n2)
    return q[0] * k, q[1] * k, q[2] * k, q[3] * k
