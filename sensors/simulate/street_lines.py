"""Middles of streets as lines in map coordinates, rounded as they are driven, and the ground under them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.simulate.corners import Corners, Curves, round_off
from sensors.simulate.route import place_along

Floats = NDArray[np.float64]
Heights = Callable[[Floats], Floats]
"""(N,) heights m of the ground at places (N, 2) m."""

STEP_M = 3.0
"""Between the vertices of a middle, m."""


class Streets(NamedTuple):
    """Streets end to end. at: (V,) m along them of the vertices xy (V, 2) m; line: (E + 1,) m where each begins."""

    at: Floats
    xy: Floats
    line: Floats
    ground: Heights

    def points(self, s: Floats, offset: Floats | float) -> Floats:
        """(N, 3) so far along and to the left, on the ground."""
        x, y = self._middle(s)
        cos, sin = self.course(s)
        xy = np.column_stack((x - offset * sin, y + offset * cos))
        return np.column_stack((xy, self.ground(xy)))

    def course(self, s: Floats) -> tuple[Floats, Floats]:
        """Its cosine and sine, over 3 m, so that bends are round."""
        (x0, y0), (x1, y1) = self._middle(s - 1.5), self._middle(s + 1.5)
        length = np.hypot(x1 - x0, y1 - y0)
        return (x1 - x0) / length, (y1 - y0) / length

    def _middle(self, s: Floats) -> tuple[Floats, Floats]:
        return np.interp(s, self.at, self.xy[:, 0]), np.interp(s, self.at, self.xy[:, 1])


def streets(middles: Sequence[Floats], ground: Heights) -> Streets:
    """Streets along middles, each (n, 2) m."""
    xy = np.concatenate(middles)
    step = np.zeros(len(xy))
    step[1:] = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    first = np.cumsum([0] + [len(middle) for middle in middles])
    step[first[:-1]] = 0.0  # from the end of one street to the beginning of another
    at = np.cumsum(step)
    return Streets(at, xy, np.append(at[first[:-1]], at[-1]), ground)


def rounded(corners: Corners) -> tuple[Floats, Floats]:
    """(n, 2) m along corners whose curves are rounded as a drive rounds them, and (n,) m along the corners."""
    curves: Curves = round_off(corners)
    count = int(np.ceil(curves.edges[-1] / STEP_M)) + 1
    s = np.linspace(0.0, curves.edges[-1], count)
    xy = corners.xy[0] + place_along(curves.edges, curves.curvature, s, curves.heading)
    return xy, np.interp(s, curves.rounded, curves.polyline)
