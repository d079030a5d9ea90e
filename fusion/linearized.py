"""The map at a place as the linear map that it is there, and covariances as the filter uses them.

One pass over the measurements each: live use has one at a time, and a dozen calls of numpy cost as much as the filter.
"""

import math

from fusion.state import Floats
from sensors.kernel import kernel


@kernel()
def linearize(rotation: Floats, scale: Floats, yaw: Floats, to_enu: Floats, tilt: Floats, yaw_enu: Floats) -> None:
    """From R_map_enu (N, 3, 3), the map's scale (N,) and yaws (N,) in the map: what they are in ENU.

    to_enu (N, 3, 3): map (x, y, yaw) errors to (east, north, yaw); tilt (N, 2): what a metre of height moves a point
    of the map horizontally; yaw_enu (N,): from east.
    """
    for n in range(len(scale)):
        k = scale[n]
        xe, xn, xu = k * rotation[n, 0, 0], k * rotation[n, 0, 1], k * rotation[n, 0, 2]
        ye, yn, yu = k * rotation[n, 1, 0], k * rotation[n, 1, 1], k * rotation[n, 1, 2]
        determinant = xe * yn - xn * ye
        ex, ey = yn / determinant, -xn / determinant
        nx, ny = -ye / determinant, xe / determinant
        to_enu[n, 0, 0], to_enu[n, 0, 1], to_enu[n, 0, 2] = ex, ey, 0.0
        to_enu[n, 1, 0], to_enu[n, 1, 1], to_enu[n, 1, 2] = nx, ny, 0.0
        to_enu[n, 2, 0], to_enu[n, 2, 1], to_enu[n, 2, 2] = 0.0, 0.0, 1.0
        tilt[n, 0], tilt[n, 1] = ex * xu + ey * yu, nx * xu + ny * yu
        c, s = math.cos(yaw[n]), math.sin(yaw[n])
        yaw_enu[n] = math.atan2(nx * c + ny * s, ex * c + ey * s)


@kernel()
def raise_to(cov: Floats, factor: float, floors: Floats, added: float, raised: Floats) -> None:
    """raised (N, 3, 3): factor cov, with every direction of the plane, and the third axis, of at least these variances
    (3,), the first two equal; and then so much more along each axis.

    A diagonal alone does not show the plane's smallest variance: a street that runs north-east hides it. What is added
    is positive semidefinite, and keeps a matrix positive definite.
    """
    for n in range(len(cov)):
        for i in range(3):
            for j in range(3):
                raised[n, i, j] = factor * cov[n, i, j]
        x, y = raised[n, 0, 0], raised[n, 1, 1]
        missing = max(floors[0] - (0.5 * (x + y) - math.hypot(0.5 * (x - y), raised[n, 0, 1])), 0.0)
        raised[n, 0, 0] = x + missing + added
        raised[n, 1, 1] = y + missing + added
        raised[n, 2, 2] = max(raised[n, 2, 2], floors[2]) + added


@kernel()
def turn_into_enu(
    to_enu: Floats, cov: Floats, added: Floats, spread: Floats, turned: Floats, spread_enu: Floats
) -> None:
    """Covariances in map axes, with so much (3,) added to their diagonal, and spreads (N, 3), in ENU."""
    for n in range(len(cov)):
        for i in range(3):
            spread_enu[n, i] = 0.0
            for j in range(3):
                spread_enu[n, i] += to_enu[n, i, j] * spread[n, j]
        for i in range(3):
            for j in range(i + 1):
                total = 0.0
                for k in range(3):
                    for m in range(3):
                        c = cov[n, k, m] + (added[k] if k == m else 0.0)
                        total += to_enu[n, i, k] * c * to_enu[n, j, m]
                turned[n, i, j] = turned[n, j, i] = total
