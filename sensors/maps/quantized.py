"""Numbers of a map file: centimetres, normals and ratios as small integers, and back.

What comes out of a file goes into it again unchanged.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors.errors import EgolocError

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

CM_LIMIT = 2**31 - 1
"""Largest coordinate, cm: 21,474 km, more than any map frame has."""
NORMAL_STEPS = 127
RATIO_STEPS = 255


def cm_from_m(metres: ArrayLike) -> Floats:
    """Whole centimetres, still as float64, so that NaN stays NaN; at most 0.5 cm off."""
    return np.rint(np.asarray(metres, np.float64) * 100.0)


def m_from_cm(centimetres: NDArray[Any]) -> Floats:
    """Metres."""
    return np.asarray(centimetres, np.float64) / 100.0


def bytes_from_normals(normal: Floats) -> Bytes:
    """(K, 2) of unit vectors (K, 3): octahedral coordinates of the upper half, at most 0.56 deg off.

    A plane has no side: a normal that points down is turned round. Level and upright normals come back as such.
    Raises EgolocError for vectors that are not of unit length. Source: Cigolle et al., A Survey of Efficient
    Representations for Independent Unit Vectors, JCGT 3(2), 2014.
    """
    length = np.linalg.norm(normal, axis=1)
    if (np.abs(length - 1.0) > 0.01).any():
        row = int(np.argmax(np.abs(length - 1.0)))
        raise EgolocError(f"Surfels.normal: expected unit vectors, got length {length[row]:.3g} in row {row}")
    x, y, z = normal.T
    x, y = np.stack((x, y)) * np.where(z < 0.0, -1.0, 1.0) / np.abs(normal).sum(axis=1)
    # of the upper half, |x| + |y| <= 1: a square on its corner, turned so that it fills the range
    uv = np.stack((x + y, x - y), axis=-1)
    codes: Bytes = (np.rint(NORMAL_STEPS * uv) + NORMAL_STEPS).astype(np.uint8)
    return codes


def normals_from_bytes(codes: Bytes) -> Floats:
    """(K, 3) unit vectors, z >= 0."""
    u, v = (codes.T.astype(np.float64) - NORMAL_STEPS) / NORMAL_STEPS
    x, y = (u + v) / 2.0, (u - v) / 2.0
    z = np.maximum(1.0 - np.maximum(np.abs(u), np.abs(v)), 0.0)
    normal: Floats = np.stack((x, y, z), axis=-1) / np.sqrt(x * x + y * y + z * z)[:, None]
    return normal


def bytes_from_ratios(ratios: Floats) -> Bytes:
    """(K, 2) of ratios (K, 2) within 0..1, finer where they are small: r is at most sqrt(r) / 255 + 4e-6 off.

    Raises EgolocError outside that range (by more than rounding).
    """
    wrong = ~((ratios >= -1e-6) & (ratios <= 1.0 + 1e-6))
    if wrong.any():
        row = int(np.argmax(wrong.any(axis=1)))
        raise EgolocError(f"Surfels.ratios: expected 0..1, got {ratios[wrong][0]:.6g} in row {row}")
    codes: Bytes = np.rint(RATIO_STEPS * np.sqrt(np.clip(ratios, 0.0, 1.0))).astype(np.uint8)
    return codes


def ratios_from_bytes(codes: Bytes) -> Floats:
    """(K, 2) ratios within 0..1."""
    result: Floats = (codes / RATIO_STEPS) ** 2
    return result
