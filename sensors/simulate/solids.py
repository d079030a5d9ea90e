"""What a LiDAR sees of a street: its furnishing as things and paint, and what no map knows: houses, cars, trees."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors.maps.vector_map import Colour, Kind, Style
from sensors.simulate.furnishing import CROSSING_M, LINES, Block
from sensors.simulate.scene import Solids, joined_solids
from sensors.simulate.street_lines import Streets

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rng = np.random.Generator

CURB_M, SIDEWALK_M = 0.12, 2.5
"""Height of a curb and width of the sidewalk behind it, m."""
LINE_M, STOP_M, ARROW_M = 0.15, 0.40, 0.20
"""Widths of paint, m."""
GAP_M = 0.15
"""Between the lines of a double one, m."""
DASH_M, DASH_PITCH_M = 2.0, 6.0
"""Length and repeat of dashes (GB 5768.3 below 60 km/h), m."""
ZEBRA_M, ZEBRA_PITCH_M = 0.5, 1.0
"""Width and repeat of the bars of a crossing, m."""
POLE_RADIUS_M = 0.06
WHITE, YELLOW, CONCRETE, METAL, RETROREFLECTIVE = 0.8, 0.6, 0.3, 0.5, 2.0
"""Diffuse reflectivities, -; a sign returns more than white paper."""
LOT_M = 20.0
"""Of street for one house on either side, m."""
BUILT, PARKED = 0.8, 0.35
"""Shares of the lots with a house and of the parking places with a car, -."""
PARKING_M, TREE_M = 6.5, 25.0
"""Of street for one parking place, and for one tree, on either side, m."""
END_M = 20.0
"""No car stands, and no tree, nearer to a junction, m."""


class Footprints(NamedTuple):
    """Upright boxes. middle: (N, 3) m on the ground; cos, sin: (N,) of their course; size: (N, 3) m length, width and
    height; lift: (N,) m of their lower side over the middle."""

    middle: Floats
    cos: Floats
    sin: Floats
    size: Floats
    lift: Floats

    def corners(self) -> Floats:
        """(N, 4, 2) m, ccw."""
        ahead = np.stack((self.cos, self.sin), axis=-1)[:, None] * self.size[:, :1, None]
        left = np.stack((-self.sin, self.cos), axis=-1)[:, None] * self.size[:, 1:2, None]
        along = np.array([-0.5, 0.5, 0.5, -0.5])[:, None]
        across = np.array([-0.5, -0.5, 0.5, 0.5])[:, None]
        result: Floats = self.middle[:, None, :2] + along * ahead + across * left
        return result

    def chosen(self, keep: Mask) -> "Footprints":
        """Those to keep."""
        return Footprints(*(column[keep] for column in self))

    def plates(self, reflectivity: ArrayLike) -> Floats:
        """(5 N, 10) sides and roofs; reflectivity: (N,)."""
        corners, count = self.corners(), len(self.middle)
        low = np.broadcast_to((self.middle[:, 2] + self.lift)[:, None, None], (count, 4, 1))
        foot = np.concatenate((corners, low), axis=-1)
        up = np.zeros((count, 4, 3))
        up[..., 2] = self.size[:, 2:]
        sides = np.concatenate((foot, np.roll(foot, -1, axis=1) - foot, up), axis=-1)
        roofs = np.concatenate((foot[:, 0] + up[:, 0], foot[:, 1] - foot[:, 0], foot[:, 3] - foot[:, 0]), axis=-1)
        bright = np.broadcast_to(reflectivity, count)
        return _bright(np.concatenate((sides, roofs[:, None]), axis=1).reshape(-1, 9), np.repeat(bright, 5))


def furnished(blocks: list[Block], streets: Streets) -> Solids:
    """The furnishing of streets as things and paint."""
    offsets = [left for *_, left in LINES] + [0.0] * (len(blocks) - len(LINES))
    return joined_solids([_solid(block, streets, left) for block, left in zip(blocks, offsets, strict=True)])


def houses(streets: Streets, rng: Rng) -> tuple[Footprints, Floats]:
    """One on most lots, and reflectivities (N,)."""
    s, side = _places(streets, LOT_M, 0.0)
    count = len(s)
    size = rng.uniform((8.0, 8.0, 4.0), (18.0, 12.0, 14.0), (count, 3))
    offset = side * (rng.uniform(11.0, 17.0, count) + size[:, 1] / 2)
    # the floor lies below the ground at every corner: no ray sees under a house on a slope
    size[:, 2] += 2.0
    there = Footprints(streets.points(s, offset), *streets.course(s), size, np.full(count, -2.0))
    bright = rng.uniform(0.2, 0.6, count)
    keep = rng.random(count) < BUILT
    return there.chosen(keep), bright[keep]


def cars(streets: Streets, rng: Rng) -> tuple[Footprints, Floats]:
    """Parked along the curbs: bodies, then their cabins (2 N of both), and reflectivities (2 N,)."""
    s, side = _places(streets, PARKING_M, END_M)
    keep = rng.random(len(s)) < PARKED
    s, side = s[keep], side[keep]
    count = len(s)
    s = s + rng.uniform(-0.4, 0.4, count)
    middle, course = streets.points(s, side * 5.95), streets.course(s)
    body = rng.uniform((4.0, 1.7, 0.6), (4.8, 1.9, 0.8), (count, 3))
    cabin = body * (0.55, 0.9, 0.85)
    bright = rng.uniform(0.1, 0.8, count)
    lift = np.full(count, 0.2)
    bodies, cabins = Footprints(middle, *course, body, lift), Footprints(middle, *course, cabin, lift + body[:, 2])
    both = Footprints(*(np.concatenate(pair) for pair in zip(bodies, cabins, strict=True)))
    return both, np.concatenate((bright, bright))


def trees(streets: Streets, rng: Rng) -> tuple[Floats, Floats]:
    """Posts (N, 6) and balls (N, 5): trunks and crowns behind the sidewalk."""
    s, side = _places(streets, TREE_M, END_M)
    count = len(s)
    s = s + rng.uniform(-0.4, 0.4, count) * TREE_M
    foot = streets.points(s, side * rng.uniform(9.6, 10.4, count))
    trunk, height, crown = (rng.uniform(*span, count) for span in ((0.1, 0.25), (2.2, 3.2), (1.0, 2.0)))
    posts = np.column_stack((foot, foot[:, 2] + height, trunk, np.full(count, 0.3)))
    balls = np.column_stack((foot[:, :2], foot[:, 2] + height + 0.7 * crown, crown, np.full(count, 0.4)))
    return posts, balls


def _places(streets: Streets, every_m: float, end_m: float) -> tuple[Floats, Floats]:
    """(N,) m along the middles of places on either side of every street, and (N,) the side, 1: left."""
    begin, end = streets.line[:-1] + end_m, streets.line[1:] - end_m
    s = np.concatenate([np.arange(b + every_m / 2, e, every_m) for b, e in zip(begin, end, strict=True)])
    return np.repeat(s, 2), np.tile((1.0, -1.0), len(s))


def _solid(block: Block, streets: Streets, left: float) -> Solids:
    """Elements of one sort as solids; left: offset of lines from the middle of the street, m."""
    none = joined_solids([])
    if not len(block.counts):
        return none
    if block.kind == Kind.POLE:
        foot, top = block.xyz[::2], block.xyz[1::2]
        rest = np.broadcast_to((POLE_RADIUS_M, METAL), (len(foot), 2))
        return none._replace(posts=np.column_stack((foot, top[:, 2], rest)))
    if block.kind == Kind.SIGN:
        face = block.xyz.reshape(-1, 5, 3)
        sides = np.concatenate((face[:, 0], face[:, 1] - face[:, 0], face[:, 3] - face[:, 0]), axis=-1)
        return none._replace(plates=_bright(sides, RETROREFLECTIVE))
    if block.kind == Kind.ROAD_BOUNDARY:
        return none._replace(plates=_curb(block, streets, left))
    return none._replace(strips=_paint(block))


def _curb(block: Block, streets: Streets, left: float) -> Floats:
    """(2 n, 10) faces of a curb and pieces of the sidewalk behind it."""
    begin, end, _ = _pieces(block)
    along = end - begin
    out = np.stack((-along[:, 1], along[:, 0]), axis=-1) / np.linalg.norm(along[:, :2], axis=1, keepdims=True)
    out *= np.copysign(SIDEWALK_M, left)
    rise = streets.ground(begin[:, :2] + out) - begin[:, 2]
    up = np.broadcast_to((0.0, 0.0, CURB_M), begin.shape)
    faces = np.hstack((begin, along, up))
    walks = np.hstack((begin + up, along, np.column_stack((out, rise))))
    return _bright(np.concatenate((faces, walks)), CONCRETE)


def _paint(block: Block) -> Floats:
    """(P, 10) strips of paint."""
    if block.kind == Kind.CROSSING:
        ring = block.xyz.reshape(-1, 5, 3)[..., :2]
        begin, end = (ring[:, 0] + ring[:, 3]) / 2, (ring[:, 1] + ring[:, 2]) / 2
        return _strips(begin, end, CROSSING_M, WHITE, 0.0, ZEBRA_PITCH_M, ZEBRA_M)
    begin, end, at = _pieces(block)
    bright = YELLOW if block.colour == Colour.YELLOW else WHITE
    if block.style == Style.DASHED:
        return _strips(begin, end, LINE_M, bright, at, DASH_PITCH_M, DASH_M)
    if block.style == Style.DOUBLE_SOLID:
        along = (end - begin)[:, :2]
        left = np.stack((-along[:, 1], along[:, 0]), axis=-1) / np.linalg.norm(along, axis=1, keepdims=True)
        left *= 0.5 * (LINE_M + GAP_M)
        pair = [(begin[:, :2] + sign * left, end[:, :2] + sign * left) for sign in (1.0, -1.0)]
        return np.concatenate([_strips(*line, LINE_M, bright) for line in pair])
    width = {Kind.STOP_LINE: STOP_M, Kind.MARKING: ARROW_M}.get(block.kind, LINE_M)
    return _strips(begin, end, width, bright)


def _strips(
    begin: Floats,
    end: Floats,
    width: float,
    bright: float,
    phase: Floats | float = 0.0,
    pitch: float = np.inf,
    painted: float = np.inf,
) -> Floats:
    """(n, 10) strips of one look between begin and end (n, 2 or more) m."""
    along = (end - begin)[:, :2]
    length = np.linalg.norm(along, axis=1)
    rest = [np.broadcast_to(v, len(length)) for v in (0.5 * width, phase, pitch, painted, bright)]
    return np.column_stack((begin[:, :2], along / length[:, None], length, *rest))


def _pieces(block: Block) -> tuple[Floats, Floats, Floats]:
    """Begins and ends (n, 3) m of the straight pieces of a block's polylines, and (n,) m from the begin of theirs."""
    line = np.repeat(np.arange(len(block.counts)), block.counts)
    same = line[1:] == line[:-1]
    begin, end = block.xyz[:-1][same], block.xyz[1:][same]
    run = np.concatenate(([0.0], np.cumsum(np.linalg.norm((end - begin)[:, :2], axis=1))))[:-1]
    new = np.diff(line[:-1][same], prepend=-1) > 0
    return begin, end, run - np.maximum.accumulate(np.where(new, run, 0.0))


def _bright(sides: Floats, reflectivity: Floats | float) -> Floats:
    """(n, 10) plates (n, 9) with their reflectivity."""
    return np.column_stack((sides, np.broadcast_to(reflectivity, len(sides))))
