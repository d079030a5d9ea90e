"""Error covariance: the transition is integrated with every IMU step, P is propagated only when it is needed.

Between two uses of P (a measurement, a recorded state) the transition Phi is accumulated from the velocity increments
and the attitude, as in preintegration; P' = Phi P Phi' + Q costs one product per use instead of one per IMU sample.
"""

import math
from typing import NamedTuple

from fusion._linalg import Matrix, Vector, cross
from fusion.mechanization import slow_dynamics
from fusion.state import A_PG, A_R, A_RR, A_S, A_T, A_U, A_VG, ACC_SIZE, E_WHEEL_SCALE, LANE, ROW, Floats
from sensors.kernel import kernel

Scratch = tuple[Floats, Floats, Floats]
"""phi (9, 16), M (9, n) and Mt (16, 16) of the core."""


class Noise(NamedTuple):
    """Process noise: gyro (rad/s)^2/Hz, accelerometer (m/s^2)^2/Hz; variances and 1/tau (1/s) of drifting biases.

    A bias is a turn-on constant, which nothing but measurements makes known, plus a Gauss-Markov drift. One state holds
    both: a random walk with the drift's driving noise, 2 var / tau, so that sigma never falls by waiting. What the
    temperature does to it is added: it warms up for minutes, and no constant.
    """

    gyro_psd: float
    accel_psd: float
    gyro_bias_var: float
    """Of the drift, (rad/s)^2."""
    gyro_bias_rate: float
    """Growth of its variance, (rad/s)^2/s."""
    accel_bias_rate: float
    """The same of the accelerometer bias, (m/s^2)^2/s."""
    wheel_scale_rate: float
    """Growth of the wheel scale's variance, 1/s."""
    gyro_scale: int = -1
    """Where the gyro's scale stands in the error state (``fusion.layout``)."""
    gyro_misalignment: int = -1
    """The same of its misalignment."""
    velocity_per_change: float = 0.0
    """Growth of each horizontal velocity's variance with its change (the accelerometer's scale), (m/s)^2 per m/s."""


@kernel()
def accumulate(acc: Floats, span: Floats, r: Matrix, dv: Vector, turned: float, dt: float) -> None:
    """Add one IMU step to the transition: r is R_enu_body at its start, dv its velocity increment (m/s, ENU).

    dtheta' = -R dbg, dv' = -[f]x dtheta - R dba, dp' = dv, each constant over the step. turned: about the body's
    vertical axis, rad.
    """
    for i in range(3):
        acc[A_T + i, 0] += r[3 * i] * turned
        acc[A_T + i, 1] += r[3 * i + 1] * turned
        acc[A_T + i, 2] += r[3 * i + 2] * turned
    for j in range(3):
        a0, a1, a2 = r[j] * dt, r[3 + j] * dt, r[6 + j] * dt
        # attitude error in mid-step per gyro bias is -m; velocity changes by dv x m
        m: Vector = (acc[A_R, j] + 0.5 * a0, acc[A_R + 1, j] + 0.5 * a1, acc[A_R + 2, j] + 0.5 * a2)
        g = cross(dv, m)
        for i in range(3):
            acc[A_PG + i, j] += dt * (acc[A_VG + i, j] + 0.5 * g[i])
            acc[A_VG + i, j] += g[i]
            acc[A_RR + i, j] += dt * m[i]
        acc[A_R, j] += a0
        acc[A_R + 1, j] += a1
        acc[A_R + 2, j] += a2
        acc[A_U, j] += dt * (acc[A_S, j] + 0.5 * dv[j])
        acc[A_S, j] += dv[j]
    span[0] += dt


@kernel()
def transition(nav: Floats, earth: Floats, acc: Floats, span: float, phi: Floats) -> None:
    """Write phi (9, 16), the upper rows of the transition over the accumulated span; biases stay as they are."""
    slow_dynamics(nav, earth, span, phi)
    for i in range(3):
        phi[i, 3 + i] += span
        for j in range(3):
            phi[i, 9 + j] = acc[A_PG + i, j]
            phi[i, 12 + j] = -acc[A_RR + i, j]
            phi[3 + i, 9 + j] = acc[A_VG + i, j]
            phi[3 + i, 12 + j] = phi[6 + i, 9 + j] = -acc[A_R + i, j]
    _add_minus_skew(phi, 0, acc[A_U, 0], acc[A_U, 1], acc[A_U, 2])
    _add_minus_skew(phi, 3, acc[A_S, 0], acc[A_S, 1], acc[A_S, 2])


@kernel()
def _add_minus_skew(phi: Floats, row: int, x: float, y: float, z: float) -> None:
    """Add -[v]x: position or velocity against attitude."""
    phi[row, 7] += z
    phi[row, 8] -= y
    phi[row + 1, 6] -= z
    phi[row + 1, 8] += x
    phi[row + 2, 6] += y
    phi[row + 2, 7] -= x


@kernel(fastmath={"contract"})
def _product(phi: Floats, X: Floats, Y: Floats) -> None:
    """The first 16 columns of Y = phi (9, 16) X. The sum stands inside: the compiler keeps it in vector registers."""
    for i in range(9):
        for j in range(ROW):
            total = 0.0
            for k in range(15):  # the wheel scale moves nothing
                total += phi[i, k] * X[k, j]
            Y[i, j] = total


@kernel(fastmath={"contract"})
def _other_columns(phi: Floats, P: Floats, M: Floats) -> None:
    """The columns of M = phi P from 16 on: how the blocks' correlation with position, velocity and attitude moves."""
    for first in range(ROW, P.shape[0], LANE):
        for i in range(9):
            for j in range(LANE):
                total = 0.0
                for k in range(15):
                    total += phi[i, k] * P[k, first + j]
                M[i, first + j] = total


@kernel()
def propagate(
    nav: Floats, earth: Floats, P: Floats, acc: Floats, elapsed: Floats, scratch: Scratch, noise: Noise
) -> None:
    """P = Phi P Phi' + Q over the accumulated span, which is then empty."""
    span = elapsed[0]
    if span == 0.0:
        return
    phi, M, Mt = scratch
    transition(nav, earth, acc, span, phi)
    size = P.shape[0]
    _product(phi, P, M)
    g, b = noise.gyro_scale, noise.gyro_misalignment
    if size > ROW:
        _other_columns(phi, P, M)
    # what these do to velocity within the span is left out: the attitude brings it over the next ones
    if g >= 0:
        for i in range(3):
            for j in range(size):
                M[6 + i, j] -= acc[A_T + i, 2] * P[g, j]
    if b >= 0:
        for i in range(3):
            for j in range(size):
                M[6 + i, j] -= acc[A_T + i, 0] * P[b, j] + acc[A_T + i, 1] * P[b + 1, j]
    for k in range(15):
        for i in range(9):
            Mt[k, i] = M[i, k]
    for i in range(9):
        for j in range(9, size):
            P[i, j] = P[j, i] = M[i, j]
    _product(phi, Mt, M)
    if g >= 0:
        for i in range(9):
            for j in range(3):
                M[6 + j, i] -= acc[A_T + j, 2] * M[i, g]
    if b >= 0:
        for i in range(9):
            for j in range(3):
                M[6 + j, i] -= acc[A_T + j, 0] * M[i, b] + acc[A_T + j, 1] * M[i, b + 1]
    for i in range(9):
        for j in range(i + 1):
            P[i, j] = P[j, i] = M[i, j]
    _add_noise(P, acc, noise, span)
    elapsed[0] = 0.0
    for i in range(ACC_SIZE):
        for j in range(3):
            acc[i, j] = 0.0


@kernel()
def _add_noise(P: Floats, acc: Floats, noise: Noise, span: float) -> None:
    """Q of white noise integrated over the span (van Loan's integral, to the leading order of each block)."""
    qa, qg = noise.accel_psd * span, noise.gyro_psd * span
    for i in range(3):
        P[i, i] += qa * span * span / 3.0
        P[i, 3 + i] += 0.5 * qa * span
        P[3 + i, i] += 0.5 * qa * span
        P[3 + i, 3 + i] += qa
        P[6 + i, 6 + i] += qg
        P[9 + i, 9 + i] += noise.gyro_bias_rate * span
        P[12 + i, 12 + i] += noise.accel_bias_rate * span
    P[E_WHEEL_SCALE, E_WHEEL_SCALE] += noise.wheel_scale_rate * span
    changed = noise.velocity_per_change * math.sqrt(acc[A_S, 0] * acc[A_S, 0] + acc[A_S, 1] * acc[A_S, 1])
    P[3, 3] += changed
    P[4, 4] += changed
    # velocity against attitude: -[s]x qg / 2
    half = 0.5 * qg
    x, y, z = half * acc[A_S, 0], half * acc[A_S, 1], half * acc[A_S, 2]
    P[3, 7] += z
    P[3, 8] -= y
    P[4, 6] -= z
    P[4, 8] += x
    P[5, 6] += y
    P[5, 7] -= x
    for i in range(3, 6):
        for j in range(6, 9):
            P[j, i] = P[i, j]


@kernel()
def coast(P: Floats, seconds: float, accel: float, rate: float) -> None:
    """Propagate P over a gap in the IMU at constant velocity, and widen it."""
    for i in range(P.shape[0]):
        for k in range(3):
            P[k, i] += seconds * P[3 + k, i]
    for i in range(P.shape[0]):
        for k in range(3):
            P[i, k] += seconds * P[i, 3 + k]
    widen(P, seconds, accel, rate)


@kernel()
def widen(P: Floats, seconds: float, accel: float, rate: float) -> None:
    """What a gap in the IMU hides: velocity and attitude walk by accel (m/s) and rate (rad) in the first second."""
    qa, qg = accel * accel * seconds, rate * rate * seconds
    for k in range(3):
        P[k, k] += qa * seconds * seconds / 3.0
        P[k, 3 + k] += 0.5 * qa * seconds
        P[3 + k, k] += 0.5 * qa * seconds
        P[3 + k, 3 + k] += qa
    P[6, 6] += 0.01 * qg  # a car turns about its vertical axis; a tenth of it tilts
    P[7, 7] += 0.01 * qg
    P[8, 8] += qg
