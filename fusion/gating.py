"""Gates and the correction: covariance gate of a pose fix, chi-square gate on the innovation, update and reset."""

import math

import numpy as np
from numba import njit

from fusion._linalg import Quaternion, Vector, exp_q, multiply, normalize
from fusion.state import ROW, Floats
from sensors._kernels import radii


@njit(cache=True)
def observed_directions(H: Floats, R: Floats, residual: Floats, limits: Vector) -> int:
    """Reduce residual, H and R (along, left, yaw) to the directions that a pose fix observes; return how many.

    Eigenvectors u of D^-1 R D^-1, D = diag(limits) (m, m, rad), with an eigenvalue of at most 1 are observed.
    The rows become u' D^-1 of the old ones, so residuals are in units of the limits and R is diagonal. Where all three
    are observed nothing changes.
    """
    scaled = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            scaled[i, j] = R[i, j] / (limits[i] * limits[j])
    values, vectors = np.linalg.eigh(scaled)  # eigenvalues rise: the kept ones come first
    kept = 0
    while kept < 3 and values[kept] <= 1.0:
        kept += 1
    if kept == 3:
        return 3
    rows, z = H.copy(), residual.copy()
    H[:] = 0.0
    R[:] = 0.0
    for i in range(kept):
        R[i, i] = values[i]
        residual[i] = 0.0
        for k in range(3):
            t = vectors[k, i] / limits[k]
            residual[i] += t * z[k]
            for j in range(9):
                H[i, j] += t * rows[k, j]
    return kept


@njit(cache=True, fastmath={"contract"})
def innovate(P: Floats, H: Floats, W: Floats, dof: int, R: Floats, L: Floats) -> bool:
    """W (3, 16) = L^-1 H P with L L' = S = H P H' + R, the lower Cholesky factor; rows of H from dof on are zero.

    False if S is not positive definite.
    """
    for i in range(3):
        for j in range(ROW):
            total = 0.0
            for k in range(15):
                total += H[i, k] * P[k, j]
            W[i, j] = total
    for i in range(dof):
        for j in range(i + 1):
            total = R[i, j]
            for k in range(15):
                total += W[i, k] * H[j, k]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i != j:
                L[i, j] = total / L[j, j]
            elif total > 0.0:
                L[i, i] = math.sqrt(total)
            else:
                return False
    for i in range(dof):
        for k in range(i):
            for j in range(ROW):
                W[i, j] -= L[i, k] * W[k, j]
        inverse = 1.0 / L[i, i]
        for j in range(ROW):
            W[i, j] *= inverse
    return True


@njit(cache=True)
def whiten(dof: int, residual: Floats, L: Floats) -> float:
    """residual (3,) = L^-1 residual in place, zero from dof on; returns the normalized innovation squared."""
    residual[dof:] = 0.0
    total = 0.0
    for i in range(dof):
        for k in range(i):
            residual[i] -= L[i, k] * residual[k]
        residual[i] /= L[i, i]
        total += residual[i] * residual[i]
    return total


@njit(cache=True, fastmath={"contract"})
def correct(nav: Floats, P: Floats, W: Floats, dx: Floats, white: Floats) -> None:
    """Kalman update after ``innovate`` and ``whiten``: dx = W' w, P -= W' W, then the error is moved into nav.

    Resetting the attitude error turns its axes: P is mapped by G = I + [dtheta]x / 2, the left Jacobian of SO(3) to
    first order (Sola 2017, sec. 6.3 and 7.3, for a global error).
    """
    for j in range(ROW):
        dx[j] = white[0] * W[0, j] + white[1] * W[1, j] + white[2] * W[2, j]
    for i in range(15):
        a, b, c = W[0, i], W[1, i], W[2, i]
        for j in range(ROW):
            P[i, j] -= a * W[0, j] + b * W[1, j] + c * W[2, j]
    inject(nav, dx)
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


@njit(cache=True, fastmath={"contract"})
def reset(P: Floats, half: Vector) -> None:
    """P = G P G' with G = I + [half]x on the attitude block."""
    for j in range(ROW):
        a, b, c = P[6, j], P[7, j], P[8, j]
        P[6, j] = a + (half[1] * c - half[2] * b)
        P[7, j] = b + (half[2] * a - half[0] * c)
        P[8, j] = c + (half[0] * b - half[1] * a)
    for j in range(15):
        a, b, c = P[j, 6], P[j, 7], P[j, 8]
        P[j, 6] = a + (half[1] * c - half[2] * b)
        P[j, 7] = b + (half[2] * a - half[0] * c)
        P[j, 8] = c + (half[0] * b - half[1] * a)
