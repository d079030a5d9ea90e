"""Corners rounded into arcs: a polyline becomes straights and curves, and places on the one find those on the other."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.rotation import wrap

Floats = NDArray[np.float64]

SHARE = 0.45
"""Share of a straight that the curve at either of its ends may take."""


class Corners(NamedTuple):
    """xy: (C, 2) m; curve: (C,) m radius of a bend, 0 at junctions; setback: (C,) m from a junction at which a turn of
    90 degrees begins (softer ones begin there as well, so they are wider; sharper ones keep its radius)."""

    xy: Floats
    curve: Floats
    setback: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """edges: (M + 1,) m and curvature: (M,) 1/m of straights and arcs; heading: rad of the first straight.

    begins: (C,) m at which the curve of each corner begins; polyline, rounded: (U,) m along the corners and along the
    curves of the same places.
    """

    edges: Floats
    curvature: Floats
    heading: float
    begins: Floats
    polyline: Floats
    rounded: Floats


def round_off(corners: Corners) -> Curves:
    """Straights and arcs along the corners, from the first to the last."""
    step = np.diff(corners.xy, axis=0)
    length = np.linalg.norm(step, axis=1)
    heading = np.arctan2(step[:, 1], step[:, 0])
    turn = wrap(np.diff(heading))
    tangent = np.tan(np.abs(turn) / 2)
    soft = np.maximum(tangent, 1e-12)
    radius = np.where(corners.curve[1:-1] > 0, corners.curve[1:-1], corners.setback[1:-1] * np.maximum(1.0, 1.0 / soft))
    cut = np.minimum(radius * tangent, SHARE * np.minimum(length[1:], length[:-1]))
    arc = np.where(tangent > 1e-9, cut / soft * np.abs(turn), 0.0)
    cuts = np.concatenate(([0.0], cut, [0.0]))
    lengths = np.empty(2 * len(length) - 1)
    lengths[::2], lengths[1::2] = length - cuts[:-1] - cuts[1:], arc
    edges = np.concatenate(([0.0], np.cumsum(lengths)))
    curvature = np.zeros(len(lengths))
    curvature[1::2] = np.divide(turn, arc, out=np.zeros_like(turn), where=arc > 0)
    keep = lengths > 0
    begins = np.concatenate((edges[:1], edges[1:-1:2], edges[-1:]))
    middle = begins[1:-1] + arc / 2
    at = np.concatenate(([0.0], np.cumsum(length)))
    polyline = np.stack((at[1:-1] - cut, at[1:-1], at[1:-1] + cut), axis=-1).ravel()
    rounded = np.stack((begins[1:-1], middle, begins[1:-1] + arc), axis=-1).ravel()
    return Curves(
        edges=np.append(edges[:-1][keep], edges[-1]),
        curvature=curvature[keep],
        heading=float(heading[0]),
        begins=begins,
        polyline=np.concatenate(([0.0], polyline, at[-1:])),
        rounded=np.concatenate(([0.0], rounded, edges[-1:])),
    )
