"""The outline of areas that overlap or adjoin: of each one's ring, what has none of them on one of its sides."""

import numpy as np
from numpy.typing import NDArray

from sensors.geodesy import Floats

SEAM_M = 0.1
"""Areas that are nearer than this to each other adjoin."""


def outlines(rings: list[Floats]) -> list[tuple[int, Floats]]:
    """Polylines (n, 3) of the rings' parts that have areas on one side only, each with its ring's index; once.

    rings: closed, (n, 3), the last vertex the first again; one that no other overlaps or adjoins comes back whole.
    """
    result = []
    for index, ring in enumerate(rings):
        others = [other for i, other in enumerate(rings) if i != index and _boxes_meet(ring, other)]
        split = _split(ring, others)
        earlier = [other for other in rings[:index] if _boxes_meet(ring, other)]
        hidden = _within(split, [ring, *others]) | _repeats(split, earlier)
        result += [(index, part) for part in _parts(split, hidden)] if hidden.any() else [(index, ring)]
    return result


def _within(ring: Floats, areas: list[Floats]) -> NDArray[np.bool_]:
    """(edges,) whether an edge has areas on both sides."""
    along = np.diff(ring[:, :2], axis=0)
    across = np.column_stack((-along[:, 1], along[:, 0])) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    middle = 0.5 * (ring[:-1, :2] + ring[1:, :2])
    left, right = (
        np.any([inside(middle + offset * across, area) for area in areas], axis=0) for offset in (SEAM_M, -SEAM_M)
    )
    result: NDArray[np.bool_] = left & right
    return result


def _repeats(ring: Floats, earlier: list[Floats]) -> NDArray[np.bool_]:
    """(edges,) whether an edge lies on another ring's."""
    middle = 0.5 * (ring[:-1, None, :2] + ring[1:, None, :2])
    hidden = np.zeros(len(ring) - 1, bool)
    for other in earlier:
        u, w = np.diff(other[:, :2], axis=0), middle - other[:-1, :2]
        along = np.clip((w * u).sum(axis=2) / np.maximum((u * u).sum(axis=1), 1e-12), 0.0, 1.0)
        hidden |= (np.linalg.norm(w - along[..., None] * u, axis=2) < SEAM_M).any(axis=1)
    return hidden


def inside(points: Floats, ring: Floats) -> NDArray[np.bool_]:
    """(N,) whether points (N, 2) lie in a closed ring (n, 2 or 3)."""
    a, b = ring[:-1, :2], ring[1:, :2]
    x, y = points[:, :1], points[:, 1:]
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    left = x < a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise
    result: NDArray[np.bool_] = (spans & left).sum(axis=1) % 2 == 1
    return result


def _boxes_meet(one: Floats, other: Floats) -> bool:
    low = np.maximum(one[:, :2].min(axis=0), other[:, :2].min(axis=0))
    high = np.minimum(one[:, :2].max(axis=0), other[:, :2].max(axis=0))
    return bool((low <= high + SEAM_M).all())


def _split(ring: Floats, others: list[Floats]) -> Floats:
    """The ring with vertices added wherever it crosses another one, or passes one's vertex within a seam."""
    along = [part for other in others for part in (_crossings(ring, other), _passed(ring, other))]
    t = np.unique(np.concatenate((np.arange(len(ring)), *along)))
    edge = np.minimum(t.astype(np.int64), len(ring) - 2)
    part = (t - edge)[:, None]
    split: Floats = ring[edge] * (1.0 - part) + ring[edge + 1] * part
    return split


def _crossings(ring: Floats, other: Floats) -> Floats:
    """Where the ring crosses another, in edges from its beginning. Parallel edges do not cross."""
    p, u = ring[:-1, None, :2], np.diff(ring[:, :2], axis=0)[:, None]
    q, v = other[None, :-1, :2], np.diff(other[:, :2], axis=0)[None]
    slant = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    w = q - p
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (w[..., 0] * v[..., 1] - w[..., 1] * v[..., 0]) / slant
        t = (w[..., 0] * u[..., 1] - w[..., 1] * u[..., 0]) / slant
        rows, columns = np.nonzero((s > 0) & (s < 1) & (t >= 0) & (t <= 1))
    return np.asarray(rows + s[rows, columns])


def _passed(ring: Floats, other: Floats) -> Floats:
    """Where the ring passes vertices of another, in edges from its beginning."""
    u = np.diff(ring[:, :2], axis=0)[:, None]
    w = other[None, :-1, :2] - ring[:-1, None, :2]
    along = (w * u).sum(axis=2) / np.maximum((u * u).sum(axis=2), 1e-12)
    rows, columns = np.nonzero((along > 0) & (along < 1) & (np.linalg.norm(w - along[..., None] * u, axis=2) < SEAM_M))
    return np.asarray(rows + along[rows, columns])


def _parts(ring: Floats, hidden: NDArray[np.bool_]) -> list[Floats]:
    """Runs of edges that are not hidden, of a closed ring of which some are: one may run across its beginning."""
    start = int(np.argmax(hidden))
    order = np.roll(np.arange(len(hidden)), -start)
    shown = np.concatenate(([False], ~hidden[order], [False]))
    begins, ends = np.flatnonzero(~shown[:-1] & shown[1:]), np.flatnonzero(shown[:-1] & ~shown[1:])
    return [np.vstack((ring[order[a:b]], ring[order[b - 1] + 1])) for a, b in zip(begins, ends, strict=True)]
