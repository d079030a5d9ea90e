"""Checks of each element for itself."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from sensors.maps.health import Check, Finding
from sensors.maps.vector_map import Elements, Floats, Kind, Style

SAME_M = 0.011
"""Vertices nearer than this are one: a map file keeps whole centimetres."""
TURN_DEG = 170.0
"""A line that turns by more than this goes back; the nose of an island is less sharp."""
LEG_M = 0.05
"""Legs of a turn that are shorter than this are a survey's noise."""
SLOPE, RISE_M = 0.35, 0.3
"""Of ground lines: steeper than any street, and more than a curb."""
SIZES: dict[Kind, tuple[float, float, str]] = {
    Kind.STOP_LINE: (0.5, 60.0, "m long"),
    Kind.CROSSING: (1.0, 2000.0, "m^2"),
    Kind.POLE: (0.2, 60.0, "m high"),
    Kind.SIGN: (0.0, 30.0, "m across"),
}
"""Least and greatest size of what has one."""
LEAN = 0.35
"""Top beside the foot, by the pole's height: 20 deg."""

_ON_GROUND = (Kind.LANE_LINE, Kind.ROAD_BOUNDARY, Kind.STOP_LINE, Kind.CROSSING, Kind.MARKING)


def shape_findings(elements: Elements, shapes: NDArray[Any]) -> Iterator[Finding]:
    """Findings of every element for itself. shapes: (N,) the elements as ``sensors.maps.geometries`` has them."""
    step, slope = _steps(elements)
    counts = np.diff(elements.first)
    long = counts > 1
    extent = np.add.reduceat(step, elements.first[:-1])
    for row in np.flatnonzero(long & (extent < SAME_M)):
        yield _at(elements, Check.ZERO_LENGTH, row, 0, f"{counts[row]} vertices within {extent[row]:.3f} m")
    inner = np.ones(len(step), bool)
    inner[elements.first[:-1]] = False
    of = np.repeat(np.arange(len(elements)), counts)
    for vertex in np.flatnonzero(inner & (step < SAME_M) & (extent >= SAME_M)[of]):
        detail = f"vertices {vertex - elements.first[of[vertex]] - 1} and the next, {step[vertex]:.3f} m apart"
        yield _at(elements, Check.REPEATED_VERTEX, of[vertex], vertex - elements.first[of[vertex]], detail)
    grounded = np.isin(elements.kind, _ON_GROUND) & (elements.style != Style.BARRIER)
    for vertex in np.flatnonzero(inner & grounded[of] & (np.abs(slope) > SLOPE)):
        rise = elements.xyz[vertex, 2] - elements.xyz[vertex - 1, 2]
        if abs(rise) > RISE_M:
            detail = f"by {rise:+.2f} m within {step[vertex]:.2f} m"
            yield _at(elements, Check.STEEP, of[vertex], vertex - elements.first[of[vertex]], detail)
    yield from _turns(elements, of)
    yield from _crossing_themselves(elements, shapes)
    yield from _rings(elements, counts)
    yield from _sizes(elements)


def _at(elements: Elements, check: Check, row: int | np.integer, vertex: int | np.integer, detail: str) -> Finding:
    x, y = elements.vertices(int(row))[int(vertex), :2].tolist()
    return Finding(check, (int(row),), x, y, detail)


def _steps(elements: Elements) -> tuple[Floats, Floats]:
    """(M,) distance to each vertex from the one before, m (0 for the first of an element), and slope, NaN: unknown.

    In space where both heights are known, in the plane where not.
    """
    delta = np.diff(elements.xyz, axis=0, prepend=elements.xyz[:1])
    flat = np.hypot(delta[:, 0], delta[:, 1])
    step = np.hypot(flat, np.nan_to_num(delta[:, 2]))
    slope = delta[:, 2] / np.maximum(flat, 1e-3)
    step[elements.first[:-1]], slope[elements.first[:-1]] = 0.0, np.nan
    return step, slope


def _turns(elements: Elements, of: NDArray[np.int64]) -> Iterator[Finding]:
    """Vertices at which a line on the ground goes back."""
    if len(elements.xyz) < 3:
        return
    leg = np.diff(elements.xyz[:, :2], axis=0)
    length = np.hypot(*leg.T)
    before, after = leg[:-1], leg[1:]
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = (before * after).sum(axis=1) / (length[:-1] * length[1:])
    within = (of[:-2] == of[2:]) & (length[:-1] > LEG_M) & (length[1:] > LEG_M)
    back = within & (cosine < np.cos(np.radians(TURN_DEG))) & np.isin(elements.kind[of[1:-1]], _ON_GROUND)
    for vertex in np.flatnonzero(back) + 1:
        turn = np.degrees(np.arccos(max(cosine[vertex - 1], -1.0)))
        yield _at(elements, Check.TURNS_BACK, of[vertex], vertex - elements.first[of[vertex]], f"by {turn:.0f} deg")


def _crossing_themselves(elements: Elements, shapes: NDArray[Any]) -> Iterator[Finding]:
    suspect = np.isin(elements.kind, _ON_GROUND) & (elements.style != Style.ARROW) & (np.diff(elements.first) > 2)
    for row in np.flatnonzero(suspect)[~shapely.is_simple(shapes[suspect])]:
        place = _crossing(elements.vertices(int(row))[:, :2])
        if place is not None:
            yield Finding(Check.SELF_INTERSECTION, (int(row),), *place, "at this place first")


def _crossing(xy: Floats) -> tuple[float, float] | None:
    """Where a line first meets itself; None where it only turns back on its last leg, which is no crossing."""
    xy = xy[np.concatenate(([True], np.hypot(*np.diff(xy, axis=0).T) > 0.0))]
    legs = shapely.linestrings(np.stack((xy[:-1], xy[1:]), axis=1))
    one, other = shapely.STRtree(legs).query(legs, predicate="intersects")
    closed = bool((xy[0] == xy[-1]).all())
    apart = (other > one + 1) & ~(closed & (one == 0) & (other == len(legs) - 1))
    if not apart.any():
        return None
    pair = np.lexsort((other[apart], one[apart]))[0]
    place = shapely.intersection(legs[one[apart][pair]], legs[other[apart][pair]])
    x, y = shapely.get_coordinates(place)[0].tolist()
    return x, y


def _rings(elements: Elements, counts: NDArray[np.int64]) -> Iterator[Finding]:
    first, last = elements.xyz[elements.first[:-1]], elements.xyz[elements.first[1:] - 1]
    apart = np.hypot(*(first - last)[:, :2].T)
    faces = (elements.kind == Kind.CROSSING) | ((elements.kind == Kind.SIGN) & (counts > 1))
    for row in np.flatnonzero(faces & ((apart >= SAME_M) | (counts < 4))):
        detail = f"{counts[row]} vertices, ends {apart[row]:.2f} m apart"
        yield _at(elements, Check.OPEN_RING, row, 0, detail)


def _sizes(elements: Elements) -> Iterator[Finding]:
    for kind, (least, most, unit) in SIZES.items():
        for row in np.flatnonzero(elements.kind == kind):
            xyz = elements.vertices(int(row))
            size = _size(kind, xyz)
            if not np.isnan(size) and not least <= size <= most:
                yield _at(elements, Check.SIZE, row, 0, f"{kind.name.lower()} {size:.2f} {unit}")
            if kind is Kind.POLE and len(xyz) > 1:
                rise, beside = xyz[-1, 2] - xyz[0, 2], np.hypot(*(xyz[-1] - xyz[0])[:2])
                if rise <= 0.0 or beside > LEAN * rise:
                    detail = f"top {rise:+.2f} m above the foot and {beside:.2f} m beside it"
                    yield _at(elements, Check.LEANING, row, 0, detail)


def _size(kind: Kind, xyz: Floats) -> float:
    """Of an element; NaN where it has none (one vertex)."""
    if len(xyz) < 2:
        return np.nan
    if kind is Kind.CROSSING:
        x, y = (xyz[:, :2] - xyz[0, :2]).T
        return float(abs((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) / 2.0)
    if kind is Kind.POLE:
        return float(abs(xyz[-1, 2] - xyz[0, 2]))
    return float(np.linalg.norm(np.nan_to_num(np.ptp(xyz, axis=0))))
