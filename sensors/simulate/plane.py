"""The plane that roads are laid out in: x east, y north in metres around an origin, latitude and longitude scaled."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors.geodesy import meridian_radius, transverse_radius

Floats = NDArray[np.float64]


class Plane:
    """Equirectangular around an origin (3,) llh: exact in metres there, 0.4 % wide at 25 km to its north or south."""

    def __init__(self, origin: ArrayLike) -> None:
        self.origin = np.asarray(origin, np.float64)
        lat, _, h = self.origin
        north = float(meridian_radius(lat)) + h
        east = (float(transverse_radius(lat)) + h) * np.cos(lat)
        self._metres = np.array([north, east, 1.0])

    def llh(self, xyz: Floats) -> Floats:
        """(N, 3) llh of places (N, 3) m; z is height over the origin."""
        llh: Floats = self.origin + xyz[:, [1, 0, 2]] / self._metres
        return llh

    def xyz(self, llh: Floats) -> Floats:
        """(N, 3) m of llh (N, 3)."""
        scaled: Floats = (llh - self.origin) * self._metres
        return scaled[:, [1, 0, 2]]

    def stretch(self, llh: Floats) -> Floats:
        """(N, 2) metres on the earth in a metre of x and of y."""
        lat, h = llh[:, 0], llh[:, 2]
        east = (transverse_radius(lat) + h) * np.cos(lat)
        stretch: Floats = np.stack((east, meridian_radius(lat) + h), axis=-1) / self._metres[[1, 0]]
        return stretch
