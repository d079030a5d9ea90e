"""The outline of overlapping areas: of each one's ring, what lies in no other."""

import numpy as np
from numpy.typing import NDArray

from sensors.geodesy import Floats


def outlines(rings: list[Floats]) -> list[tuple[int, Floats]]:
    """Polylines (n, 3) of the rings' parts that lie in no other ring, each with its ring's index.

    rings: closed, (n, 3), the last vertex the first again; a ring of which nothing lies in another comes back whole.
    Two rings' common edge runs in neither, and stays in both.
    """
    result = []
    for index, ring in enumerate(rings):
        others = [other for i, other in enumerate(rings) if i != index and _boxes_meet(ring, other)]
        split = _split(ring, others)
        middles = 0.5 * (split[:-1, :2] + split[1:, :2])
        hidden = np.zeros(len(middles), bool)
        for other in others:
            hidden |= inside(middles, other)
        result += [(index, part) for part in _parts(split, hidden)] if hidden.any() else [(index, ring)]
    return result


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
    return bool((low <= np.minimum(one[:, :2].max(axis=0), other[:, :2].max(axis=0))).all())


def _split(ring: Floats, others: list[Floats]) -> Floats:
    """The ring with vertices added wherever it crosses another one."""
    along = [np.arange(len(ring), dtype=np.float64), *(_crossings(ring, other) for other in others)]
    t = np.unique(np.concatenate(along))
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


def _parts(ring: Floats, hidden: NDArray[np.bool_]) -> list[Floats]:
    """Runs of edges that are not hidden, of a closed ring of which some are: one may run across its beginning."""
    start = int(np.argmax(hidden))
    order = np.roll(np.arange(len(hidden)), -start)
    shown = np.concatenate(([False], ~hidden[order], [False]))
    begins, ends = np.flatnonzero(~shown[:-1] & shown[1:]), np.flatnonzero(shown[:-1] & ~shown[1:])
    return [np.vstack((ring[order[a:b]], ring[order[b - 1] + 1])) for a, b in zip(begins, ends, strict=True)]
