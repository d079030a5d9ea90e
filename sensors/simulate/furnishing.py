"""What a map knows of made-up streets: lane lines, curbs, stop lines, crossings, arrows, poles and signs. Of a seed.

The one source of it: ``city_map`` furnishes a whole city at once, ``world`` street by street, where a drive comes by.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.maps.vector_map import Colour, Elements, Kind, Style
from sensors.simulate.street_lines import Streets

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Mask = NDArray[np.bool_]
Rng = np.random.Generator

SETBACK_M = 12.0
"""Lines end this long before a junction, m."""
SPACING_M = 3.0
"""Between the vertices of a line, m."""
SURVEY_M = 0.01
"""Noise of a vertex as surveyed, one sigma, m."""
HALF_WIDTH_M = 7.0
"""From the middle of the street to its curb, m."""
LANE_M = 3.5
"""Width of a lane, m: drives keep to the one in the middle of the street, whichever way they go."""
LINES = (
    (Kind.LANE_LINE, Style.DOUBLE_SOLID, Colour.YELLOW, 0.5 * LANE_M),
    (Kind.LANE_LINE, Style.DASHED, Colour.WHITE, 1.5 * LANE_M),
    (Kind.LANE_LINE, Style.DASHED, Colour.WHITE, -0.5 * LANE_M),
    (Kind.ROAD_BOUNDARY, Style.CURB, Colour.UNKNOWN, HALF_WIDTH_M),
    (Kind.ROAD_BOUNDARY, Style.CURB, Colour.UNKNOWN, -HALF_WIDTH_M),
)
"""Kind, style, colour and offset to the left, m, of the lines along a street."""
CROSSING_M = 3.0
"""Width of a crossing, along the street, m."""
POLE_EVERY_M = 15.0
"""Mean distance between poles, m of street."""
SIGN_OFF_M = 0.08
"""The face of a sign stands so far before the middle of its pole, m."""


class Block(NamedTuple):
    """Elements of one sort: counts (n,) of vertices, xyz (m, 3) m of them all."""

    kind: Kind
    style: Style
    colour: Colour
    counts: Ints
    xyz: Floats

    def chosen(self, keep: Mask) -> "Block":
        """Only the elements (n,) to keep."""
        return self._replace(counts=self.counts[keep], xyz=self.xyz[np.repeat(keep, self.counts)])

    def cut(self, keep: Mask) -> "Block":
        """Polylines cut to the vertices (m,) to keep: what hangs together of one, two vertices at least, is one."""
        line = np.repeat(np.arange(len(self.counts)), self.counts)
        begins = keep & (np.diff(line, prepend=-1).astype(bool) | ~np.concatenate(([False], keep[:-1])))
        run = np.cumsum(begins)[keep] - 1
        long = np.bincount(run, minlength=int(begins.sum())) >= 2
        return self._replace(counts=np.bincount(run, minlength=len(long))[long], xyz=self.xyz[keep][long[run]])


def furnish(streets: Streets, rng: Rng) -> list[Block]:
    """Always the same sorts in the same order: ``joined`` puts those of several streets together."""
    begin, end = streets.line[:-1] + SETBACK_M, streets.line[1:] - SETBACK_M
    return [*_lines(streets, begin, end), *_junctions(streets, begin, end), *_furniture(streets, rng)]


def joined(several: Sequence[list[Block]]) -> list[Block]:
    """The furnishings of several streets, sort by sort."""
    return [
        same[0]._replace(
            counts=np.concatenate([block.counts for block in same]), xyz=np.concatenate([block.xyz for block in same])
        )
        for same in zip(*several, strict=True)
    ]


def elements(blocks: Sequence[Block], names: Sequence[str] | None = None, noise: Rng | None = None) -> Elements:
    """Blocks as columns of a map. names: of all elements in order; noise: survey them by SURVEY_M."""
    codes = np.repeat([block[:3] for block in blocks], [len(block.counts) for block in blocks], axis=0)
    first = np.concatenate(([0], np.cumsum(np.concatenate([block.counts for block in blocks]))))
    xyz = np.concatenate([block.xyz for block in blocks])
    if noise is not None:
        xyz += noise.normal(0.0, SURVEY_M, xyz.shape)
        closed = np.isin(codes[:, 0], (Kind.CROSSING, Kind.SIGN))
        xyz[first[1:][closed] - 1] = xyz[first[:-1][closed]]
    called = np.array([f"way {number}" for number in range(1000, 1000 + len(codes))] if names is None else names)
    kind, style, colour = codes.astype(np.int8).T
    return Elements(kind, style, colour, first, xyz, np.zeros(len(codes), np.int32), called)


def _lines(streets: Streets, begin: Floats, end: Floats) -> list[Block]:
    counts = np.ceil((end - begin) / SPACING_M).astype(np.intp) + 1
    row = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    s = np.repeat(begin, counts) + row * np.repeat((end - begin) / (counts - 1), counts)
    return [Block(kind, style, colour, counts, streets.points(s, left)) for kind, style, colour, left in LINES]


def _junctions(streets: Streets, begin: Floats, end: Floats) -> list[Block]:
    """Stop line and crossing at both ends of each street, an arrow before them."""
    blocks = []
    for at, ahead in ((begin, 1.0), (end, -1.0)):
        w, far, lane = HALF_WIDTH_M, CROSSING_M * ahead, 0.5 * LANE_M
        stop = [(4.0 * ahead, -lane * ahead), (4.0 * ahead, w * ahead)]  # who comes in keeps to the right
        crossing = [(0.0, -w), (0.0, w), (far, w), (far, -w), (0.0, -w)]
        arrow = [(14.0 * ahead, 0.0), (10.0 * ahead, 0.0), (10.5 * ahead, -0.25)]
        blocks += [
            _shape(streets, at, stop, Kind.STOP_LINE, Style.SOLID),
            _shape(streets, at, crossing, Kind.CROSSING, Style.ZEBRA),
            _shape(streets, at, arrow, Kind.MARKING, Style.ARROW),
        ]
    return blocks


def _shape(streets: Streets, at: Floats, shape: list[tuple[float, float]], kind: Kind, style: Style) -> Block:
    """White paint of the same shape, vertices (along, left) m, at many places."""
    along, left = np.array(shape).T
    xyz = streets.points((at[:, None] + along).ravel(), np.tile(left, len(at)))
    return Block(kind, style, Colour.WHITE, np.full(len(at), len(shape)), xyz)


def _furniture(streets: Streets, rng: Rng) -> list[Block]:
    """Poles, a third of which bear a sign."""
    side = np.where(rng.random(int(streets.line[-1] / POLE_EVERY_M)) < 0.5, -1.0, 1.0)
    s = rng.uniform(0.0, streets.line[-1], len(side))
    foot = streets.points(s, side * rng.uniform(8.0, 9.5, len(side)))
    top = foot + np.outer(rng.uniform(2.5, 9.0, len(side)), (0.0, 0.0, 1.0))
    poles = np.stack((foot, top), axis=1).reshape(-1, 3)
    signed = slice(None, None, 3)
    cos, sin = streets.course(s[signed])
    level = np.zeros_like(sin)
    across, ahead = np.stack((-sin, cos, level), axis=-1), np.stack((cos, sin, level), axis=-1)
    right, up = np.array([-0.3, 0.3, 0.3, -0.3, -0.3]), np.array([0.0, 0.0, 0.6, 0.6, 0.0])
    middle = foot[signed] - SIGN_OFF_M * ahead
    faces = middle[:, None] + right[:, None] * across[:, None] + (up[:, None] + 2.2) * (0.0, 0.0, 1.0)
    return [
        Block(Kind.POLE, Style.UNKNOWN, Colour.UNKNOWN, np.full(len(foot), 2), poles),
        Block(Kind.SIGN, Style.UNKNOWN, Colour.UNKNOWN, np.full(len(faces), 5), faces.reshape(-1, 3)),
    ]
