"""Checks of elements beside each other."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from sensors.maps.health import Check, Finding
from sensors.maps.vector_map import Elements, Floats, Kind, Style, Surfels

SAME_PLACE_M = 0.05
"""Elements whose points are all so near to each other lie at one place; the lines of a double one are 0.1 m apart."""
STOREY_M = 2.0
"""What is so far above is another level of the road."""
REACH_M: dict[Kind, float] = {
    Kind.LANE_LINE: 12.0,
    Kind.STOP_LINE: 4.0,
    Kind.CROSSING: 6.0,
    Kind.MARKING: 6.0,
    Kind.POLE: 30.0,
    Kind.SIGN: 30.0,
}
"""How far from a line of the road a thing may be: widths of lanes, of shoulders, of what stands beside roads."""
SURFEL_REACH_M = 80.0
"""Twice EgoVM's view to a side."""
JOINT_M, GAP_M, ALONG_DEG = 0.02, 0.5, 20.0
"""Ends nearer than JOINT_M are joined; as far as GAP_M, and in one direction, they are meant to be."""
STEP_M = 0.15
"""Between the heights of lines that meet."""

_LINES = (Kind.LANE_LINE, Kind.ROAD_BOUNDARY)
Rows = NDArray[np.int64]


def neighbour_findings(elements: Elements, shapes: NDArray[Any], surfels: Surfels) -> Iterator[Finding]:
    """Findings between elements. shapes: (N,) the elements as ``sensors.maps.geometries`` has them."""
    seen = elements.style != Style.VIRTUAL
    tree = shapely.STRtree(shapes)
    yield from _repeated(elements, shapes, seen)
    yield from _off_road(elements, shapes, seen)
    yield from _off_road_surfels(elements, surfels, shapes)
    yield from _ends(elements, seen)
    painted = np.flatnonzero((elements.kind == Kind.LANE_LINE) & seen)
    edges = (elements.kind == Kind.ROAD_BOUNDARY) & np.isin(elements.style, (Style.CURB, Style.BARRIER))
    one, other = tree.query(shapes[painted], predicate="crosses")
    for row, edge in zip(painted[one][edges[other]], other[edges[other]], strict=True):
        if abs(_height(elements, row) - _height(elements, edge)) > STOREY_M:
            continue
        x, y = shapely.get_coordinates(shapely.intersection(shapes[row], shapes[edge]))[0].tolist()
        yield Finding(Check.CROSSES_BOUNDARY, (int(row), int(edge)), x, y, "first crossing")


def _repeated(elements: Elements, shapes: NDArray[Any], seen: NDArray[np.bool_]) -> Iterator[Finding]:
    """Elements that lie on others of their kind."""
    for kind in Kind:
        rows = np.flatnonzero((elements.kind == kind) & seen)
        if len(rows) < 2:
            continue
        one, other = shapely.STRtree(shapes[rows]).query(shapes[rows], predicate="dwithin", distance=SAME_PLACE_M)
        pairs = one != other
        one, other = rows[one[pairs]], rows[other[pairs]]
        on = _lies_on(elements, shapes, one, other)
        found = set(zip(one[on].tolist(), other[on].tolist(), strict=True))
        for row, under in sorted(found):
            both = (under, row) in found
            if both and row > under:
                continue
            check = Check.DUPLICATE if both else Check.COVERED
            if both or kind not in (Kind.POLE, Kind.SIGN):
                x, y = elements.vertices(row)[0, :2].tolist()
                yield Finding(check, (row, under), x, y, f"within {SAME_PLACE_M:g} m")


def _lies_on(elements: Elements, shapes: NDArray[Any], one: Rows, other: Rows) -> NDArray[np.bool_]:
    """(P,) whether all vertices and middles of legs of one lie on the other, at its level."""
    points, pair = _samples(elements, one)
    far = shapely.distance(shapely.points(points), shapes[other][pair]) > SAME_PLACE_M
    off = np.bincount(pair[far], minlength=len(one)) > 0
    height = _heights(elements)
    upright = np.isin(elements.kind[one], (Kind.POLE, Kind.SIGN))  # faces of one pole, one above the other
    with np.errstate(invalid="ignore"):
        level = ~(np.abs(height[one] - height[other]) > np.where(upright, SAME_PLACE_M, STOREY_M))
    return ~off & level


def _samples(elements: Elements, rows: Rows) -> tuple[Floats, Rows]:
    """Vertices and middles of legs of elements (rows may repeat), and the position in rows that each belongs to."""
    counts = np.diff(elements.first)[rows]
    pair = np.repeat(np.arange(len(rows)), counts)
    place = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
    xy = elements.xyz[elements.first[:-1][rows][pair] + place, :2]
    inner = place[1:] > 0
    middles = 0.5 * (xy[:-1] + xy[1:])[inner]
    return np.concatenate((xy, middles)), np.concatenate((pair, pair[1:][inner]))


def _heights(elements: Elements) -> Floats:
    """(N,) mean height of each element, NaN where not known."""
    known = np.isfinite(elements.xyz[:, 2])
    total = np.add.reduceat(np.where(known, elements.xyz[:, 2], 0.0), elements.first[:-1])
    count = np.add.reduceat(known.astype(np.float64), elements.first[:-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean: Floats = total / count
    return mean


def _height(elements: Elements, row: int) -> float:
    heights = elements.vertices(int(row))[:, 2]
    return float(heights[np.isfinite(heights)].mean()) if np.isfinite(heights).any() else 0.0


def _off_road(elements: Elements, shapes: NDArray[Any], seen: NDArray[np.bool_]) -> Iterator[Finding]:
    lines = np.flatnonzero(np.isin(elements.kind, _LINES))
    if len(lines) < 2:
        return
    tree = shapely.STRtree(shapes[lines])
    for kind, reach in REACH_M.items():
        rows = np.flatnonzero((elements.kind == kind) & seen)
        one, other = tree.query(shapes[rows], predicate="dwithin", distance=reach)
        near = np.bincount(one[rows[one] != lines[other]], minlength=len(rows)) > 0
        for row in rows[~near]:
            x, y = elements.vertices(int(row))[0, :2].tolist()
            yield Finding(Check.OFF_ROAD, (int(row),), x, y, f"none within {reach:g} m of the {kind.name.lower()}")


def _off_road_surfels(elements: Elements, surfels: Surfels, shapes: NDArray[Any]) -> Iterator[Finding]:
    lines = shapes[np.isin(elements.kind, _LINES)]
    if not len(surfels) or not len(lines):
        return
    places = shapely.points(surfels.p)
    near = np.zeros(len(surfels), bool)
    near[shapely.STRtree(lines).query(places, predicate="dwithin", distance=SURFEL_REACH_M)[0]] = True
    if not near.all():
        x, y = surfels.p[np.argmin(near)].tolist()
        yield Finding(Check.OFF_ROAD, (), x, y, f"{(~near).sum()} surfels, none within {SURFEL_REACH_M:g} m of them")


class _Ends(NamedTuple):
    """E ends of lines. of: (E,) rows; at: (E, 3) m; inwards: (E, 3) from the end to the vertex before it."""

    of: Rows
    at: Floats
    inwards: Floats


def _ends(elements: Elements, seen: NDArray[np.bool_]) -> Iterator[Finding]:
    """Gaps and steps between lines of a kind that end near each other; gaps only where one goes on in the other."""
    rows = np.flatnonzero(np.isin(elements.kind, _LINES) & seen & (np.diff(elements.first) > 1))
    begin, end = elements.first[:-1][rows], elements.first[1:][rows] - 1
    at = elements.xyz[np.concatenate((begin, end))]
    ends = _Ends(np.concatenate((rows, rows)), at, elements.xyz[np.concatenate((begin + 1, end - 1))] - at)
    one, other = _near_ends(elements, ends)
    apart = np.hypot(*(at[one] - at[other])[:, :2].T)
    joined = np.bincount(one[apart <= JOINT_M], minlength=len(at)) > 0
    once = ends.of[one] < ends.of[other]
    gaps = once & (apart > JOINT_M) & ~joined[one] & ~joined[other] & _onwards(elements, ends, one, other)
    yield from _pairs(ends, Check.GAP, one[gaps], other[gaps], [f"{each:.2f} m" for each in apart[gaps]])
    rise = at[other, 2] - at[one, 2]
    with np.errstate(invalid="ignore"):
        steps = once & (apart <= JOINT_M) & (np.abs(rise) > STEP_M) & (np.abs(rise) < STOREY_M)
    yield from _pairs(ends, Check.HEIGHT_STEP, one[steps], other[steps], [f"{each:+.2f} m" for each in rise[steps]])


def _near_ends(elements: Elements, ends: _Ends) -> tuple[Rows, Rows]:
    """Pairs of ends of two lines of a kind within GAP_M of each other, each in both orders."""
    points = shapely.points(ends.at[:, :2])
    one, other = shapely.STRtree(points).query(points, predicate="dwithin", distance=GAP_M)
    kind = elements.kind[ends.of]
    alike = (ends.of[one] != ends.of[other]) & (kind[one] == kind[other])
    return one[alike], other[alike]


def _pairs(ends: _Ends, check: Check, one: Rows, other: Rows, details: list[str]) -> Iterator[Finding]:
    for a, b, detail in zip(one, other, details, strict=True):
        x, y = ends.at[a, :2].tolist()
        yield Finding(check, (int(ends.of[a]), int(ends.of[b])), x, y, detail)


def _onwards(elements: Elements, ends: _Ends, one: Rows, other: Rows) -> NDArray[np.bool_]:
    """(P,) whether lines of a style, seen from these ends, go on in each other."""
    a, b = ends.inwards[one, :2], ends.inwards[other, :2]
    cosine = (a * b).sum(axis=1) / np.maximum(np.hypot(*a.T) * np.hypot(*b.T), 1e-9)
    style = elements.style[ends.of]
    result: NDArray[np.bool_] = (cosine < -np.cos(np.radians(ALONG_DEG))) & (style[one] == style[other])
    return result
