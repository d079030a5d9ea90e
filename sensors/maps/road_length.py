"""Length of road from lanes: lanes side by side are one road."""

from collections.abc import Hashable, Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sensors.geodesy import Floats


def polyline_m(xyz: Floats) -> float:
    """Length of a polyline (n, 2) or (n, 3) in the plane."""
    return float(np.hypot(*np.diff(xyz[:, :2], axis=0).T).sum())


def road_km(lane_m: Sequence[float], bounds: Sequence[tuple[Hashable, Hashable]]) -> float:
    """Kilometres of road of N lanes, each with its length and the keys of its left and right bound.

    Lanes that share a bound run side by side, and count once, with their mean length. The carriageways of a divided
    road count each, and so does each turn of a crossroads.
    """
    if not lane_m:
        return 0.0
    number: dict[Hashable, int] = {}
    ends = np.array([[number.setdefault(key, len(number)) for key in pair] for pair in bounds])
    lanes, size = np.arange(len(lane_m)), len(lane_m) + len(number)
    links = coo_array((np.ones(2 * len(lanes)), (np.tile(lanes, 2), len(lanes) + ends.T.ravel())), shape=(size, size))
    road = connected_components(links, directed=False)[1][: len(lanes)]
    return float((np.bincount(road, lane_m) / np.maximum(np.bincount(road), 1)).sum() / 1e3)
