"""What the elements of a map would tell about a pose: small observations, each across one direction.

A line tells where one stands across it, piece by piece, and along it only at its ends; a pole or a sign tells both;
a surfel tells along the horizontal part of its normal, so that level ground tells nothing.
"""

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sensors.bounds import NonNegative, Positive
from sensors.maps.vector_map import Elements, Floats, Kind, Style, Surfels

PAINT, EDGE, FURNITURE, PATCH = range(4)
"""Classes of evidence, which fail independently of each other."""
CLASSES = 4
_CLASS = {Kind.ROAD_BOUNDARY: EDGE, Kind.POLE: FURNITURE, Kind.SIGN: FURNITURE}
_POINTS = (Kind.POLE, Kind.SIGN)
_ENDING = (Kind.LANE_LINE, Kind.STOP_LINE, Kind.MARKING)
_DASHED = (Style.DASHED, Style.DOUBLE_DASHED, Style.DOTS)


MOST_PIECES = 10_000
"""Of one edge of a line: an edge that leads to the other side of the earth is a mistake, and must not fill memory."""


class Model(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How well each kind of element is seen: assumptions, not measurements, to be replaced by those of a network.

    Sigmas are of what a BEV of 0.5 m cells yields of one piece, independent of its neighbours' but for ``shared_m``.
    What hides an element (traffic, houses, dirt) is not modelled: predictions are of a clear day and an empty road.
    """

    reach_m: Positive = 40.0
    """Half the side of the square that is seen, m; it turns with the vehicle (EgoVM: 80 m x 80 m)."""
    piece_m: Positive = 1.0
    """Length of line that is one observation, m; sigmas of lines are for this length."""
    lane_line_m: Positive = 0.10
    """Across, one sigma, m; so are those that follow."""
    road_boundary_m: Positive = 0.15
    stop_line_m: Positive = 0.10
    crossing_m: Positive = 0.15
    marking_m: Positive = 0.15
    pole_m: Positive = 0.10
    """Of both axes."""
    sign_m: Positive = 0.20
    """Of both axes."""
    surfel_m: Positive = 0.10
    """Along its normal."""
    line_end_m: Positive = 0.30
    """Along a lane line, a stop line or an open marking where it ends; boundaries end where surveyors stopped."""
    join_m: NonNegative = 0.5
    """Lines of one kind that go on within this distance have no end there, m."""
    dash_end_m: Positive | None = None
    """Along a dashed line at the end of each dash, m; None: nothing, as a map does not hold where dashes begin."""
    dash_period_m: Positive = 12.0
    """From the beginning of a dash to that of the next, m."""
    level: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.2
    """Surfels whose normal has a smaller horizontal part tell nothing: slopes and errors of normals are as large."""
    shared_m: Positive = 0.10
    """Error that all evidence of one class within a cell has in common, one sigma of each axis, m."""
    cell_m: Positive = 10.0
    """Side of these cells, m, which lie about the vehicle; from one to the next errors are independent."""
    search_m: Positive = 3.0
    """EgoVM looks so far to each side (paper, section 6.2), m: without information its score is flat within that."""
    search_deg: Positive = 3.0
    """The same of yaw, deg."""
    share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 1 / 3
    """A pose is degenerate along an axis whose predicted sigma is beyond this share of the axis's limit."""

    def sigma_of(self, kind: Kind) -> float:
        """Sigma of a kind of element, m."""
        return float(getattr(self, f"{kind.name.lower()}_m"))


class Evidence(NamedTuple):
    """N observations of where a place of the map is along one direction.

    place, normal: (N, 2) m and horizontal part of a unit vector, in the map's frame; weight: (N,) 1/sigma^2, 1/m^2;
    group: (N,) int64 class.
    """

    place: Floats
    normal: Floats
    weight: Floats
    group: NDArray[np.int64]


def evidence(elements: Elements, surfels: Surfels, model: Model) -> Evidence:
    """All that a part of a map tells. Elements that nobody sees (Style.VIRTUAL) are left out."""
    seen = elements.chosen(elements.style != Style.VIRTUAL)
    parts = [_of_points(seen, model), *_of_lines(seen, model), _of_ends(seen, model), _of_surfels(surfels, model)]
    place, normal, weight = (np.concatenate([part[column] for part in parts]) for column in range(3))
    return Evidence(place, normal, weight, np.concatenate([part.group for part in parts]))


def _evidence(place: Floats, normal: Floats, weight: Floats, group: NDArray[np.int64] | int) -> Evidence:
    return Evidence(place, normal, weight, np.broadcast_to(np.int64(group), len(place)))


def _by_kind(model: Model) -> tuple[Floats, NDArray[np.int64]]:
    """(kinds,) weights and classes."""
    weights = np.array([model.sigma_of(kind) ** -2 for kind in Kind])
    return weights, np.array([_CLASS.get(kind, PAINT) for kind in Kind], np.int64)


def _of_points(elements: Elements, model: Model) -> Evidence:
    """Poles at their foot, signs at the middle of their corners, along both axes."""
    chosen = elements.chosen(np.isin(elements.kind, _POINTS))
    if not len(chosen):
        return _evidence(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), FURNITURE)
    counts = np.diff(chosen.first)
    foot = chosen.xyz[chosen.first[:-1], :2]
    closed = (counts > 1) & (foot == chosen.xyz[chosen.first[1:] - 1, :2]).all(axis=1)
    total = np.add.reduceat(chosen.xyz[:, :2], chosen.first[:-1]) - np.where(closed[:, None], foot, 0.0)
    middle = total / (counts - closed)[:, None]
    place = np.where((chosen.kind == Kind.SIGN)[:, None], middle, foot)
    axes = np.repeat(np.eye(2), len(place), axis=0)
    return _evidence(np.tile(place, (2, 1)), axes, np.tile(_by_kind(model)[0][chosen.kind], 2), FURNITURE)


def _of_lines(elements: Elements, model: Model) -> tuple[Evidence, Evidence]:
    """Pieces of lines and outlines across them, and of dashed lines along them."""
    lines = elements.chosen(~np.isin(elements.kind, _POINTS))
    step = np.diff(lines.xyz[:, :2], axis=0, append=np.zeros((1, 2)))
    length = np.hypot(*step.T)
    length[lines.first[1:] - 1] = 0.0  # from the end of one line to the beginning of another
    edge = np.flatnonzero(length > 0.0)
    row = np.repeat(np.arange(len(lines)), np.diff(lines.first))[edge]
    pieces = np.minimum(np.ceil(length[edge] / model.piece_m), MOST_PIECES).astype(np.intp)
    number = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = (number + 0.5) / np.repeat(pieces, pieces)
    edge, row = np.repeat(edge, pieces), np.repeat(row, pieces)
    each = length[edge] / np.repeat(pieces, pieces)
    place = lines.xyz[edge, :2] + share[:, None] * step[edge]
    along = step[edge] / length[edge][:, None]
    weights, classes = _by_kind(model)
    kind = lines.kind[row]
    across = np.column_stack((-along[:, 1], along[:, 0]))
    whole = _evidence(place, across, weights[kind] * each / model.piece_m, 0)._replace(group=classes[kind])
    if model.dash_end_m is None:
        return whole, _evidence(place[:0], along[:0], each[:0], PAINT)
    dashed = np.isin(lines.style, _DASHED)[row] & (kind == Kind.LANE_LINE)
    ends = 2.0 * each[dashed] / model.dash_period_m
    return whole, _evidence(place[dashed], along[dashed], ends * model.dash_end_m**-2, PAINT)


def _of_ends(elements: Elements, model: Model) -> Evidence:
    """Ends of painted lines, along them, where no line of the same kind goes on."""
    lines = elements.chosen(np.isin(elements.kind, _ENDING) & (np.diff(elements.first) > 1))
    at = np.concatenate((lines.first[:-1], lines.first[1:] - 1))
    inner = np.concatenate((lines.first[:-1] + 1, lines.first[1:] - 2))
    place, outwards = lines.xyz[at, :2], lines.xyz[at, :2] - lines.xyz[inner, :2]
    kind = np.tile(lines.kind, 2)
    length = np.hypot(*outwards.T)
    outwards = outwards / np.maximum(length, 1e-12)[:, None]
    free = length > 0.0
    if len(place):
        one, other = cKDTree(place).query_pairs(model.join_m, output_type="ndarray").T
        joined = (kind[one] == kind[other]) & ((outwards[one] * outwards[other]).sum(axis=1) < 0.0)
        joined |= other - one == len(lines)  # a ring
        free[one[joined]] = free[other[joined]] = False
    return _evidence(place[free], outwards[free], np.full(int(free.sum()), model.line_end_m**-2), PAINT)


def _of_surfels(surfels: Surfels, model: Model) -> Evidence:
    """Surfels that stand upright enough."""
    level = surfels.normal[:, :2]
    upright = np.hypot(*level.T) >= model.level
    weight = np.full(int(upright.sum()), model.surfel_m**-2)
    return _evidence(surfels.p[upright], level[upright], weight, PATCH)
