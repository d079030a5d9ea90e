"""A made-up city as a vector map: what stands along the streets of a random network, and surfels. Of a seed.

It is for sizes and speeds: vertices carry a survey's noise and surfels those of a scanner, so that it compresses no
better than a real map does.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.geodesy import MapFrame
from sensors.maps.vector_map import NO_SURFELS, Colour, Elements, Kind, Style, Surfels, VectorMap
from sensors.simulate.noise import stream
from sensors.simulate.streets import Blocks, lay_out

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Rng = np.random.Generator

BLOCKS = Blocks(least_m=80.0, most_m=350.0, missing=0.1, bent=0.3)
SETBACK_M = 12.0
"""Lines end this long before a junction, m."""
SPACING_M = 3.0
"""Between the vertices of a line, m."""
SURVEY_M = 0.01
"""Noise of a vertex, one sigma, m."""
HALF_WIDTH_M = 7.0
"""From the middle of the street to its curb, m."""
LINES = (
    (Kind.LANE_LINE, Style.DOUBLE_SOLID, Colour.YELLOW, 0.0),
    (Kind.LANE_LINE, Style.DASHED, Colour.WHITE, 3.5),
    (Kind.LANE_LINE, Style.DASHED, Colour.WHITE, -3.5),
    (Kind.ROAD_BOUNDARY, Style.CURB, Colour.UNKNOWN, HALF_WIDTH_M),
    (Kind.ROAD_BOUNDARY, Style.CURB, Colour.UNKNOWN, -HALF_WIDTH_M),
)
"""Kind, style, colour and offset to the left, m, of the lines along a street."""
GROUND_PER_M, WALL_PER_M, CLUTTER_PER_M = 7.0, 1.6, 2.4
"""Surfels a metre of street: of its surface, of houses, of trees and cars."""


class _Streets(NamedTuple):
    """All streets end to end. at: (V,) m along them of the vertices xy (V, 2); line: (E + 1,) m where each begins."""

    at: Floats
    xy: Floats
    line: Floats

    def points(self, s: Floats, offset: Floats | float) -> Floats:
        """(N, 3) so far along and to the left, on the ground."""
        x, y = self._middle(s)
        cos, sin = self.course(s)
        xy = np.column_stack((x - offset * sin, y + offset * cos))
        return np.column_stack((xy, _ground(xy)))

    def course(self, s: Floats) -> tuple[Floats, Floats]:
        """Its cosine and sine, over 3 m, so that bends are round."""
        (x0, y0), (x1, y1) = self._middle(s - 1.5), self._middle(s + 1.5)
        length = np.hypot(x1 - x0, y1 - y0)
        return (x1 - x0) / length, (y1 - y0) / length

    def _middle(self, s: Floats) -> tuple[Floats, Floats]:
        return np.interp(s, self.at, self.xy[:, 0]), np.interp(s, self.at, self.xy[:, 1])


class _Block(NamedTuple):
    """Elements of one sort: counts (n,) of vertices, xyz of them all."""

    kind: Kind
    style: Style
    colour: Colour
    counts: Ints
    xyz: Floats


def city_map(length_km: float, seed: int, *, surfels: bool = True) -> VectorMap:
    """About so many kilometres of streets in one city, in a UTM frame; some 11,000 surfels a kilometre."""
    rng = stream(seed, "city map")
    streets = _streets(length_km * 1000.0, rng)
    begin, end = streets.line[:-1] + SETBACK_M, streets.line[1:] - SETBACK_M
    blocks = [*_lines(streets, begin, end), *_junctions(streets, begin, end), *_furniture(streets, rng)]
    patches = _surfels(streets, rng) if surfels else NO_SURFELS
    frame = MapFrame("utm", (455_000.0, 5_427_000.0, 0.0), 32)
    source = f"city map of seed {seed}"
    return VectorMap(frame, _elements(blocks, rng), patches, (source,), float(streets.line[-1]) / 1000.0)


def _streets(length_m: float, rng: Rng) -> _Streets:
    graph = lay_out(BLOCKS, length_m, 0.0, 1, (30.0, 30.0), rng)
    line = np.concatenate(([0.0], np.cumsum(graph.lengths())))
    step = np.zeros(len(graph.vertices))
    step[1:] = np.linalg.norm(np.diff(graph.vertices, axis=0), axis=1)
    step[graph.first[:-1]] = 0.0  # from the end of one street to the beginning of another
    return _Streets(np.cumsum(step), graph.vertices, line)


def _ground(xy: Floats) -> Floats:
    """(N,) height: hills of 20 m."""
    x, y = xy.T
    height: Floats = 110.0 + 20.0 * np.sin(x / 700.0) * np.cos(y / 900.0) + 2.0 * np.sin(x / 90.0 + y / 130.0)
    return height


def _lines(streets: _Streets, begin: Floats, end: Floats) -> list[_Block]:
    counts = np.ceil((end - begin) / SPACING_M).astype(np.intp) + 1
    row = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    s = np.repeat(begin, counts) + row * np.repeat((end - begin) / (counts - 1), counts)
    return [_Block(kind, style, colour, counts, streets.points(s, left)) for kind, style, colour, left in LINES]


def _junctions(streets: _Streets, begin: Floats, end: Floats) -> list[_Block]:
    """Stop line and crossing at both ends of each street, an arrow before them."""
    blocks = []
    for at, ahead in ((begin, 1.0), (end, -1.0)):
        w = HALF_WIDTH_M
        stop = [(4.0 * ahead, 0.0), (4.0 * ahead, -w * ahead)]
        crossing = [(0.0, -w), (0.0, w), (3.0 * ahead, w), (3.0 * ahead, -w), (0.0, -w)]
        arrow = [(14.0 * ahead, -1.75), (10.0 * ahead, -1.75), (10.5 * ahead, -2.0)]
        blocks += [
            _shape(streets, at, stop, Kind.STOP_LINE, Style.SOLID),
            _shape(streets, at, crossing, Kind.CROSSING, Style.ZEBRA),
            _shape(streets, at, arrow, Kind.MARKING, Style.ARROW),
        ]
    return blocks


def _shape(streets: _Streets, at: Floats, shape: list[tuple[float, float]], kind: Kind, style: Style) -> _Block:
    """White paint of the same shape, vertices (along, left) m, at many places."""
    along, left = np.array(shape).T
    xyz = streets.points((at[:, None] + along).ravel(), np.tile(left, len(at)))
    return _Block(kind, style, Colour.WHITE, np.full(len(at), len(shape)), xyz)


def _furniture(streets: _Streets, rng: Rng) -> list[_Block]:
    """Poles, a third of which bear a sign."""
    side = np.where(rng.random(int(streets.line[-1] / 15.0)) < 0.5, -1.0, 1.0)
    s = rng.uniform(0.0, streets.line[-1], len(side))
    foot = streets.points(s, side * rng.uniform(8.0, 9.5, len(side)))
    top = foot + np.outer(rng.uniform(2.5, 9.0, len(side)), (0.0, 0.0, 1.0))
    poles = np.stack((foot, top), axis=1).reshape(-1, 3)
    signed = slice(None, None, 3)
    cos, sin = streets.course(s[signed])
    across = np.stack((-sin, cos, np.zeros_like(sin)), axis=-1)
    right, up = np.array([-0.3, 0.3, 0.3, -0.3, -0.3]), np.array([0.0, 0.0, 0.6, 0.6, 0.0])
    faces = foot[signed, None] + right[:, None] * across[:, None] + (up[:, None] + 2.2) * (0.0, 0.0, 1.0)
    return [
        _Block(Kind.POLE, Style.UNKNOWN, Colour.UNKNOWN, np.full(len(foot), 2), poles),
        _Block(Kind.SIGN, Style.UNKNOWN, Colour.UNKNOWN, np.full(len(faces), 5), faces.reshape(-1, 3)),
    ]


def _elements(blocks: list[_Block], rng: Rng) -> Elements:
    codes = np.repeat([block[:3] for block in blocks], [len(block.counts) for block in blocks], axis=0)
    first = np.concatenate(([0], np.cumsum(np.concatenate([block.counts for block in blocks]))))
    xyz = np.concatenate([block.xyz for block in blocks])
    xyz += rng.normal(0.0, SURVEY_M, xyz.shape)
    closed = np.isin(codes[:, 0], (Kind.CROSSING, Kind.SIGN))
    xyz[first[1:][closed] - 1] = xyz[first[:-1][closed]]
    names = np.array([f"way {number}" for number in range(1000, 1000 + len(codes))])
    kind, style, colour = codes.astype(np.int8).T
    return Elements(kind, style, colour, first, xyz, np.zeros(len(codes), np.int32), names)


def _surfels(streets: _Streets, rng: Rng) -> Surfels:
    """Surfels of the street (nearly level), of houses (upright, along the street) and of clutter (any way)."""
    length = streets.line[-1]
    ground, wall, clutter = (int(length * rate) for rate in (GROUND_PER_M, WALL_PER_M, CLUTTER_PER_M))
    s = rng.uniform(0.0, length, ground + wall + clutter)
    side = np.where(rng.random(len(s)) < 0.5, -1.0, 1.0)
    # a house every 20 m, each so far from the street
    house = rng.uniform(11.0, 17.0, int(length / 20.0) + 1)[(s / 20.0).astype(np.intp)]
    sort = np.repeat((0, 1, 2), (ground, wall, clutter))
    offset = side * np.choose(sort, (rng.uniform(0.0, 9.0, len(s)), house, rng.uniform(7.0, 18.0, len(s))))
    place = streets.points(s, offset)
    place[:, 2] += np.choose(sort, (np.zeros(len(s)), rng.uniform(0.5, 8.0, len(s)), rng.uniform(0.2, 5.0, len(s))))
    place += rng.normal(0.0, 0.02, place.shape)
    cos, sin = streets.course(s)
    level = np.stack((0.0 * sin, 0.0 * sin, 1.0 + 0.0 * sin), axis=-1)
    facing = np.stack((side * sin, -side * cos, 0.0 * sin), axis=-1)
    normal = np.choose(sort[:, None], (level, facing, rng.normal(size=(len(s), 3))))
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True) + rng.normal(0.0, 0.03, normal.shape)
    normal *= np.where(normal[:, 2:] < 0.0, -1.0, 1.0) / np.linalg.norm(normal, axis=1, keepdims=True)
    thin = 10.0 ** rng.uniform(-3.0, -1.0, len(s))
    return Surfels(place[:, :2], place[:, 2], normal, np.column_stack((thin, thin * rng.uniform(0.2, 1.0, len(s)))))
