"""The state, its error and the working memory of the filter.

Nominal state ``nav`` (17,): latitude rad, longitude rad, height m; velocity ENU m/s; q_enu_body xyzw; gyro bias rad/s;
accelerometer bias m/s^2; scale error of the wheel speed. Error state (16,): position ENU m, velocity ENU m/s, attitude
rad (left error, ENU: ``R_true = Exp(dtheta) R``), gyro bias, accelerometer bias, wheel scale; each is true minus
estimate and is added on correction.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

LLH = slice(0, 3)
VELOCITY = slice(3, 6)
QUATERNION = slice(6, 10)
GYRO_BIAS = slice(10, 13)
ACCEL_BIAS = slice(13, 16)
WHEEL_SCALE = 16
NAV_SIZE = 17

E_POSITION = slice(0, 3)
E_VELOCITY = slice(3, 6)
E_ATTITUDE = slice(6, 9)
E_GYRO_BIAS = slice(9, 12)
E_ACCEL_BIAS = slice(12, 15)
E_WHEEL_SCALE = 15
ERROR_SIZE = 16

RING_SIZE = 2048
"""IMU samples kept to see whether the vehicle stands still."""


ROW = ERROR_SIZE
"""Length of the rows of P, H and Phi: they fill vector registers."""

# first rows of what Core.acc holds, each (3,) or (3, 3)
A_S = 0
"""Integral of specific force, ENU m/s."""
A_U = 1
"""Its integral, m."""
A_R = 2
"""Integral of R_enu_body, s."""
A_RR = 5
"""Its integral, s^2."""
A_VG = 8
"""Velocity against gyro bias."""
A_PG = 11
"""Position against gyro bias."""
ACC_SIZE = 14

# entries of Core.earth
G_SIN, G_COS, G_MERIDIAN, G_TRANSVERSE, G_NORTH, G_UP, G_HEIGHT, G_AGE = range(8)

# entries of Core.doubt_clock
D_COUNT, D_TIME, D_AGREED = range(3)

# entries of Core.clock
C_STATE, C_SAMPLE, C_TICK, C_COUNT, C_BEND, C_INTERVAL = range(6)


class Core(NamedTuple):
    """Everything that the kernels change between calls (arrays, written in place).

    clock (6,) int64: times of the state, the last IMU sample and the last motion tick (ns), samples put into the ring,
    whether the sample before the last serves the bend, the interval before the last sample (ns).
    nav (17,); P (16, 16); last (2, 6): the last IMU sample (gyro, accel) and the one before it.
    span (1,): seconds since P was propagated; acc (14, 3): the transition over them (A_*).
    earth (8,): sine and cosine of latitude and what changes slowly (G_*), refreshed now and then.
    ring (RING_SIZE, 6), ring_t (RING_SIZE,): latest IMU samples.
    quietest (2,): least variance of the specific force's norm and of the yaw rate in a window so far.
    doubt (2, 8), doubt_clock (2, 3) int64: the last rejected GNSS position and pose fix (``fusion.recovery``).
    phi, M (9, 16), Mt (16, 16), H, W (3, 16), R, L (3, 3),
    eigen (2, 3, 3), residual (3,), dx (16,): scratch.
    stay (16,): share of each error from the tenth on that the last propagation kept, all 1 so far.
    tape (K,), tape_end (1,): what ``fusion.tape`` puts down; K = 0: nothing.
    """

    clock: Nanoseconds
    nav: Floats
    P: Floats
    last: Floats
    span: Floats
    acc: Floats
    earth: Floats
    ring: Floats
    ring_t: Nanoseconds
    quietest: Floats
    doubt: Floats
    doubt_clock: Nanoseconds
    phi: Floats
    M: Floats
    Mt: Floats
    H: Floats
    W: Floats
    R: Floats
    L: Floats
    eigen: Floats
    residual: Floats
    dx: Floats
    stay: Floats
    tape: Floats
    tape_end: Nanoseconds


def new_core() -> Core:
    """A core of zeros, to be filled by alignment."""
    return Core(
        clock=np.zeros(6, np.int64),
        nav=np.zeros(NAV_SIZE),
        P=np.zeros((ERROR_SIZE, ERROR_SIZE)),
        last=np.zeros((2, 6)),
        span=np.zeros(1),
        acc=np.zeros((ACC_SIZE, 3)),
        earth=np.zeros(8),
        ring=np.zeros((RING_SIZE, 6)),
        ring_t=np.zeros(RING_SIZE, np.int64),
        quietest=np.full(2, np.inf),
        doubt=np.zeros((2, 8)),
        doubt_clock=np.zeros((2, 3), np.int64),
        phi=np.zeros((9, ROW)),
        M=np.zeros((9, ROW)),
        Mt=np.zeros((ERROR_SIZE, ROW)),
        H=np.zeros((3, ROW)),
        W=np.zeros((3, ROW)),
        R=np.zeros((3, 3)),
        L=np.zeros((3, 3)),
        eigen=np.zeros((2, 3, 3)),
        residual=np.zeros(3),
        dx=np.zeros(ROW),
        stay=np.ones(ROW),
        tape=np.empty(0),
        tape_end=np.zeros(1, np.int64),
    )
