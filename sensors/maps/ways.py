"""Pieces of road chained into ways: from the end of one on to what begins or ends near it, ahead."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sensors.maps.vector_map import Floats

GAP = 3.0
"""Spacings between the end of a piece and the beginning of the next, at most."""
BEND = 0.5
"""Cosine of the largest turn from one piece into the next."""

Chain = list[tuple[int, bool]]
"""Pieces in order, and whether each is driven backwards."""


def chained(
    xy: Floats, heading: Floats, line: NDArray[np.int64], spacing_m: float
) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.int64]]:
    """Order of N places, which of them (in that order) are driven backwards, and (N,) the number of their way, rising.

    xy, heading: (N, 2) m, (N,) rad along their line; line: (N,) its number; places of a line stand together, in order.
    """
    if not len(xy):
        return np.empty(0, np.intp), np.empty(0, np.bool_), np.empty(0, np.int64)
    apart = np.hypot(*np.diff(xy, axis=0).T) > 2.0 * spacing_m
    first = np.concatenate(([0], np.flatnonzero((np.diff(line) != 0) | apart) + 1, [len(xy)]))
    rows, turned, way = [], [], []
    for number, chain in enumerate(_chains(xy, heading, first, GAP * spacing_m)):
        for piece, backwards in chain:
            part = np.arange(first[piece], first[piece + 1])
            rows.append(part[::-1] if backwards else part)
            turned.append(np.full(len(part), backwards))
            way.append(np.full(len(part), number))
    return np.concatenate(rows), np.concatenate(turned), np.concatenate(way)


def _chains(xy: Floats, heading: Floats, first: NDArray[np.intp], reach: float) -> list[Chain]:
    """All pieces, each in one chain; chains begin at the lowest number that is left."""
    begin, end = first[:-1], first[1:] - 1
    place = np.concatenate((xy[begin], xy[end]))
    inwards = np.concatenate((heading[begin], heading[end] + np.pi))  # into the piece, from either end
    into = np.column_stack((np.cos(inwards), np.sin(inwards)))
    near = _candidates(place, into, reach)
    free = np.ones(len(begin), np.bool_)
    chains = []
    for piece in range(len(begin)):
        if free[piece]:
            free[piece] = False
            back = _followed(piece, near, free)
            forth = _followed(piece + len(begin), near, free)
            chains.append([(i, not backwards) for i, backwards in reversed(back)] + [(piece, False)] + forth)
    return chains


def _candidates(place: Floats, into: Floats, reach: float) -> list[list[int]]:
    """Of each end of a piece the ends at which one could go on, the nearest first."""
    pairs = cKDTree(place).query_pairs(reach, output_type="ndarray")
    one, other = np.concatenate((pairs, pairs[:, ::-1])).T
    half = len(place) // 2
    smooth = ((into[one] * into[other]).sum(axis=1) < -BEND) & (one % half != other % half)
    one, other = one[smooth], other[smooth]
    distance = np.hypot(*(place[one] - place[other]).T)
    order = np.lexsort((distance, one))
    one, other = one[order], other[order]
    cut = np.searchsorted(one, np.arange(len(place) + 1))
    return [other[cut[i] : cut[i + 1]].tolist() for i in range(len(place))]


def _followed(end: int, near: list[list[int]], free: NDArray[np.bool_]) -> Chain:
    """What follows from an end on; an end is the number of its piece, plus that of all pieces where it is the last."""
    half = len(near) // 2
    chain: Chain = []
    while True:
        entry = next((other for other in near[end] if free[other % half]), None)
        if entry is None:
            return chain
        piece, backwards = entry % half, entry >= half
        free[piece] = False
        chain.append((piece, backwards))
        end = piece if backwards else piece + half
