"""The state, its error and the working memory of the filter.

Nominal state ``nav`` (16,): latitude rad, longitude rad, height m; velocity ENU m/s; q_enu_body xyzw; gyro bias rad/s;
accelerometer bias m/s^2. Error state (15,): position ENU m, velocity ENU m/s, attitude rad (left error, ENU:
``R_true = Exp(dtheta) R``), gyro bias, accelerometer bias; each is true minus estimate and is added on correction.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LLH = slice(0, 3)
VELOCITY = slice(3, 6)
QUATERNION = slice(6, 10)
GYRO_BIAS = slice(10, 13)
ACCEL_BIAS = slice(13, 16)
NAV_SIZE = 16

E_POSITION = slice(0, 3)
E_VELOCITY = slice(3, 6)
E_ATTITUDE = slice(6, 9)
E_GYRO_BIAS = slice(9, 12)
E_ACCEL_BIAS = slice(12, 15)
ERROR_SIZE = 15

RING_SIZE = 2048
"""IMU samples kept to see whether the vehicle stands still."""


class Core(NamedTuple):
    """Everything that the kernels change between calls (arrays, written in place).

    clock (6,) int64: time of the state, of the last IMU sample, of the last motion tick (ns), samples in the ring so far,
    whether last[1] serves, the interval before the last sample (ns).
    nav (16,), P (15, 15); last (2, 6): the last IMU sample (gyro, accel) and the one before it.
    The transition since P was last propagated, in ENU: span (1,) s; s, u (3,) velocity increment and its integral;
    S, SS (3, 3) integral of R_enu_body and its integral; Vg, Pg (3, 3) velocity and position against gyro bias.
    ring (RING_SIZE, 6), ring_t (RING_SIZE,): latest IMU samples. Phi, M (9, 15), H, PHt (3, 15): scratch.
    """

    clock: NDArray[np.int64]
    nav: Floats
    P: Floats
    last: Floats
    span: Floats
    s: Floats
    u: Floats
    S: Floats
    SS: Floats
    Vg: Floats
    Pg: Floats
    ring: Floats
    ring_t: NDArray[np.int64]
    Phi: Floats
    M: Floats
    H: Floats
    PHt: Floats


def new_core() -> Core:
    """A core of zeros, to be filled by alignment."""
    return Core(
        clock=np.zeros(6, np.int64),
        nav=np.zeros(NAV_SIZE),
        P=np.zeros((ERROR_SIZE, ERROR_SIZE)),
        last=np.zeros((2, 6)),
        span=np.zeros(1),
        s=np.zeros(3),
        u=np.zeros(3),
        S=np.zeros((3, 3)),
        SS=np.zeros((3, 3)),
        Vg=np.zeros((3, 3)),
        Pg=np.zeros((3, 3)),
        ring=np.zeros((RING_SIZE, 6)),
        ring_t=np.zeros(RING_SIZE, np.int64),
        Phi=np.zeros((9, ERROR_SIZE)),
        M=np.zeros((9, ERROR_SIZE)),
        H=np.zeros((3, ERROR_SIZE)),
        PHt=np.zeros((3, ERROR_SIZE)),
    )
