"""What the optional error states (``fusion.layout``) add to residuals and Jacobians.

Errors that last: a share c of a measurement's covariance R = L L' is that of sqrt(c) L x, x a first-order Gauss-Markov
process of unit variance, another is white. So x follows the covariance that each fix states; it is correlated in time
(GNSS: reflections, atmosphere) or along the road (pose fixes: map and features stand still when the vehicle does).
"""

import math

from fusion._linalg import Matrix, Vector, cross, matvec
from fusion.layout import Layout
from fusion.state import Core, Floats
from fusion.tape import note_fade
from sensors.kernel import kernel

SHAKEN = 1.5
"""An acceleration differs by so much, each axis, from what it was or will be after a delay, m/s^2."""


@kernel(fastmath={"contract"})
def fade(core: Core, first: int, keep: float) -> None:
    """Move three unit Gauss-Markov states on: x' = keep x + sqrt(1 - keep^2) w.

    As nothing but its own sensor sees x, this may wait until that measures: the order does not change the result.
    """
    nav, P = core.nav, core.P
    for k in range(first, first + 3):
        nav[k + 1] *= keep
        for j in range(P.shape[0]):
            P[k, j] *= keep
            P[j, k] *= keep
        P[k, k] += 1.0 - keep * keep
    if len(core.tape):
        note_fade(core, first, 3, keep)


@kernel()
def renew(core: Core, first: int) -> None:
    """Three unit Gauss-Markov states of which nothing is known any more."""
    nav, P = core.nav, core.P
    for k in range(first, first + 3):
        nav[k + 1] = 0.0
        for j in range(P.shape[0]):
            P[k, j] = P[j, k] = 0.0
        P[k, k] = 1.0
    if len(core.tape):
        note_fade(core, first, 3, 0.0)


@kernel()
def lasting(nav: Floats, H: Floats, R: Floats, residual: Floats, L: Floats, first: int, share: float) -> None:
    """Let x (3) at first carry a share of R (3, 3); L (3, 3): scratch."""
    root = math.sqrt(share)
    for i in range(3):
        for j in range(i + 1):
            total = R[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = math.sqrt(max(total, 0.0))
            else:
                L[i, j] = total / L[j, j] if L[j, j] > 0.0 else 0.0
    for i in range(3):
        for j in range(i + 1):
            H[i, first + j] = root * L[i, j]
            residual[i] -= root * L[i, j] * nav[first + j + 1]


@kernel()
def scale(R: Floats, factor: float) -> None:
    """Multiply R (3, 3)."""
    for i in range(3):
        for j in range(3):
            R[i, j] *= factor


@kernel()
def arm_of(nav: Floats, layout: Layout, arm: Vector) -> Vector:
    """The lever arm as it is estimated."""
    k = layout.gnss_arm
    if k < 0:
        return arm
    return arm[0] + nav[k + 1], arm[1] + nav[k + 2], arm[2] + nav[k + 3]


@kernel()
def see_arm(H: Floats, layout: Layout, r: Matrix, rate: Vector, of_velocity: bool, level: bool) -> None:
    """Jacobian of an antenna's position, R, or velocity, R [omega]x, against the lever arm.

    level: a land vehicle hardly tilts, less than its estimated tilt settles: seen through that, the antenna's height
    would seem to show in the plane.
    """
    k = layout.gnss_arm
    if k < 0:
        return
    for j in range(3):
        unit: Vector = (1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0)
        if of_velocity:
            unit = cross(rate, unit)
        column = unit if level and j == 2 and not of_velocity else matvec(r, unit)
        for i in range(3):
            H[i, k + j] = column[i]


@kernel()
def see_delay(nav: Floats, H: Floats, residual: Floats, k: int, change: Vector, bend: Vector) -> None:
    """A measurement that is older than thought by the delay state k: it shows change (3,), per second, less of it.

    bend: the change of that, per second; a car that brakes nods, so without it a delay passes for a higher antenna.
    """
    delay = nav[k + 1]
    for i in range(3):
        H[i, k] = bend[i] * delay - change[i]
        residual[i] += (change[i] - 0.5 * bend[i] * delay) * delay


@kernel()
def allow_delay(core: Core, k: int, change: Vector) -> None:
    """A velocity that is older than thought by the delay state k, change (3,): the acceleration, m/s^2.

    It corrects the residual and widens R, and shows nothing of the delay: engine and road shake the acceleration, and
    what is regressed on noise comes out too small, and sure of itself (as the correlation with the velocity would).
    """
    delay = core.nav[k + 1]
    variance = SHAKEN * SHAKEN * (core.P[k, k] + delay * delay)
    for i in range(3):
        core.residual[i] += change[i] * delay
        core.R[i, i] += variance
