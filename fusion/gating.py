"""Gates and the correction: covariance gate of a pose fix, chi-square gate on the innovation, update and reset."""

import math

from fusion._linalg import Quaternion, Vector, exp_q, multiply, normalize
from fusion.mechanization import refresh
from fusion.state import G_COS, G_HEIGHT, G_MERIDIAN, G_SIN, G_TRANSVERSE, LANE, Floats
from sensors.kernel import kernel

FAR_M = 10.0
"""A correction of more than this asks for new radii of curvature."""


@kernel()
def observed_directions(H: Floats, R: Floats, residual: Floats, limits: Vector, eigen: Floats, rows: Floats) -> int:
    """Reduce residual, H and R (along, left, yaw) to the directions that a pose fix observes; return how many.

    Eigenvectors u of D^-1 R D^-1, D = diag(limits) (m, m, rad), with an eigenvalue of at most 1 are observed.
    The rows become u' D^-1 of the old ones, so residuals are in units of the limits and R is diagonal. Where all three
    are observed nothing changes. eigen (2, 3, 3), rows (3, n): scratch.
    """
    for i in range(3):
        for j in range(3):
            eigen[0, i, j] = R[i, j] / (limits[i] * limits[j])
    diagonalize(eigen)
    kept = 0
    for k in range(3):
        if eigen[0, k, k] <= 1.0:
            kept += 1
    if kept == 3:
        return 3
    z: Vector = (residual[0], residual[1], residual[2])
    size = H.shape[1]
    for i in range(3):
        for j in range(size):
            rows[i, j] = H[i, j]
            H[i, j] = 0.0
        for j in range(3):
            R[i, j] = 0.0
    i = 0
    for k in range(3):
        if eigen[0, k, k] > 1.0:
            continue
        R[i, i] = eigen[0, k, k]
        residual[i] = 0.0
        for a in range(3):
            t = eigen[1, a, k] / limits[a]
            residual[i] += t * z[a]
            for j in range(size):
                H[i, j] += t * rows[a, j]
        i += 1
    return kept


@kernel()
def diagonalize(eigen: Floats) -> None:
    """Eigenvalues of the symmetric eigen[0] on its diagonal, eigenvectors in the columns of eigen[1]: cyclic Jacobi.

    Rotations shrink the off-diagonal quadratically; six sweeps reach rounding for any 3x3 (Golub & Van Loan, sec. 8.5).
    """
    for i in range(3):
        for j in range(3):
            eigen[1, i, j] = 1.0 if i == j else 0.0
    for _ in range(6):
        for p in range(2):
            for q in range(p + 1, 3):
                off = eigen[0, p, q]
                if off == 0.0:
                    continue
                theta = 0.5 * (eigen[0, q, q] - eigen[0, p, p]) / off
                t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    a, b = eigen[0, k, p], eigen[0, k, q]
                    eigen[0, k, p], eigen[0, k, q] = c * a - s * b, s * a + c * b
                for k in range(3):
                    a, b = eigen[0, p, k], eigen[0, q, k]
                    eigen[0, p, k], eigen[0, q, k] = c * a - s * b, s * a + c * b
                    a, b = eigen[1, k, p], eigen[1, k, q]
                    eigen[1, k, p], eigen[1, k, q] = c * a - s * b, s * a + c * b


@kernel(fastmath={"contract"})
def innovate(P: Floats, H: Floats, W: Floats, dof: int, R: Floats, L: Floats) -> bool:
    """The first dof rows of W (3, n) = L^-1 H P with L L' = S = H P H' + R, the lower Cholesky factor.

    False if S is not positive definite.
    """
    size = P.shape[0]
    for i in range(dof):
        for j in range(size):
            W[i, j] = 0.0
        for k in range(size):
            h = H[i, k]
            if h != 0.0:  # a sensor sees few of the states
                for first in range(0, size, LANE):
                    for j in range(first, first + LANE):
                        W[i, j] += h * P[k, j]
    for i in range(dof):
        for j in range(i + 1):
            total = R[i, j]
            for k in range(size):
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
            for j in range(size):
                W[i, j] -= L[i, k] * W[k, j]
        inverse = 1.0 / L[i, i]
        for j in range(size):
            W[i, j] *= inverse
    return True


@kernel()
def whiten(dof: int, residual: Floats, L: Floats) -> float:
    """residual (3,) = L^-1 residual in place, zero from dof on; returns the normalized innovation squared."""
    for i in range(dof, 3):
        residual[i] = 0.0
    total = 0.0
    for i in range(dof):
        for k in range(i):
            residual[i] -= L[i, k] * residual[k]
        residual[i] /= L[i, i]
        total += residual[i] * residual[i]
    return total


@kernel(fastmath={"contract"})
def shrink(P: Floats, W: Floats, dof: int) -> None:
    """P -= W' W over the first dof rows of W: one loop for each number of rows."""
    size = P.shape[0]
    for i in range(size):
        a, b, c = W[0, i], W[1, i], W[2, i]
        for first in range(0, size, LANE):
            if dof == 1:
                for j in range(first, first + LANE):
                    P[i, j] -= a * W[0, j]
            elif dof == 2:
                for j in range(first, first + LANE):
                    P[i, j] -= a * W[0, j] + b * W[1, j]
            else:
                for j in range(first, first + LANE):
                    P[i, j] -= a * W[0, j] + b * W[1, j] + c * W[2, j]


@kernel(fastmath={"contract"})
def correct(nav: Floats, earth: Floats, P: Floats, W: Floats, dx: Floats, white: Floats, dof: int) -> None:
    """Kalman update after ``innovate`` and ``whiten``: dx = W' w, P -= W' W, then the error is moved into nav.

    Resetting the attitude error turns its axes: P is mapped by G = I + [dtheta]x / 2, the left Jacobian of SO(3) to
    first order (Sola 2017, sec. 6.3 and 7.3, for a global error).
    """
    size = P.shape[0]
    for j in range(size):
        dx[j] = white[0] * W[0, j]
    for i in range(1, dof):
        for j in range(size):
            dx[j] += white[i] * W[i, j]
    shrink(P, W, dof)
    inject(nav, earth, dx)
    reset(P, (0.5 * dx[6], 0.5 * dx[7], 0.5 * dx[8]))


@kernel()
def inject(nav: Floats, earth: Floats, dx: Floats) -> None:
    """Add the error dx (n,) to nav (n + 1,): metres to radians at the state's place, attitude on the left."""
    climb = nav[2] - earth[G_HEIGHT]
    m = earth[G_MERIDIAN] * (1.0 - climb * earth[G_MERIDIAN])
    n = earth[G_TRANSVERSE] * (1.0 - climb * earth[G_TRANSVERSE])
    dlat = dx[1] * m
    nav[1] += dx[0] * n / earth[G_COS]
    nav[0] += dlat
    nav[2] += dx[2]
    if abs(dx[0]) + abs(dx[1]) + abs(dx[2]) > FAR_M:
        refresh(nav, earth)
    else:
        earth[G_SIN], earth[G_COS] = earth[G_SIN] + earth[G_COS] * dlat, earth[G_COS] - earth[G_SIN] * dlat
    for i in range(3):
        nav[3 + i] += dx[3 + i]
    for k in range(9, len(dx)):
        nav[k + 1] += dx[k]
    q: Quaternion = (nav[6], nav[7], nav[8], nav[9])
    turn = exp_q((dx[6], dx[7], dx[8]))
    nav[6], nav[7], nav[8], nav[9] = normalize(multiply(turn, q))


@kernel(fastmath={"contract"})
def reset(P: Floats, half: Vector) -> None:
    """P = G P G' with G = I + [half]x on the attitude block."""
    size = P.shape[0]
    for j in range(size):
        a, b, c = P[6, j], P[7, j], P[8, j]
        P[6, j] = a + (half[1] * c - half[2] * b)
        P[7, j] = b + (half[2] * a - half[0] * c)
        P[8, j] = c + (half[0] * b - half[1] * a)
    for j in range(size):
        a, b, c = P[j, 6], P[j, 7], P[j, 8]
        P[j, 6] = a + (half[1] * c - half[2] * b)
        P[j, 7] = b + (half[2] * a - half[0] * c)
        P[j, 8] = c + (half[0] * b - half[1] * a)
