"""Scalar WGS-84 formulas for loops (numba): radii of curvature, gravity, earth rate. Arrays and floats only."""

import math

from sensors.kernel import kernel

WGS84_A = 6_378_137.0
"""Semi-major axis, m."""
WGS84_F = 1.0 / 298.257223563
"""Flattening."""
WGS84_E2 = WGS84_F * (2.0 - WGS84_F)
"""First eccentricity squared."""
EARTH_RATE = 7.292115e-5
"""Earth's rotation, rad/s (WGS-84)."""
STANDARD_GRAVITY = 9.80665
"""What a g of a datasheet is, m/s^2."""
GRAVITY_EQUATOR = 9.7803253359
"""Normal gravity at the equator, m/s^2."""
_SOMIGLIANA = 0.001931852652458
_M = 0.003449786506841
"""omega^2 a^2 b / GM."""


@kernel()
def radii(sin_lat: float) -> tuple[float, float]:
    """Meridian and transverse (prime vertical) radii of curvature, m."""
    w2 = 1.0 - WGS84_E2 * sin_lat * sin_lat
    transverse = WGS84_A / math.sqrt(w2)
    return transverse * (1.0 - WGS84_E2) / w2, transverse


@kernel()
def gravity_enu(sin_lat: float, cos_lat: float, height: float) -> tuple[float, float]:
    """North and up components of plumb-line gravity, m/s^2; east is zero.

    Somigliana's normal gravity with the second-order height term (Groves 2013, Eq. 2.134, 2.139 and 2.140).
    """
    s2 = sin_lat * sin_lat
    surface = GRAVITY_EQUATOR * (1.0 + _SOMIGLIANA * s2) / math.sqrt(1.0 - WGS84_E2 * s2)
    ratio = height / WGS84_A
    down = surface * (1.0 - 2.0 * (1.0 + WGS84_F * (1.0 - 2.0 * s2) + _M) * ratio + 3.0 * ratio * ratio)
    return -8.08e-9 * height * 2.0 * sin_lat * cos_lat, -down
