"""Streets and highways as a graph in the plane: districts of jittered blocks, joined by highways."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree

from sensors.simulate.highways import spread

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Rng = np.random.Generator

JITTER_M = 20.0
"""Largest displacement of a junction along each axis of its district, m."""
BEND = np.radians(60.0)
"""Largest bend of a street, rad."""


class Blocks(NamedTuple):
    """How districts are laid out: block lengths m, share of streets left out, share of bent streets."""

    least_m: float
    most_m: float
    missing: float
    bent: float


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """Junctions and the roads between them; edges that go on as one road follow each other.

    nodes: (N, 2) m; ends: (E, 2) nodes; highway: (E,) bool; first: (E + 1,) row of each edge's first vertex;
    vertices: (V, 2) m, those of an edge from its first to its second end, both included; radius: (V,) m of the curve
    at a vertex, 0 at the ends.
    """

    nodes: Floats
    ends: Ints
    highway: NDArray[np.bool_]
    first: Ints
    vertices: Floats
    radius: Floats

    def lengths(self) -> Floats:
        """(E,) m along the vertices."""
        step = np.zeros(len(self.vertices))
        step[1:] = np.linalg.norm(np.diff(self.vertices, axis=0), axis=1)
        step[self.first[:-1]] = 0.0
        return np.add.reduceat(step, self.first[:-1])


def lay_out(
    blocks: Blocks, streets_m: float, highways_m: float, districts: int, tightest_m: tuple[float, float], rng: Rng
) -> Graph:
    """A connected graph with about that much of streets and highways, every junction of two roads at least.

    districts: as many (one, or full rows of at least two); tightest_m: radius of curves of streets and of highways.
    """
    least = min(districts, 2)
    rows = max(int(np.sqrt(districts)), least)
    shape = rows, max(round(districts / rows), least)
    towns = [_district(blocks, streets_m / (shape[0] * shape[1]), rng) for _ in range(shape[0] * shape[1])]
    nodes, ways = spread([town for town, _ in towns], shape, highways_m, tightest_m[1], rng)
    shift = np.cumsum([0] + [len(town) for town, _ in towns])
    ends = np.concatenate([ends + first for (_, ends), first in zip(towns, shift[:-1], strict=True)])
    streets = _streets(nodes, ends, blocks.bent, tightest_m[0], rng)
    gates = np.array([(way.begin, way.end) for way in ways], np.intp).reshape(-1, 2)
    keep = _kept(ends, streets.lengths, np.bincount(gates.ravel(), minlength=len(nodes)), streets_m, rng)
    lines, radii = streets.chosen(keep)
    lines, radii = lines + [way.line for way in ways], radii + [way.radius for way in ways]
    return Graph(
        nodes=nodes,
        ends=np.concatenate((ends[keep], gates)),
        highway=np.arange(keep.sum() + len(ways)) >= keep.sum(),
        first=np.concatenate(([0], np.cumsum([len(line) for line in lines]))),
        vertices=np.concatenate(lines),
        radius=np.concatenate(radii),
    )


def _district(blocks: Blocks, streets_m: float, rng: Rng) -> tuple[Floats, Ints]:
    """Nodes (n, 2) m around their middle and streets (m, 2) of a lattice that has streets_m left after thinning.

    Streets come row by row, then column by column.
    """
    if streets_m <= 0:
        return np.zeros((1, 2)), np.empty((0, 2), np.intp)
    jitter = min(JITTER_M, (blocks.most_m - blocks.least_m) / 8)
    low, high = blocks.least_m + 2 * jitter, blocks.most_m - 2.5 * jitter
    count = 2 * streets_m / (1.0 - blocks.missing) / (low + high)
    across = max(round(0.5 + np.sqrt(0.25 + count / 2)) + int(rng.integers(-1, 2)), 2)
    down = max(round((count + across) / (2 * across - 1)), 2)
    x, y = (np.cumsum(rng.uniform(low, high, n)) for n in (across, down))
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    nodes += rng.uniform(-jitter, jitter, nodes.shape)
    number = np.arange(across * down).reshape(down, across)
    rows = np.stack((number[:, :-1], number[:, 1:]), axis=-1).reshape(-1, 2)
    columns = np.stack((number[:-1].T, number[1:].T), axis=-1).reshape(-1, 2)
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return (nodes - nodes.mean(axis=0)) @ turn, np.concatenate((rows, columns))


@dataclass(frozen=True, slots=True, eq=False)
class _Streets:
    """points: (M, 3, 2) m begin, middle, end; radius: (M,) m of the bend in the middle or 0; lengths: (M,) m."""

    points: Floats
    radius: Floats
    lengths: Floats

    def chosen(self, keep: NDArray[np.bool_]) -> tuple[list[Floats], list[Floats]]:
        """Vertices and radii of some of them; a straight one has no vertex in the middle."""
        straight, bent = np.array([0, 2]), np.array([0, 1, 2])
        radii = np.zeros((len(keep), 3))
        radii[:, 1] = self.radius
        rows = [(row, bent if self.radius[row] else straight) for row in np.flatnonzero(keep)]
        return [self.points[row, take] for row, take in rows], [radii[row, take] for row, take in rows]


def _streets(nodes: Floats, ends: Ints, share: float, tightest_m: float, rng: Rng) -> _Streets:
    """Straight streets between nodes, but a share of them bends to one side in the middle."""
    begin, end = nodes[ends[:, 0]], nodes[ends[:, 1]]
    chord = np.linalg.norm(end - begin, axis=1)
    bend = np.minimum(BEND, 2 * np.arctan(0.2 * chord / tightest_m)) * rng.uniform(0.3, 1.0, len(ends))
    radius = np.minimum(tightest_m * rng.uniform(1.0, 3.0, len(ends)), 0.2 * chord / np.tan(bend / 2))
    # off the chord by length / 2 tan(bend / 2)
    side = rng.choice((-0.5, 0.5), len(ends)) * np.tan(bend / 2)
    middle = (begin + end) / 2 + side[:, None] * (end - begin)[:, ::-1] * [-1.0, 1.0]
    bent = rng.random(len(ends)) < share
    lengths = np.where(bent, chord / np.cos(bend / 2), chord)
    return _Streets(np.stack((begin, middle, end), axis=1), np.where(bent, radius, 0.0), lengths)


def _kept(ends: Ints, lengths: Floats, highways: Ints, streets_m: float, rng: Rng) -> NDArray[np.bool_]:
    """(M,) bool: all but some at random, until streets_m are left; every junction keeps two, all stay connected.

    highways: (N,) highways that end at each node.
    """
    keep = np.ones(len(ends), bool)
    if not len(ends):
        return keep
    weights = 1.0 + rng.random(len(ends))
    tree = minimum_spanning_tree(coo_array((weights, (ends[:, 0], ends[:, 1])), shape=(len(highways),) * 2)).tocoo()
    needed = set(zip(tree.row.tolist(), tree.col.tolist(), strict=True))
    degree = (highways + np.bincount(ends.ravel(), minlength=len(highways))).tolist()
    left = float(lengths.sum())
    for row in rng.permutation(len(ends)).tolist():
        a, b = ends[row].tolist()
        if left - lengths[row] / 2 <= streets_m:
            break
        if degree[a] > 2 and degree[b] > 2 and (a, b) not in needed:
            keep[row] = False
            left -= lengths[row]
            degree[a] -= 1
            degree[b] -= 1
    return keep
