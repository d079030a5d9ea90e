"""Curves into polylines whose chords stay within 1 cm of them in the map file too, with as few vertices as that takes.

A file rounds vertices to whole centimetres, which moves them by up to 0.71 cm in the plane.
"""

from collections.abc import Callable

import numpy as np

from sensors.errors import EgolocError
from sensors.maps.vector_map import Floats

CHORD_M = 0.001
"""Chords of the first sampling stay this close to the curve."""
STRAIGHT_M = 0.0015
"""Vertices this close to the line through those kept are dropped: 2.5 mm in all."""
SHORTEST_M = 0.01
"""Where a curve jumps (a lane that begins with a width) halving ends here."""
MAX_SAMPLES = 200_000


def refined(curves: Callable[[Floats], Floats], breaks: Floats) -> Floats:
    """(n,) rising parameters at which the chords of all curves are within CHORD_M of them.

    curves: gives (n, C, 3) points at parameters (n,) in m; breaks: rising parameters between which they are smooth.
    Raises EgolocError where a curve bends so wildly that MAX_SAMPLES vertices do not follow it.
    """
    low, high, kept = breaks[:-1], breaks[1:], [breaks]
    while len(low):
        off = np.zeros(len(low))
        ends = curves(low), curves(high)
        for share in (0.25, 0.5, 0.75):  # a double bend crosses its chord in the middle
            off = np.maximum(off, _chord_distance(curves(low + share * (high - low)), *ends).max(axis=1))
        split = (off > CHORD_M) & (high - low > SHORTEST_M)
        middle = 0.5 * (low + high)[split]
        low, high = np.concatenate((low[split], middle)), np.concatenate((middle, high[split]))
        kept.append(middle)
        if sum(map(len, kept)) > MAX_SAMPLES:
            raise EgolocError(f"expected curves that {MAX_SAMPLES} vertices can follow")
    return np.unique(np.concatenate(kept))


def simplified(xyz: Floats) -> Floats:
    """The vertices (m, 3) of a polyline (n, 3) from which no other is farther than STRAIGHT_M (Douglas-Peucker)."""
    keep = np.zeros(len(xyz), np.bool_)
    keep[[0, -1]] = True
    stack = [(0, len(xyz) - 1)]
    while stack:
        first, last = stack.pop()
        if last - first < 2:
            continue
        off = _chord_distance(xyz[first + 1 : last], xyz[first], xyz[last])
        worst = int(off.argmax())
        if off[worst] > STRAIGHT_M:
            middle = first + 1 + worst
            keep[middle] = True
            stack += [(first, middle), (middle, last)]
    return xyz[keep]


def _chord_distance(points: Floats, start: Floats, end: Floats) -> Floats:
    """Distance of points (..., 3) from the segments between start and end."""
    chord = end - start
    squared = np.maximum((chord**2).sum(axis=-1), 1e-18)
    share = np.clip(((points - start) * chord).sum(axis=-1) / squared, 0.0, 1.0)
    result: Floats = np.linalg.norm(points - start - share[..., None] * chord, axis=-1)
    return result
