"""Batch rotations over scipy: quaternions xyzw, Euler angles roll-pitch-yaw (R = Rz Ry Rx), angles in radians."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from sensors.errors import EgolocError

Floats = NDArray[np.float64]


def wrap(angle: ArrayLike) -> Floats:
    """Angles in [-pi, pi)."""
    result: Floats = (np.asarray(angle, np.float64) + np.pi) % (2 * np.pi) - np.pi
    return result


def q_from_rpy(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> Floats:
    """(N, 4) xyzw quaternions of Rz(yaw) Ry(pitch) Rx(roll)."""
    angles = np.stack(np.broadcast_arrays(np.atleast_1d(yaw), pitch, roll), axis=-1)
    result: Floats = Rotation.from_euler("ZYX", angles).as_quat()
    return result


def rpy_from_q(q: ArrayLike) -> Floats:
    """(N, 3) roll, pitch, yaw of (N, 4) xyzw quaternions, without scipy's warning at pitch +-90 deg; NaN rows stay."""
    x, y, z, w = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    return np.stack((roll, pitch, yaw_from_q(q)), axis=-1)


def yaw_from_q(q: ArrayLike) -> Floats:
    """(N,) yaw of (N, 4) xyzw quaternions; NaN rows stay NaN."""
    x, y, z, w = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    result: Floats = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return result


def matrix_from_q(q: ArrayLike) -> Floats:
    """(N, 3, 3) matrices of (N, 4) xyzw quaternions; a NaN quaternion gives a NaN matrix."""
    x, y, z, w = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    s = 2.0 / (x * x + y * y + z * z + w * w)
    rows = (
        (1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
        (s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)),
        (s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def q_from_matrix(matrix: ArrayLike) -> Floats:
    """(N, 4) xyzw quaternions of (N, 3, 3) matrices."""
    result: Floats = Rotation.from_matrix(np.asarray(matrix, np.float64)).as_quat()
    return result


def multiply(q_a_b: ArrayLike, q_b_c: ArrayLike) -> Floats:
    """(N, 4) xyzw Hamilton product q_a_c = q_a_b q_b_c; NaN rows stay NaN."""
    x1, y1, z1, w1 = np.moveaxis(np.asarray(q_a_b, np.float64), -1, 0)
    x2, y2, z2, w2 = np.moveaxis(np.asarray(q_b_c, np.float64), -1, 0)
    return np.stack(
        (
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        ),
        axis=-1,
    )


def rotate(q_a_b: ArrayLike, v_b: ArrayLike) -> Floats:
    """(N, 3) vectors v_a = R_a_b v_b."""
    result: Floats = np.einsum("...ij,...j->...i", matrix_from_q(q_a_b), np.asarray(v_b, np.float64))
    return result


def interpolate_q(t: ArrayLike, t_known: ArrayLike, q_known: ArrayLike) -> Floats:
    """(M, 4) quaternions at t by normalized linear interpolation (short arc) between neighbours of increasing t_known.

    Times outside are clamped. Against slerp the error is below 1e-6 rad for steps of 2 deg.
    """
    t, t_known = np.asarray(t), np.asarray(t_known)
    q = np.asarray(q_known, np.float64)
    left = np.clip(np.searchsorted(t_known, t, side="right") - 1, 0, max(len(t_known) - 2, 0))
    right = np.minimum(left + 1, len(t_known) - 1)
    span = np.maximum(t_known[right] - t_known[left], 1)
    weight = np.clip((t - t_known[left]) / span, 0.0, 1.0)[:, None]
    a, b = q[left], q[right]
    b = np.where(np.sum(a * b, axis=1, keepdims=True) < 0, -b, b)
    mixed = (1 - weight) * a + weight * b
    result: Floats = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
    return result


def check_rigid(name: str, T: Floats) -> None:
    """Raise EgolocError, naming it, unless a (4, 4) matrix turns and shifts, and does nothing else."""
    R = T[:3, :3]
    turns = np.isfinite(T).all() and np.abs(R @ R.T - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0.0
    if not (turns and (T[3] == (0.0, 0.0, 0.0, 1.0)).all()):
        raise EgolocError(f"{name}: expected a rigid transform, got {T.tolist()}")
