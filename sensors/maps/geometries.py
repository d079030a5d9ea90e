"""Elements as shapely's geometries, in the plane."""

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from sensors.maps.vector_map import Elements


def geometries(elements: Elements) -> NDArray[Any]:
    """(N,) a LineString of each element, a Point of one that is at one place: a line without length is near nothing."""
    counts = np.diff(elements.first)
    result = np.empty(len(elements), object)
    of, xy = np.repeat(np.arange(len(elements)), counts), elements.xyz[:, :2]
    begin = xy[elements.first[:-1]]
    single = ~np.logical_or.reduceat((xy != begin[of]).any(axis=1), elements.first[:-1])
    result[single] = shapely.points(begin[single])
    rank = np.cumsum(~single) - 1
    result[~single] = shapely.linestrings(xy[~single[of]], indices=rank[of[~single[of]]])
    return result
