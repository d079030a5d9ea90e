"""A scene that rays are cast into: ground, paint on it, and plates, posts and balls, sorted into cells of a grid.

embreex (Intel Embree, the same scene as 84,000 triangles, one core) was tried first: 12 ms for the distances of 72,000
rays and 12 ms for what they hit, 6 ms to make the rays and 150 ms a scene, against 13 ms and 4 ms a scene here, where
ground and posts are curved and distances are doubles. So it is no dependency.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from sensors.simulate import _ray_kernels
from sensors.simulate._ray_kernels import FIRST, GROUND, NOTHING

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

__all__ = ["CELL_M", "FIRST", "GROUND", "NOTHING", "Hits", "Scene", "Solids", "joined_solids"]

CELL_M = 4.0
"""Side of a cell, and between the places at which the height of the ground is known, m."""
GROUND_SHINE = 0.15
"""Reflectivity of bare ground, -."""


class Solids(NamedTuple):
    """Things in map coordinates, m, each with its diffuse reflectivity (1: white) as the last column.

    plates: (Q, 10) a corner and the two sides from it; posts: (C, 6) x, y, foot, top, radius; balls: (S, 5) centre and
    radius; strips: (P, 10) of paint: begin x, y, unit direction x, y, length, half width, and where it is dashed the
    phase at its begin, the pitch and the painted part of it (pitch inf: all).
    """

    plates: Floats
    posts: Floats
    balls: Floats
    strips: Floats


def joined_solids(several: list[Solids]) -> Solids:
    """All in one; plates of all, then posts of all ..."""
    widths = (10, 6, 5, 10)
    columns = zip(*several, strict=True) if several else ([],) * 4
    return Solids(*(np.concatenate([np.empty((0, w)), *rows]) for w, rows in zip(widths, columns, strict=True)))


class Hits(NamedTuple):
    """What rays (M, K) hit. distance: m, inf: nothing; cosine: of the incidence; reflectivity: -; what: NOTHING,
    GROUND, or FIRST and the thing's number: plates, then posts, then balls."""

    distance: Floats
    cosine: Floats
    reflectivity: Floats
    what: Ints


class _Cells(NamedTuple):
    """items[first[c] : first[c + 1]] lie in cell c = i * columns + j."""

    first: Ints
    items: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """corner: (2,) m of the grid; ground: (I + 1, J + 1) m, heights at the corners of its cells, x first.

    plates: (Q, 12) as the kernels have them.
    """

    corner: Floats
    ground: Floats
    solids: Solids
    plates: Floats
    things: _Cells
    paint: _Cells
    top: Floats

    @classmethod
    def of(cls, corner: Floats, ground: Floats, solids: Solids) -> Self:
        """Things sorted into cells; what lies outside of the grid is left out."""
        shape = ground.shape[0] - 1, ground.shape[1] - 1
        boxes, tops = _boxes(solids)
        things = _sorted(boxes, corner, shape)
        corners = ground[:-1, :-1], ground[1:, :-1], ground[:-1, 1:], ground[1:, 1:]
        top = np.max(corners, axis=0).ravel()
        np.maximum.at(top, np.repeat(np.arange(len(top)), np.diff(things.first)), tops[things.items])
        paint = _sorted(_strip_boxes(solids.strips), corner, shape)
        return cls(corner, np.ascontiguousarray(ground), solids, _plates(solids.plates), things, paint, top)

    def cast(self, origins: Floats, rotations: Floats, beams: Floats, most: float) -> Hits:
        """Cast rays from origins (M, 3) along rotations (M, 3, 3) @ beams (M, K, 3), unit vectors, up to most m."""
        shape = beams.shape[:2]
        found = Hits(np.empty(shape), np.empty(shape), np.empty(shape), np.empty(shape, np.int64))
        solids = self.solids
        shine = np.concatenate(([GROUND_SHINE], solids.plates[:, 9], solids.posts[:, 5], solids.balls[:, 4]))
        posts, balls = np.ascontiguousarray(solids.posts[:, :5]), np.ascontiguousarray(solids.balls[:, :4])
        _ray_kernels.cast(
            np.ascontiguousarray(origins), np.ascontiguousarray(rotations), beams, most,
            (float(self.corner[0]), float(self.corner[1])), CELL_M, self.ground, self.top,
            self.plates, posts, balls, *self.things, solids.strips, *self.paint, shine, *found,
        )  # fmt: skip
        return found


def _plates(plates: Floats) -> Floats:
    """(Q, 12): corner, unit normal, and the dual of its sides within its plane."""
    o, u, v = plates[:, :3], plates[:, 3:6], plates[:, 6:9]
    normal = np.cross(u, v)
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / area
    return np.ascontiguousarray(np.hstack((o, normal, np.cross(v, normal) / area, np.cross(normal, u) / area)))


def _boxes(solids: Solids) -> tuple[Floats, Floats]:
    """(N, 4) least and greatest x, then y, m, of all things, and their tops (N,) m."""
    o, u, v = solids.plates[:, :3], solids.plates[:, 3:6], solids.plates[:, 6:9]
    corners = np.stack((o, o + u, o + v, o + u + v))
    low, high = [corners.min(axis=0)], [corners.max(axis=0)]
    for round_things, radius in ((solids.posts, solids.posts[:, 4]), (solids.balls, solids.balls[:, 3])):
        low.append(round_things[:, :3] - radius[:, None])
        high.append(round_things[:, :3] + radius[:, None])
    high[1][:, 2] = solids.posts[:, 3]
    least, greatest = np.concatenate(low), np.concatenate(high)
    return np.stack((least[:, 0], greatest[:, 0], least[:, 1], greatest[:, 1]), axis=-1), greatest[:, 2]


def _strip_boxes(strips: Floats) -> Floats:
    """(P, 4) least and greatest x, then y, m."""
    begin, direction = strips[:, :2], strips[:, 2:4]
    end = begin + strips[:, 4:5] * direction
    margin = strips[:, 5:6]
    least, greatest = np.minimum(begin, end) - margin, np.maximum(begin, end) + margin
    return np.stack((least[:, 0], greatest[:, 0], least[:, 1], greatest[:, 1]), axis=-1)


def _sorted(boxes: Floats, corner: Floats, shape: tuple[int, int]) -> _Cells:
    """Boxes (N, 4) m sorted into cells."""
    low, high = boxes[:, ::2], boxes[:, 1::2]
    least = np.floor((low - corner) / CELL_M - 1e-9).astype(np.int64)
    greatest = np.floor((high - corner) / CELL_M + 1e-9).astype(np.int64)
    rows = np.flatnonzero(((greatest >= 0) & (least < shape)).all(axis=1))
    limit = np.array(shape) - 1
    least, greatest = np.clip(least[rows], 0, limit), np.clip(greatest[rows], 0, limit)
    cells = np.stack((least[:, 0], greatest[:, 0], least[:, 1], greatest[:, 1]), axis=-1)
    first = np.zeros(shape[0] * shape[1] + 1, np.int64)
    _ray_kernels.bins(cells, shape[1], first, np.empty(0, np.int64))
    items = np.empty(first[-1], np.int64)
    if len(items):
        ends = first.copy()
        _ray_kernels.bins(cells, shape[1], ends, items)
    return _Cells(first, rows[items])
