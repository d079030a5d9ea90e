"""The gyro's axes against the body's: what nothing shows, and what is stated of it.

A gyro that sees the yaw rate with its other two axes, by a constant share, turns about a vertical axis of its own that
leans by this angle against the body's. The filter's attitude is that of the gyro: the same lean for ever, which the
accelerometer's bias balances (gravity times the lean). Place and speed are none the worse for it, and no measurement
shows it. So the state is left alone, and its covariance gets the lean's where it is stated.
"""

import numpy as np

from fusion._linalg import Vector, attitude
from fusion.state import E_ACCEL_BIAS, E_ATTITUDE, QUATERNION, Floats
from sensors._kernels import STANDARD_GRAVITY
from sensors.kernel import kernel
from sensors.rotation import matrix_from_q


@kernel(inline="always")
def add_lean(nav: Floats, variance: float, sigma: Floats, pose_cov: Floats) -> None:
    """Add the lean to sigma (15,) of the states and to pose_cov (6, 6) of position and attitude, in place."""
    r = attitude(nav)
    up: Vector = (r[2], r[5], r[8])
    for i in range(3):
        for j in range(3):
            pose_cov[3 + i, 3 + j] += variance * ((1.0 if i == j else 0.0) - up[i] * up[j])
        sigma[6 + i] = np.sqrt(pose_cov[3 + i, 3 + i])
    for i in range(12, 14):
        sigma[i] = np.sqrt(sigma[i] * sigma[i] + variance * STANDARD_GRAVITY * STANDARD_GRAVITY)


def with_lean(P: Floats, nav: Floats, variance: float) -> Floats:
    """P (n, n) with the lean added. variance: rad^2, each way."""
    lean = np.zeros((len(P), 2))
    lean[E_ATTITUDE] = matrix_from_q(nav[QUATERNION])[:, :2]
    lean[E_ACCEL_BIAS] = ((0.0, STANDARD_GRAVITY), (-STANDARD_GRAVITY, 0.0), (0.0, 0.0))
    result: Floats = P + variance * lean @ lean.T
    return result
