"""A made-up world along the roads of a network, made street by street where somebody looks. Of a seed.

It lies in map coordinates, and is as high there as the drives over the network: bodies ride BODY_M above the ground.
Distances are those of the map's grid (UTM: within 4e-4 of metres on the ground). The ground is bilinear between heights
every CELL_M; across a street it follows the hills, not the drive's crossfall, which is the same whichever way one goes.
"""

from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sensors.geodesy import MapFrame, llh_from_map, map_from_llh
from sensors.maps.vector_map import Elements, Kind, VectorMap
from sensors.simulate.clearance import Clearance, turns_at
from sensors.simulate.corners import Corners
from sensors.simulate.furnishing import Block, elements, furnish, joined
from sensors.simulate.network import Network
from sensors.simulate.noise import stream
from sensors.simulate.plane import Plane
from sensors.simulate.scene import CELL_M, Scene, Solids, joined_solids
from sensors.simulate.solids import cars, furnished, houses, trees
from sensors.simulate.street_lines import rounded, streets

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

BODY_M = 0.5
"""Height of the body's origin (the IMU) over the ground, m."""
TILE = 32
"""Heights are made for so many places a side at a time, CELL_M apart."""
BANK_M = 40.0
"""A road over or under the ground has banks that end so far from its middle, m."""
NEIGHBOURS = 8
"""Places of roads that have a say in the height of one bank."""
AROUND_M = 30.0
"""Of a street that its furniture takes at most, to either side, m."""
KEPT_STREETS, KEPT_TILES = 500, 4000
"""Streets and tiles that are kept once made: some 100 MB."""


class Middle(NamedTuple):
    """xy: (n, 2) m of a street's middle in the map; rise: (n,) m of the road over the ground there."""

    xy: Floats
    rise: Floats


class Street(NamedTuple):
    """What stands along one street: what a map knows, and everything solid."""

    blocks: list[Block]
    solids: Solids


class World:
    """The world of a seed along a network's roads. A drive over them from the same start lies in it."""

    def __init__(self, network: Network, start_llh: ArrayLike, frame: MapFrame, seed: int) -> None:
        """start_llh: (3,) rad, rad, m: where the network's plane touches the earth; frame: of the map."""
        self.network, self.frame, self.seed = network, frame, seed
        self._plane = Plane(start_llh)
        graph = network.graph
        self._nodes = self._mapped(graph.nodes)
        line = self._mapped(graph.vertices)
        low = np.minimum.reduceat(line, graph.first[:-1], axis=0)
        high = np.maximum.reduceat(line, graph.first[:-1], axis=0)
        self._boxes = np.hstack((low, high)) + AROUND_M * np.array([-1.0, -1.0, 1.0, 1.0])
        self.middle = lru_cache(KEPT_STREETS)(self._middle)
        self.street = lru_cache(KEPT_STREETS)(self._street)
        self._tile = lru_cache(KEPT_TILES)(self._made_tile)

    def near(self, low: ArrayLike, high: ArrayLike) -> list[int]:
        """Numbers of the streets (edges of the network) in a rectangle between low and high (2,) m."""
        boxes = self._boxes
        inside = (boxes[:, :2] <= np.asarray(high)).all(axis=1) & (boxes[:, 2:] >= np.asarray(low)).all(axis=1)
        return [int(edge) for edge in np.flatnonzero(inside)]

    def along(self, xy: Floats, radius: float) -> list[int]:
        """Numbers of the streets within radius m of a way xy (n, 2) m, its points nearer to each other than that."""
        found: set[int] = set()
        for place in xy:
            found.update(self.near(place - radius, place + radius))
        return sorted(found)

    def height(self, xy: Floats) -> Floats:
        """(N,) m of the ground at places (N, 2) m."""
        at = xy / CELL_M
        node = np.floor(at).astype(np.int64)
        u, v = (at - node).T
        a, b, c, d = (self._heights(node[:, 0] + i, node[:, 1] + j) for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))
        height: Floats = a + (b - a) * u + (c - a) * v + (d - c - b + a) * u * v
        return height

    def scene(self, xy: ArrayLike, radius: float) -> Scene:
        """Everything within radius m of a place (2,) m."""
        first, last = (np.floor((np.asarray(xy) + r) / CELL_M).astype(np.int64) for r in (-radius, radius))
        last = last + 1
        i, j = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(first, last, strict=True)), indexing="ij")
        ground = self._heights(i.ravel(), j.ravel()).reshape(i.shape)
        corner: Floats = first.astype(np.float64) * CELL_M
        there = joined_solids([self.street(edge).solids for edge in self.near(corner, last * CELL_M)])
        return Scene.of(corner, ground, there)

    def vector_map(self, edges: Iterable[int] | None = None, *, surveyed: bool = False) -> VectorMap:
        """What a map knows of streets (edges of the network; None: all). surveyed: with a survey's noise."""
        edges = range(len(self._boxes)) if edges is None else list(edges)
        parts = [(edge, self.street(edge).blocks) for edge in edges]
        noise = stream(self.seed, "survey") if surveyed else None
        blocks = joined([part for _, part in parts])
        names = [
            f"{edge} {Kind(part[sort].kind).name.lower()} {sort}.{number}"
            for sort in range(len(blocks))
            for edge, part in parts
            for number in range(len(part[sort].counts))
        ]
        made: Elements = elements(blocks, names, noise)
        km = float(np.diff(self.network.line)[list(edges)].sum()) / 1000.0
        return VectorMap(self.frame, made, sources=(f"world of seed {self.seed}",), road_km=km)

    def _street(self, edge: int) -> Street:
        """Furnish one street: whatever would stand in the way of others, or of turns, is left out."""
        there = streets([self.middle(edge).xy], self.height)
        rng = np.random.default_rng([self.seed, *b"street", edge])
        clear = self._clearance(edge)
        blocks = [_cleared(block, clear) for block in furnish(there, rng)]
        buildings, walls = houses(there, rng)
        fits = clear.fits(buildings.corners(), 2.0)
        plates = [buildings.chosen(fits).plates(walls[fits])]
        parked, paint = cars(there, rng)
        fits = clear.fits(parked.corners(), 1.0)
        plates.append(parked.chosen(fits).plates(paint[fits]))
        posts, balls = trees(there, rng)
        fits = clear.at(posts[:, :2], 3.0)
        rest = Solids(np.concatenate(plates), posts[fits], balls[fits], np.empty((0, 10)))
        return Street(blocks, joined_solids([furnished(blocks, there), rest]))

    def _clearance(self, edge: int) -> Clearance:
        """What else needs room where a street lies."""
        box = self._boxes[edge]
        others = [self.middle(other).xy for other in self.near(box[:2], box[2:]) if other != edge]
        ends = self.network.graph.ends[edge]
        turns = [turn for node in ends.tolist() for turn in turns_at(self.network, node)]
        return Clearance.of(others, [self._mapped(turn) for turn in turns])

    def _middle(self, edge: int) -> Middle:
        graph, network = self.network.graph, self.network
        rows = slice(graph.first[edge], graph.first[edge + 1])
        radius = graph.radius[rows]
        xy, along = rounded(Corners(graph.vertices[rows], radius, np.zeros_like(radius)))
        return Middle(self._mapped(xy), network.stretches.above_ground(network.line[edge] + along))

    def _mapped(self, xy: Floats) -> Floats:
        """(N, 2) m in the map of places (N, 2) m in the network's plane."""
        llh = self._plane.llh(np.column_stack((xy, np.zeros(len(xy)))))
        return map_from_llh(self.frame, llh)[:, :2]

    def _heights(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> Floats:
        """(N,) m at the places (i, j) CELL_M."""
        tile = (i // TILE) * 2**32 + j // TILE
        order = np.argsort(tile, kind="stable")
        begins = np.flatnonzero(np.diff(tile[order], prepend=tile[order[:1]] - 1)) if len(i) else np.empty(0, np.intp)
        height = np.empty(len(i))
        for rows in np.split(order, begins[1:]):
            if len(rows):
                made = self._tile(int(i[rows[0]]) // TILE, int(j[rows[0]]) // TILE)
                height[rows] = made[i[rows] % TILE, j[rows] % TILE]
        return height

    def _made_tile(self, tile_i: int, tile_j: int) -> Floats:
        """(TILE, TILE) m, heights of a square."""
        axis = np.arange(TILE)
        i, j = np.meshgrid(tile_i * TILE + axis, tile_j * TILE + axis, indexing="ij")
        xy = CELL_M * np.stack((i.ravel(), j.ravel()), axis=-1).astype(np.float64)
        # heights over the plane's origin, of the level z = 0 and of the ground
        level = self._plane.xyz(llh_from_map(self.frame, np.column_stack((xy, np.zeros(len(xy))))))
        ground = self.network.ground.at(level[:, :2]) + self._banks(xy) - BODY_M
        height: Floats = (ground - level[:, 2]).reshape(TILE, TILE)
        return height

    def _banks(self, xy: Floats) -> Floats:
        """(N,) m by which roads near places (N, 2) m lift the ground: fully on the road, none BANK_M away."""
        edges = self.near(xy.min(axis=0) - BANK_M, xy.max(axis=0) + BANK_M)
        middles = [self.middle(edge) for edge in edges]
        if not any(middle.rise.any() for middle in middles):
            return np.zeros(len(xy))
        rise = np.concatenate([middle.rise for middle in middles])
        tree = cKDTree(np.concatenate([middle.xy for middle in middles]))
        apart, row = tree.query(xy, k=min(NEIGHBOURS, tree.n), distance_upper_bound=BANK_M)
        apart, row = apart.reshape(len(xy), -1), row.reshape(len(xy), -1)
        weight = np.where(np.isfinite(apart), 1.0 / np.maximum(apart, 0.1) - 1.0 / BANK_M, 0.0) ** 4
        mean = (weight * np.append(rise, 0.0)[row]).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-30)
        fade = np.clip((BANK_M - apart[:, 0]) / (BANK_M - 12.0), 0.0, 1.0)
        lift: Floats = mean * np.where(np.isfinite(fade), fade, 0.0)
        return lift


def _cleared(block: Block, clear: Clearance) -> Block:
    """What stands in nobody's way; lines along the street are cut, paint at its ends stays."""
    xy = block.xyz[:, :2]
    if block.kind == Kind.LANE_LINE:
        return block.cut(clear.off_streets(xy))
    if block.kind == Kind.ROAD_BOUNDARY:
        return block.cut(clear.at(xy, 0.0))
    if block.kind not in (Kind.POLE, Kind.SIGN):
        return block
    line = np.repeat(np.arange(len(block.counts)), block.counts)
    return block.chosen(np.bincount(line, ~clear.at(xy, 1.0), minlength=len(block.counts)) == 0)
