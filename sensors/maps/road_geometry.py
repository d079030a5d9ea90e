"""The reference line of an OpenDRIVE road: position and heading at s, for line, arc, spiral, poly3 and paramPoly3.

Lines, arcs and spirals are one thing, a curve whose curvature is linear in its length; its position is integrated by
Gauss-Legendre quadrature, exact to rounding for the bends allowed here. Source: ASAM OpenDRIVE 1.8, section 9.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sensors.maps.vector_map import Codes, Floats

MAX_TURN_RAD = 20.0 * np.pi
"""A piece of a reference line turns ten times at most; a ramp of a car park turns less than two."""
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
NODES, WEIGHTS = 0.5 * (NODES + 1.0), 0.5 * WEIGHTS
"""On 0..1: eight nodes integrate cos and sin over a turn of 1 rad to 1e-15."""


class Shape(IntEnum):
    """What the coefficients of a piece are; ds is the length along it."""

    CLOTHOID = 0
    """Curvature at its start and its end, 1/m (line and arc too)."""
    CUBIC = 1
    """v = a + b u + c u^2 + d u^3, the curve's length being ds (poly3)."""
    PARAMETRIC = 2
    """u = a + b ds + c ds^2 + d ds^3, then v alike (paramPoly3, its parameter scaled to metres)."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanView:
    """P pieces of a reference line, in rising s.

    s, x, y, heading, length: (P,) m, rad; shape: (P,) Shape; coefficients: (P, 8), unused ones zero.
    """

    s: Floats
    x: Floats
    y: Floats
    heading: Floats
    length: Floats
    shape: Codes
    coefficients: Floats

    def at(self, s: Floats) -> Floats:
        """(n, 3) x, y m and heading rad at s (n,); beyond either end the last curve is continued."""
        rows = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 1)
        uvh = self._local(rows, s - self.s[rows])
        heading = self.heading[rows]
        cos, sin = np.cos(heading), np.sin(heading)
        x = self.x[rows] + cos * uvh[:, 0] - sin * uvh[:, 1]
        y = self.y[rows] + sin * uvh[:, 0] + cos * uvh[:, 1]
        return np.column_stack((x, y, heading + uvh[:, 2]))

    def _local(self, rows: NDArray[np.intp], ds: Floats) -> Floats:
        """(n, 3) u, v, heading in the pieces' own axes, their lengths ds (n,)."""
        result = np.empty((len(ds), 3))
        for shape, curve in ((Shape.CLOTHOID, _clothoid), (Shape.CUBIC, _cubic), (Shape.PARAMETRIC, _parametric)):
            chosen = self.shape[rows] == shape
            if chosen.any():
                piece = rows[chosen]
                result[chosen] = curve(self.coefficients[piece], self.length[piece], ds[chosen])
        return result


def _clothoid(curvature: Floats, length: Floats, ds: Floats) -> Floats:
    """Curvature is (n, 8), at start and end in its first two columns."""
    rate = (curvature[:, 1] - curvature[:, 0]) / length
    turn = np.abs(curvature[:, :2]).max(axis=1) * np.maximum(length, np.abs(ds))
    panels = np.clip(np.ceil(turn), 1.0, np.ceil(MAX_TURN_RAD))
    result = np.empty((len(ds), 3))
    for count in np.unique(panels):  # one panel of nodes per radian
        rows = panels == count
        fraction = ((np.arange(count)[:, None] + NODES) / count).ravel()
        along = ds[rows, None] * fraction
        angle = along * (curvature[rows, :1] + 0.5 * rate[rows, None] * along)
        weights = np.tile(WEIGHTS / count, int(count))
        result[rows, 0] = ds[rows] * (np.cos(angle) @ weights)
        result[rows, 1] = ds[rows] * (np.sin(angle) @ weights)
    result[:, 2] = ds * (curvature[:, 0] + 0.5 * rate * ds)
    return result


def _cubic(abcd: Floats, _: Floats, ds: Floats) -> Floats:
    """u comes from the length by Newton steps, its own length by quadrature over 16 panels."""
    fraction = ((np.arange(16)[:, None] + NODES) / 16).ravel()
    weights = np.tile(WEIGHTS / 16, 16)
    u = ds.copy()
    for _step in range(30):
        speed = np.hypot(1.0, _slope(abcd[:, None, :4], u[:, None] * fraction))
        step = (u * (speed @ weights) - ds) / np.hypot(1.0, _slope(abcd[:, :4], u))
        u = u - step
        if np.abs(step).max() < 1e-9:
            break
    return np.column_stack((u, _value(abcd[:, :4], u), np.arctan(_slope(abcd[:, :4], u))))


def _parametric(uv: Floats, _: Floats, ds: Floats) -> Floats:
    u, v = uv[:, :4], uv[:, 4:]
    return np.column_stack((_value(u, ds), _value(v, ds), np.arctan2(_slope(v, ds), _slope(u, ds))))


def _value(abcd: Floats, x: Floats) -> Floats:
    a, b, c, d = np.moveaxis(abcd, -1, 0)
    result: Floats = a + x * (b + x * (c + x * d))
    return result


def _slope(abcd: Floats, x: Floats) -> Floats:
    _, b, c, d = np.moveaxis(abcd, -1, 0)
    result: Floats = b + x * (2.0 * c + x * 3.0 * d)
    return result
