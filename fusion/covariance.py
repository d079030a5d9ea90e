"""Error covariance: the transition is integrated with every IMU step, P is propagated only when it is needed.

Between two uses of P (a measurement, a recorded state) the transition Phi is accumulated from the velocity increments and
the attitude, as in preintegration; P' = Phi P Phi' + Q costs one product per use instead of one per IMU sample.
"""

import math
from typing import NamedTuple

from numba import njit

from fusion._linalg import Quaternion, Vector, rotation
from fusion.mechanization import slow_dynamics
from fusion.state import Core


class Noise(NamedTuple):
    """Process noise per second: gyro (rad/s)^2/Hz, accelerometer (m/s^2)^2/Hz; variances and 1/tau of drifting biases."""

    gyro_psd: float
    accel_psd: float
    gyro_bias_var: float
    accel_bias_var: float
    bias_rate: float


@njit(cache=True)
def accumulate(core: Core, dv: Vector, dt: float) -> None:
    """Add one IMU step: dv (m/s, ENU) is its velocity increment; nav holds the state at the step's start.

    dtheta' = -R dbg, dv' = -[f]x dtheta - R dba, dp' = dv, each constant over the step.
    """
    nav, S, SS, Vg, Pg, s, u = core.nav, core.S, core.SS, core.Vg, core.Pg, core.s, core.u
    q: Quaternion = (nav[6], nav[7], nav[8], nav[9])
    r = rotation(q)
    half = 0.5 * dt
    for j in range(3):
        a0, a1, a2 = r[j] * dt, r[3 + j] * dt, r[6 + j] * dt
        # attitude error in mid-step per gyro bias: -(S + A/2); velocity changes by -dv x that
        m0, m1, m2 = S[0, j] + 0.5 * a0, S[1, j] + 0.5 * a1, S[2, j] + 0.5 * a2
        g0, g1, g2 = dv[1] * m2 - dv[2] * m1, dv[2] * m0 - dv[0] * m2, dv[0] * m1 - dv[1] * m0
        Pg[0, j] += dt * (Vg[0, j] + 0.5 * g0)
        Pg[1, j] += dt * (Vg[1, j] + 0.5 * g1)
        Pg[2, j] += dt * (Vg[2, j] + 0.5 * g2)
        Vg[0, j] += g0
        Vg[1, j] += g1
        Vg[2, j] += g2
        SS[0, j] += dt * m0
        SS[1, j] += dt * m1
        SS[2, j] += dt * m2
        S[0, j] += a0
        S[1, j] += a1
        S[2, j] += a2
    for i in range(3):
        u[i] += dt * s[i] + half * dv[i]
        s[i] += dv[i]
    core.span[0] += dt


@njit(cache=True)
def transition(core: Core) -> None:
    """Write Phi (9, 15), the upper rows of the transition over the accumulated span; biases decay on their own."""
    Phi, s, u = core.Phi, core.s, core.u
    span = core.span[0]
    slow_dynamics(core.nav, Phi)
    for i in range(9):
        for j in range(9):
            Phi[i, j] *= span
        Phi[i, i] += 1.0
    for i in range(3):
        Phi[i, 3 + i] += span
        for j in range(3):
            Phi[i, 9 + j] = core.Pg[i, j]
            Phi[i, 12 + j] = -core.SS[i, j]
            Phi[3 + i, 9 + j] = core.Vg[i, j]
            Phi[3 + i, 12 + j] = -core.S[i, j]
            Phi[6 + i, 9 + j] = -core.S[i, j]
            Phi[6 + i, 12 + j] = 0.0
    # -[u]x and -[s]x: position and velocity against attitude
    for row, a in ((0, u), (3, s)):
        Phi[row, 7] += a[2]
        Phi[row, 8] -= a[1]
        Phi[row + 1, 6] -= a[2]
        Phi[row + 1, 8] += a[0]
        Phi[row + 2, 6] += a[1]
        Phi[row + 2, 7] -= a[0]


@njit(cache=True, fastmath={"contract", "reassoc"})
def propagate(core: Core, noise: Noise) -> None:
    """P = Phi P Phi' + Q over the accumulated span, which is then empty."""
    span = core.span[0]
    if span == 0.0:
        return
    transition(core)
    Phi, M, P = core.Phi, core.M, core.P
    decay = math.exp(-noise.bias_rate * span)
    for i in range(9):
        for j in range(15):
            M[i, j] = 0.0
        for k in range(15):
            phi = Phi[i, k]
            if phi != 0.0:
                for j in range(15):
                    M[i, j] += phi * P[k, j]
    for i in range(9):
        for j in range(i + 1):
            total = 0.0
            for k in range(15):
                total += M[i, k] * Phi[j, k]
            P[i, j] = total
            P[j, i] = total
        for j in range(9, 15):
            P[i, j] = M[i, j] * decay
            P[j, i] = P[i, j]
    for i in range(9, 15):
        for j in range(9, 15):
            P[i, j] *= decay * decay
    _add_noise(core, noise, span, 1.0 - decay * decay)
    core.span[0] = 0.0
    core.s[:] = 0.0
    core.u[:] = 0.0
    core.S[:] = 0.0
    core.SS[:] = 0.0
    core.Vg[:] = 0.0
    core.Pg[:] = 0.0


@njit(cache=True)
def _add_noise(core: Core, noise: Noise, span: float, refilled: float) -> None:
    """Q of white noise integrated over the span (van Loan's integral, to the leading order of each block)."""
    P, s = core.P, core.s
    qa, qg = noise.accel_psd * span, noise.gyro_psd * span
    for i in range(3):
        P[i, i] += qa * span * span / 3.0
        P[i, 3 + i] += 0.5 * qa * span
        P[3 + i, i] += 0.5 * qa * span
        P[3 + i, 3 + i] += qa
        P[6 + i, 6 + i] += qg
        P[9 + i, 9 + i] += noise.gyro_bias_var * refilled
        P[12 + i, 12 + i] += noise.accel_bias_var * refilled
    # velocity against attitude: -[s]x qg / 2
    half = 0.5 * qg
    for i, j, value in (
        (3, 7, s[2]),
        (3, 8, -s[1]),
        (4, 6, -s[2]),
        (4, 8, s[0]),
        (5, 6, s[1]),
        (5, 7, -s[0]),
    ):
        P[i, j] += half * value
        P[j, i] += half * value


@njit(cache=True)
def coast(core: Core, seconds: float, accel: float, rate: float) -> None:
    """Widen P over a gap in the IMU: velocity and attitude walk by accel (m/s) and rate (rad) in the first second."""
    P = core.P
    for i in range(15):
        for k in range(3):
            P[k, i] += seconds * P[3 + k, i]
    for i in range(15):
        for k in range(3):
            P[i, k] += seconds * P[i, 3 + k]
    qa, qg = accel * accel * seconds, rate * rate * seconds
    for k in range(3):
        P[k, k] += qa * seconds * seconds / 3.0
        P[k, 3 + k] += 0.5 * qa * seconds
        P[3 + k, k] += 0.5 * qa * seconds
        P[3 + k, 3 + k] += qa
    P[6, 6] += 0.01 * qg  # a car turns about its vertical axis; a tenth of it tilts
    P[7, 7] += 0.01 * qg
    P[8, 8] += qg
