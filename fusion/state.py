"""The state, its error and the working memory of the filter.

Nominal state ``nav`` (n + 1,): latitude rad, longitude rad, height m; velocity ENU m/s; q_enu_body xyzw; gyro bias
rad/s; accelerometer bias m/s^2; scale error of the wheel speed; then the blocks of ``fusion.layout``. Error state (n,):
position ENU m, velocity ENU m/s, attitude rad (left error, ENU: ``R_true = Exp(dtheta) R``), gyro bias, accelerometer
bias, wheel scale, the blocks; each is true minus estimate and is added on correction. From the gyro bias on, error k
belongs to nav[k + 1]. n is 16 or more, a multiple of eight: what fills it up has no variance.
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
"""States that are always there."""

RING_SIZE = 2048
"""IMU samples kept to see whether the vehicle stands still; a power of two."""


ROW = ERROR_SIZE
"""Columns of the transition: nothing but these states moves by the IMU."""
LANE = 8
"""The number of states is a multiple of this: inner loops of so many fill vector registers."""

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
A_T = 14
"""Integral of R_enu_body times the body's yaw rate, rad."""
ACC_SIZE = 17

# entries of Core.earth
G_SIN, G_COS, G_MERIDIAN, G_TRANSVERSE, G_NORTH, G_UP, G_HEIGHT, G_AGE = range(8)

# entries of Core.doubt_clock
D_COUNT, D_TIME, D_AGREED, D_BELIEVED, D_SINCE, D_STREAK, D_LAST, D_TRACKING, D_HELD = range(9)

# entries of Core.health: Health and Cause; when the core was aligned, a position was applied, one was explained, the
# filter came back, the yaw was last known worse than linear; positions not explained since, the first and the last of
# them; how often it was aligned anew; when the state gave way last, was outvoted again, gave way to one sensor
# alone or again, and how many such times there were
(
    H_STATE,
    H_CAUSE,
    H_START,
    H_FED,
    H_HELD,
    H_BACK,
    H_WIDE,
    H_COUNT,
    H_SINCE,
    H_LAST,
    H_RESTARTS,
    H_GAVE,
    H_OUTVOTED,
    H_UNSETTLED,
    H_TIMES,
) = range(15)

# columns of Core.trust: when a measurement was last judged, last explained; how many more were not than were
T_SEEN, T_GOOD, T_DOUBT = range(3)

NEVER, FOREVER = -(2**62), 2**63 - 1
"""Before and after any stamp. From NEVER a stamp can be subtracted."""

# entries of Core.clock
C_STATE, C_SAMPLE, C_TICK, C_COUNT, C_BEND, C_INTERVAL = range(6)


class Core(NamedTuple):
    """Everything that the kernels change between calls (arrays, written in place).

    clock (6,) int64: times of the state, the last IMU sample and the last motion tick (ns), samples put into the ring,
    whether the sample before the last serves the bend, the interval before the last sample (ns).
    nav (n + 1,); P (n, n); last (2, 6): the last IMU sample (gyro, accel) and the one before it.
    span (1,): seconds since P was propagated; acc (17, 3): the transition over them (A_*).
    earth (8,): sine and cosine of latitude and what changes slowly (G_*), refreshed now and then.
    ring (N, 6), ring_t (N,): latest IMU samples, N = RING_SIZE or a greater power of two.
    quietest (2,): least variance of the specific force's norm and of the yaw rate in a window so far.
    slipped (3, 2): what the drive has shown of the rear axle's lateral and vertical velocity (``fusion.motion``).
    aged (3,): seconds since the lasting error of GNSS was moved on, metres since that of pose fixes was, and the
    horizontal variance that the last GNSS position stated.
    doubt (2, 13), doubt_clock (2, 9) int64: the last rejected GNSS position and pose fix (``fusion.recovery``,
    ``fusion.streak``); fresh (5,): the pose fix that is being judged: innovation east, north m and its R's ee, en, nn.
    health (15,), trust (5, 3) int64: clocks of ``fusion.health`` (H_*, T_*).
    phi (9, 16), M (9, n), Mt (16, 16), H, W (3, n), R, L (3, 3),
    eigen (2, 3, 3), residual (3,), dx (n,): scratch.
    turned (3, 3): A_T of the last transition; tape (K,), tape_end (1,): what ``fusion.tape`` puts down; K = 0: nothing.
    rate (3,): the body rate before the last sample, as events at its time saw it, rad/s.
    kept (K,), saved (S, K), saved_cov (S, n, n), saved_t (S, 2), saves (4,): ``fusion.snapshots``; S = 0: none.
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
    slipped: Floats
    aged: Floats
    doubt: Floats
    doubt_clock: Nanoseconds
    fresh: Floats
    health: Nanoseconds
    trust: Nanoseconds
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
    turned: Floats
    tape: Floats
    tape_end: Nanoseconds
    rate: Floats
    kept: Nanoseconds
    saved: Nanoseconds
    saved_cov: Floats
    saved_t: Nanoseconds
    saves: Nanoseconds


def new_core(size: int = ERROR_SIZE) -> Core:
    """A core of zeros with so many error states, to be filled by alignment."""
    return Core(
        clock=np.zeros(6, np.int64),
        nav=np.zeros(size + 1),
        P=np.zeros((size, size)),
        last=np.zeros((2, 6)),
        span=np.zeros(1),
        acc=np.zeros((ACC_SIZE, 3)),
        earth=np.zeros(8),
        ring=np.zeros((RING_SIZE, 6)),
        ring_t=np.zeros(RING_SIZE, np.int64),
        quietest=np.full(2, np.inf),
        slipped=np.zeros((3, 2)),
        aged=np.zeros(3),
        doubt=np.zeros((2, 13)),
        doubt_clock=np.zeros((2, 9), np.int64),
        fresh=np.zeros(5),
        health=np.array([0, 0, *(NEVER,) * 5, 0, NEVER, NEVER, 0, *(NEVER,) * 3, 0], np.int64),
        trust=np.tile(np.array([NEVER, NEVER, 0], np.int64), (5, 1)),
        phi=np.zeros((9, ROW)),
        M=np.zeros((9, size)),
        Mt=np.zeros((ERROR_SIZE, ROW)),
        H=np.zeros((3, size)),
        W=np.zeros((3, size)),
        R=np.zeros((3, 3)),
        L=np.zeros((3, 3)),
        eigen=np.zeros((2, 3, 3)),
        residual=np.zeros(3),
        dx=np.zeros(size),
        turned=np.zeros((3, 3)),
        tape=np.empty(0),
        tape_end=np.zeros(1, np.int64),
        rate=np.zeros(3),
        kept=np.zeros(0, np.int64),
        saved=np.zeros((0, 0), np.int64),
        saved_cov=np.zeros((0, ERROR_SIZE, ERROR_SIZE)),
        saved_t=np.zeros((0, 2), np.int64),
        saves=np.zeros(4, np.int64),
    )
