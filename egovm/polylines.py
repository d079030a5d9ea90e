"""Polylines of a map cut into short straight pieces."""

import numpy as np
from numpy.typing import NDArray

from sensors.maps.vector_map import Elements, Kind, Style

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

LINES = (Kind.LANE_LINE, Kind.ROAD_BOUNDARY, Kind.STOP_LINE, Kind.CROSSING, Kind.MARKING)
"""Kinds that are drawn; the others stand."""
_SHORTEST_M = 1e-3


def line_pieces(elements: Elements, longest_m: float, corners: bool = False) -> tuple[Floats, NDArray[np.int8]]:
    """Straight pieces of all lines: ends (S, 2, 3) m in map axes, and kind (S,).

    A line becomes equally long pieces whose ends lie on it, as few as stay under longest_m; so a curve is cut short
    between them. Outlines of crossings and markings keep their corners (the paper's "segments of adjacent endpoints"),
    and with ``corners`` everything does. Dashed lines are lines; virtual ones, which nothing sees, are left out.
    """
    counts = np.diff(elements.first)
    drawn = np.isin(elements.kind, LINES) & (elements.style != Style.VIRTUAL) & (counts > 1)
    by_edge = drawn & (corners | _outlined(elements))
    begin, end = _paths(elements, drawn & ~by_edge, by_edge)
    ends, path = _cut(elements.xyz, begin, end, longest_m)
    owner = np.searchsorted(elements.first, begin[path], side="right") - 1
    return ends, elements.kind[owner]


def _outlined(elements: Elements) -> NDArray[np.bool_]:
    """(N,) whether an element is the outline of something."""
    xy, first = elements.xyz[:, :2], elements.first
    closed = (xy[first[:-1]] == xy[first[1:] - 1]).all(axis=1)
    outlined: NDArray[np.bool_] = (elements.kind == Kind.CROSSING) | (closed & (elements.kind == Kind.MARKING))
    return outlined


def _paths(elements: Elements, whole: NDArray[np.bool_], by_edge: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """First and last vertex of what is cut as one: whole elements, or each of their edges; in the order of the map."""
    first = elements.first
    begins = whole.repeat(np.diff(first)) & _marked(len(elements.xyz), first[:-1])
    edges = by_edge.repeat(np.diff(first)) & ~_marked(len(elements.xyz), first[1:] - 1)
    begin = np.flatnonzero(begins | edges)
    owner = np.searchsorted(first, begin, side="right") - 1
    return begin, np.where(edges[begin], begin + 1, first[owner + 1] - 1)


def _marked(count: int, rows: Indices) -> NDArray[np.bool_]:
    marks = np.zeros(count, np.bool_)
    marks[rows] = True
    return marks


def _cut(xyz: Floats, begin: Indices, end: Indices, longest_m: float) -> tuple[Floats, Indices]:
    """Pieces (S, 2, 3) of paths from vertex to vertex, and which path (S,) each is of. Paths of no length have none."""
    steps = np.hypot(*np.diff(xyz[:, :2], axis=0).T)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    length = along[end] - along[begin]
    pieces = np.where(length > _SHORTEST_M, np.ceil(length / longest_m - 1e-9).clip(1), 0).astype(np.int64)
    path = np.repeat(np.arange(len(begin)), pieces)
    number = np.arange(len(path)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    part = np.stack((number, number + 1), axis=1) / pieces[path, None]
    at = along[begin[path], None] + part * length[path, None]
    left = np.searchsorted(along, at, side="right") - 1
    left = np.clip(left, begin[path, None], end[path, None] - 1)
    weight = np.clip((at - along[left]) / np.maximum(steps[left], 1e-12), 0.0, 1.0)[..., None]
    return (1.0 - weight) * xyz[left] + weight * xyz[left + 1], path
