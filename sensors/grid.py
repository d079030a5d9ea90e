"""UTM's grid at a place: how far it is turned against north, and its scale (numba). Coordinates are pyproj's.

Krueger's series as in Karney 2011, "Transverse Mercator with an accuracy of a few nanometers", Eq. 7 to 12 and 22 to
26, to the fourth order in the third flattening. Within a zone it agrees with pyproj to 1e-9.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sensors._kernels import WGS84_E2, WGS84_F
from sensors.kernel import kernel

UTM_SCALE = 0.9996
"""Scale on the central meridian."""
_E = math.sqrt(WGS84_E2)
_N = WGS84_F / (2.0 - WGS84_F)
"""Third flattening."""
_RECTIFYING = (1.0 + _N**2 / 4.0 + _N**4 / 64.0) / (1.0 + _N)
"""Radius of the rectifying sphere over the semi-major axis."""
_ALPHA = (
    _N / 2.0 - 2.0 / 3.0 * _N**2 + 5.0 / 16.0 * _N**3 + 41.0 / 180.0 * _N**4,
    13.0 / 48.0 * _N**2 - 3.0 / 5.0 * _N**3 + 557.0 / 1440.0 * _N**4,
    61.0 / 240.0 * _N**3 - 103.0 / 140.0 * _N**4,
    49561.0 / 161280.0 * _N**4,
)


@kernel()
def grid_of(lat: float, lon: float) -> tuple[float, float, float]:
    """Cosine and sine of the angle from north to grid north, clockwise, and the scale, on the ellipsoid.

    lat: rad, not a pole; lon: rad from the central meridian, less than a quarter turn.
    """
    # 1. the conformal latitude, by its tangent
    tau = math.tan(lat)
    secant = math.hypot(1.0, tau)
    sigma = math.sinh(_E * math.atanh(_E * tau / secant))
    conformal = tau * math.hypot(1.0, sigma) - sigma * secant
    # 2. the sphere's transverse Mercator: place, turn and scale
    c, s = math.cos(lon), math.sin(lon)
    root = math.hypot(conformal, c)
    north, east = math.atan2(conformal, c), math.asinh(s / root)
    turn = math.atan2(conformal * s, math.hypot(1.0, conformal) * c)
    scale = math.sqrt(1.0 - WGS84_E2 * math.sin(lat) ** 2) * secant / root
    # 3. from the sphere to the ellipsoid
    p, q = 1.0, 0.0
    for j in range(4):
        twice = 2.0 * (j + 1)
        p += twice * _ALPHA[j] * math.cos(twice * north) * math.cosh(twice * east)
        q += twice * _ALPHA[j] * math.sin(twice * north) * math.sinh(twice * east)
    turn += math.atan2(q, p)
    return math.cos(turn), math.sin(turn), UTM_SCALE * _RECTIFYING * scale * math.hypot(p, q)


@kernel()
def grid_rotations(
    llh: NDArray[np.float64], meridian: float, rotation: NDArray[np.float64], scale: NDArray[np.float64]
) -> None:
    """R_map_enu (N, 3, 3) and scale (N,) at places llh (N, 3) rad, rad, m. meridian: the central one, rad."""
    for n in range(len(llh)):
        lon = llh[n, 1] - meridian
        lon -= 2.0 * math.pi * round(lon / (2.0 * math.pi))
        c, s, scale[n] = grid_of(llh[n, 0], lon)
        rotation[n, 0, 0], rotation[n, 0, 1], rotation[n, 0, 2] = c, -s, 0.0
        rotation[n, 1, 0], rotation[n, 1, 1], rotation[n, 1, 2] = s, c, 0.0
        rotation[n, 2, 0], rotation[n, 2, 1], rotation[n, 2, 2] = 0.0, 0.0, 1.0
