"""Where a drive goes at junctions: a walk without U-turns, balanced so that it covers every road evenly."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.simulate.streets import Graph

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

STRAIGHT = np.cos(np.radians(30.0))
"""Cosine of the largest deflection that still is straight on."""
SHARP = np.cos(np.radians(135.0))
"""Cosine of the deflection beyond which a turn is sharp."""
SHARP_WEIGHT = 0.2
"""A sharp turn against another turn."""


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Roads with a direction: 2 e runs along edge e from its first to its second end, 2 e + 1 back.

    onward: (2 E, D) those that may follow; until: (2 E, D) sums of their probabilities, 1 behind the last.
    """

    onward: Ints
    until: Floats

    def walk(self, start: int, lengths: Floats, length_m: float, rng: np.random.Generator) -> Ints:
        """Directed edges from start on, until those after it have length_m; lengths: (E,) m."""
        way, covered = [start], 0.0
        while covered < length_m:
            here = way[-1]
            way.append(int(self.onward[here, np.searchsorted(self.until[here], rng.random(), side="right")]))
            covered += lengths[way[-1] // 2]
        return np.array(way, np.intp)


def turns_of(graph: Graph, straight_on: float) -> Turns:
    """Turns at every junction of a graph; straight_on: weight of going straight against that of a turn.

    Probabilities are the weights scaled until those of coming out of each road sum to one as well as those of going in
    (Sinkhorn). Then the walk is on every directed edge equally often: kilometres driven follow kilometres of road.
    """
    count = len(graph.ends)
    tail = np.stack((graph.ends[:, 0], graph.ends[:, 1]), axis=-1).ravel()
    order = np.argsort(tail, kind="stable")
    degree = np.bincount(tail, minlength=len(graph.nodes))
    begin = np.concatenate(([0], np.cumsum(degree)))
    slot = np.empty(2 * count, np.intp)
    slot[order] = np.arange(2 * count) - begin[tail[order]]
    out = np.full((len(graph.nodes), degree.max()), -1)
    out[tail, slot] = np.arange(2 * count)
    probability = _balanced(_weights(graph, out, straight_on))
    # a road comes in where its way back goes out
    back = np.arange(2 * count) ^ 1
    head = tail[back]
    until = np.cumsum(probability[head, slot[back]], axis=1)
    last = np.where(probability[head, slot[back]] > 0, np.arange(out.shape[1]), 0).max(axis=1)
    until[np.arange(out.shape[1]) >= last[:, None]] = 1.0
    return Turns(out[head], until)


def _weights(graph: Graph, out: Ints, straight_on: float) -> Floats:
    """(N, D, D) weight of coming in by (against) one road that goes out and leaving by another; 0 for a U-turn."""
    first, last = graph.first[:-1], graph.first[1:] - 1
    leaves = np.empty((2 * len(graph.ends), 2))
    leaves[0::2] = graph.vertices[first + 1] - graph.vertices[first]
    leaves[1::2] = graph.vertices[last - 1] - graph.vertices[last]
    leaves /= np.linalg.norm(leaves, axis=1, keepdims=True)
    there = out >= 0
    onward = -np.einsum("nax,nbx->nab", leaves[out], leaves[out])
    weight = np.where(onward > STRAIGHT, straight_on, np.where(onward < SHARP, SHARP_WEIGHT, 1.0))
    weight *= there[:, :, None] & there[:, None, :] & ~np.eye(out.shape[1], dtype=bool)
    return weight


def _balanced(weight: Floats) -> Floats:
    """Symmetric (N, D, D) scaled to rows and columns that sum to one (empty ones stay empty)."""
    scale = np.where(weight.any(axis=2), 1.0, 0.0)
    for _ in range(200):
        total = np.einsum("nab,nb->na", weight, scale)
        scale = np.sqrt(scale / np.where(total > 0, total, 1.0))
    return scale[:, :, None] * weight * scale[:, None, :]
