"""Clouds of any size as moments of voxels: each point is looked at once, memory follows the voxels that are occupied.

The order of the points changes nothing but the rounding.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors.errors import EgolocError
from sensors.maps._voxel_kernels import (
    FREE,
    FULL,
    HALF_X,
    HALF_Z,
    WRONG,
    X_BITS,
    Z_BITS,
    add_points,
    add_windows,
    enter_keys,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FIRST_ROOM = 1 << 14
"""Voxels that a new cloud has room for."""


class Moments(NamedTuple):
    """Of W windows. points: (W,) how many; mean: (W, 3) m in the map; cov: (W, 3, 3) m^2, divided by how many;
    middle: (W, 3) m, of the window."""

    points: Floats
    mean: Floats
    cov: Floats
    middle: Floats


class Voxels:
    """Points gathered in cubes of voxel_m; their corners lie on multiples of voxel_m.

    apart_s: how much later a voxel must be hit again for that to be another sighting of it.
    """

    def __init__(self, voxel_m: float, apart_s: float = 0.0) -> None:
        self.voxel_m = float(voxel_m)
        self._apart_ns = round(apart_s * 1e9)
        self._origin: Ints | None = None
        self._used = 0
        self._keys: Ints = np.empty(0, np.int64)
        self._moments: Floats = np.empty((0, 10))
        self._seen_ns: Ints = np.empty(0, np.int64)
        self._sightings: NDArray[np.int32] = np.empty(0, np.int32)
        self._room(FIRST_ROOM)

    def __len__(self) -> int:
        """Voxels that hold points."""
        return self._used

    def add(self, xyz: ArrayLike, t_ns: int = 0) -> None:
        """Add points (N, 3) m, seen at t_ns; moments must come in rising order where sightings are asked for.

        Raises EgolocError for points that are not finite or not of one place on the earth.
        """
        points = np.ascontiguousarray(xyz, np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise EgolocError(f"points: expected shape (N, 3), got {points.shape}")
        if self._origin is None:
            self._origin = self._place(points)
        done = 0
        while done < len(points):
            done, self._used, row = add_points(
                points,
                done,
                self.voxel_m,
                self._origin,
                t_ns,
                self._apart_ns,
                self._slots,
                self._keys,
                self._moments,
                self._seen_ns,
                self._sightings,
                self._used,
            )
            if row == WRONG:
                self._refuse(points[done])
            if row == FULL:
                self._room(2 * len(self._keys))

    def sighted(self, least: int) -> NDArray[np.bool_]:
        """(M,) which voxels were sighted so often."""
        kept: NDArray[np.bool_] = self._sightings[: self._used] >= least
        return kept

    def sightings(self) -> NDArray[np.int32]:
        """(M,) how often each was sighted."""
        return self._sightings[: self._used]

    def windows(self, rows: Ints, kept: NDArray[np.bool_], reach: int, min_points: int) -> Moments:
        """Cubes of reach^3 voxels, in all places, with min_points or more: those whose first voxel is one of rows (R,).

        kept: (M,) which voxels count. reach 1: the voxels themselves.
        """
        sums = np.empty((len(rows) * reach**3 + 1, 10))
        corners = np.empty(len(sums), np.int64)
        table = (self._slots, rows, self._keys, self._moments, kept)
        count = add_windows(*table, self.voxel_m, reach, float(min_points), corners, sums)
        points, corner = sums[:count, 0], self._middles(corners[:count])
        mean = sums[:count, 1:4] / points[:, None]
        upper = sums[:count, 4:] / points[:, None]
        cov = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
        return Moments(points, corner + mean, cov, corner + (reach - 1) / 2.0 * self.voxel_m)

    def means(self) -> Floats:
        """(M, 3) m, mean of the points of each voxel: a thinned cloud."""
        moments = self._moments[: self._used]
        return self._middles(self._keys[: self._used]) + moments[:, 1:4] / moments[:, :1]

    def _middles(self, keys: Ints) -> Floats:
        """(W, 3) m, middles of voxels."""
        mask = (1 << X_BITS) - 1
        place = np.stack((keys >> (X_BITS + Z_BITS), keys >> Z_BITS & mask, keys & (1 << Z_BITS) - 1), axis=-1)
        origin = np.zeros(3, np.int64) if self._origin is None else self._origin
        middles: Floats = (place - (HALF_X, HALF_X, HALF_Z) + origin + 0.5) * self.voxel_m
        return middles

    def _place(self, points: Floats) -> Ints | None:
        """The voxel of the first point, from which places are counted."""
        if not len(points):
            return None
        if not (np.abs(points[0]) < 1e9).all():
            self._refuse(points[0])
        place: Ints = np.floor(points[0] / self.voxel_m).astype(np.int64)
        return place

    def _room(self, room: int) -> None:
        """Make room for so many voxels."""
        self._keys = _longer(self._keys, room)
        self._moments = _longer(self._moments, room)
        self._seen_ns = _longer(self._seen_ns, room)
        self._sightings = _longer(self._sightings, room)
        self._slots = np.full((2 * room, 2), FREE, np.int64)
        enter_keys(self._slots, self._keys, self._used)

    def _refuse(self, point: Floats) -> None:
        if not np.isfinite(point).all():
            raise EgolocError(f"points: expected finite coordinates, got {point}")
        side, height = HALF_X * self.voxel_m / 1e3, HALF_Z * self.voxel_m
        raise EgolocError(
            f"points: expected one place on the earth, got one more than {side:.0f} km aside or {height:.0f} m above "
            f"or below the first: {point}"
        )


def _longer(column: NDArray[Any], room: int) -> NDArray[Any]:
    """A column with zeros behind it."""
    longer = np.zeros((room, *column.shape[1:]), column.dtype)
    longer[: len(column)] = column
    return longer
