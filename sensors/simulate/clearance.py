"""Room for those who drive: nothing of one street stands on another one, or where drives round off a corner."""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sensors.simulate.corners import Corners
from sensors.simulate.furnishing import HALF_WIDTH_M
from sensors.simulate.network import Network
from sensors.simulate.street_lines import rounded

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

TURN_M = 2.5
"""Half the width that a vehicle takes on a turn, m."""


class Clearance(NamedTuple):
    """Points along the middles of other streets, and along turns."""

    others: cKDTree
    turns: cKDTree

    @classmethod
    def of(cls, others: list[Floats], turns: list[Floats]) -> "Clearance":
        """others: middles (n, 2) m of the streets nearby; turns: (n, 2) m."""
        none = [np.empty((0, 2))]
        return cls(cKDTree(np.concatenate(others or none)), cKDTree(np.concatenate(turns or none)))

    def off_streets(self, xy: Floats) -> Mask:
        """Which places (N, 2) m lie outside of the other streets."""
        clear: Mask = _distance(self.others, xy, HALF_WIDTH_M) >= HALF_WIDTH_M
        return clear

    def at(self, xy: Floats, margin: float) -> Mask:
        """Which places (N, 2) m lie so many metres outside of all that."""
        wide, narrow = HALF_WIDTH_M + margin, TURN_M + margin
        off: Mask = _distance(self.others, xy, wide) >= wide
        return off & (_distance(self.turns, xy, narrow) >= narrow)

    def fits(self, corners: Floats, margin: float) -> Mask:
        """(N,) which quadrilaterals (N, 4, 2) m lie outside, by their corners, the middles of sides, and theirs."""
        sides = 0.5 * (corners + np.roll(corners, 1, axis=1))
        points = np.concatenate((corners, sides, corners.mean(axis=1, keepdims=True)), axis=1)
        clear: Mask = np.all(self.at(points.reshape(-1, 2), margin).reshape(points.shape[:2]), axis=1)
        return clear


def _distance(tree: cKDTree, xy: Floats, most: float) -> Floats:
    if not tree.n or not len(xy):
        return np.full(len(xy), np.inf)
    apart, _ = tree.query(xy, distance_upper_bound=most + 1.0)
    return np.asarray(apart)


def turns_at(network: Network, node: int) -> list[Floats]:
    """(n, 2) m in the network's plane along the turn from each road at a node into each other."""
    graph = network.graph
    ways = []
    for edge, end in zip(*np.nonzero(graph.ends == node), strict=True):
        rows = graph.first[edge] + 1 if end == 0 else graph.first[edge + 1] - 2
        ways.append(graph.vertices[rows])
    setback = np.array([0.0, network.setback[node], 0.0])
    corners = [np.stack((a, graph.nodes[node], b)) for a, b in combinations(ways, 2)]
    return [rounded(Corners(xy, np.zeros(3), setback))[0] for xy in corners]
