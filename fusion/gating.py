"""Gates and the correction: covariance gate on a pose fix, chi-square gate on the innovation, Kalman update and reset."""

import math

import numpy as np
from numba import njit

from fusion._linalg import Quaternion, Vector, exp_q, multiply, normalize
from fusion.state import Core, Floats
from sensors._kernels import radii


@njit(cache=True)
def observed_directions(cov: Floats, limits: Vector, directions: Floats) -> int:
    """Directions that a pose fix observes, as columns of T (3, 3): the kept ones first; returns how many are kept.

    cov (3, 3): along, left, yaw; limits: largest sigma of each (m, m, rad). Eigenvectors of D^-1 R D^-1, D = diag(limits),
    with an eigenvalue of at most 1 are observed. T' D^-1 z is the fix in these directions, its covariance is diagonal.
    """
    scaled = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            scaled[i, j] = cov[i, j] / (limits[i] * limits[j])
    values, vectors = np.linalg.eigh(scaled)
    kept = 0
    for k in range(3):  # eigenvalues come in rising order
        if values[k] <= 1.0:
            kept += 1
        for i in range(3):
            directions[i, k] = vectors[i, k] / limits[i]
    return kept


@njit(cache=True)
def innovate(core: Core, dof: int, low: int, high: int, R: Floats, S: Floats, inverse: Floats) -> bool:
    """PHt = (P H')' (dof, 15), S = H P H' + R and its inverse; H is zero outside columns low..high.

    False if S is not positive definite.
    """
    H, PHt, P = core.H, core.PHt, core.P
    for i in range(dof):
        for j in range(15):
            total = 0.0
            for k in range(low, high):
                total += H[i, k] * P[k, j]
            PHt[i, j] = total
    for i in range(dof):
        for j in range(i + 1):
            total = R[i, j]
            for k in range(low, high):
                total += PHt[i, k] * H[j, k]
            S[i, j] = total
            S[j, i] = total
    if dof == 1:
        inverse[0, 0] = 1.0 / S[0, 0]
        return S[0, 0] > 0.0
    if dof == 2:
        det = S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
        inverse[0, 0], inverse[1, 1] = S[1, 1] / det, S[0, 0] / det
        inverse[0, 1] = inverse[1, 0] = -S[0, 1] / det
        return S[0, 0] > 0.0 and det > 0.0
    a = S[1, 1] * S[2, 2] - S[1, 2] * S[1, 2]
    b = S[0, 2] * S[1, 2] - S[0, 1] * S[2, 2]
    c = S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]
    det = S[0, 0] * a + S[0, 1] * b + S[0, 2] * c
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = a / det, b / det, c / det
    inverse[1, 1] = (S[0, 0] * S[2, 2] - S[0, 2] * S[0, 2]) / det
    inverse[1, 2] = (S[0, 1] * S[0, 2] - S[0, 0] * S[1, 2]) / det
    inverse[2, 2] = (S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]) / det
    inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
    return S[0, 0] > 0.0 and S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1] > 0.0 and det > 0.0


@njit(cache=True)
def nis(dof: int, residual: Floats, inverse: Floats) -> float:
    """Normalized innovation squared r' S^-1 r."""
    total = 0.0
    for i in range(dof):
        for j in range(dof):
            total += residual[i] * inverse[i, j] * residual[j]
    return total


@njit(cache=True, fastmath={"contract"})
def correct(core: Core, dof: int, residual: Floats, inverse: Floats, dx: Floats) -> None:
    """Kalman update with the last ``innovate``: dx = K r (15,), P -= K S K', then the error is moved into nav.

    Resetting the attitude error turns its axes: P is mapped by G = I + [dtheta]x / 2 (left Jacobian of SO(3), Sola 2017,
    Eq. 287 for a global error, to first order).
    """
    P, PHt = core.P, core.PHt
    K = core.M  # scratch: rows hold S^-1 H P
    for i in range(dof):
        for j in range(15):
            total = 0.0
            for k in range(dof):
                total += inverse[i, k] * PHt[k, j]
            K[i, j] = total
    for j in range(15):
        total = 0.0
        for i in range(dof):
            total += K[i, j] * residual[i]
        dx[j] = total
    for i in range(15):
        for j in range(i + 1):
            total = P[i, j]
            for k in range(dof):
                total -= PHt[k, i] * K[k, j]
            P[i, j] = total
            P[j, i] = total
    inject(core.nav, dx)
    reset(P, (0.5 * dx[6], 0.5 * dx[7], 0.5 * dx[8]))


@njit(cache=True)
def inject(nav: Floats, dx: Floats) -> None:
    """Add the error dx (15,) to nav (16,): metres to radians at the state's place, attitude on the left."""
    meridian, transverse = radii(math.sin(nav[0]))
    nav[1] += dx[0] / ((transverse + nav[2]) * math.cos(nav[0]))
    nav[0] += dx[1] / (meridian + nav[2])
    nav[2] += dx[2]
    for i in range(3):
        nav[3 + i] += dx[3 + i]
        nav[10 + i] += dx[9 + i]
        nav[13 + i] += dx[12 + i]
    q: Quaternion = (nav[6], nav[7], nav[8], nav[9])
    turn = exp_q((dx[6], dx[7], dx[8]))
    nav[6], nav[7], nav[8], nav[9] = normalize(multiply(turn, q))


@njit(cache=True)
def reset(P: Floats, half: Vector) -> None:
    """P = G P G' with G = I + [half]x on the attitude block."""
    for j in range(15):
        a, b, c = P[6, j], P[7, j], P[8, j]
        P[6, j] = a + half[1] * c - half[2] * b
        P[7, j] = b + half[2] * a - half[0] * c
        P[8, j] = c + half[0] * b - half[1] * a
    for j in range(15):
        a, b, c = P[j, 6], P[j, 7], P[j, 8]
        P[j, 6] = a + half[1] * c - half[2] * b
        P[j, 7] = b + half[2] * a - half[0] * c
        P[j, 8] = c + half[0] * b - half[1] * a
