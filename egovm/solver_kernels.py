"""Dot products of embeddings with patches of a BEV map, channels last, their gradients, and their sums over points at
each candidate: loops for the CPU.

Features are read where they lie: gathering the patches first moves ten times as much memory and takes four times as
long. What the innermost loops walk along is taken as a view before them, so that they are vectorized.
"""

import math
from typing import Any

import numba
import numpy as np
from numba.extending import overload

from sensors.kernel import kernel

_SUMS = {"reassoc", "contract"}
"""Sums may be taken in any order, NaN and infinity stay what they are."""


def number(held: Any) -> Any:
    """What an array holds: a float as it is, or the upper 16 bits of a float32 (bfloat16, which numpy has not)."""
    raise NotImplementedError("compiled code alone calls this")


def _as_it_is(held: Any) -> Any:
    return held


def _from_bits(held: Any) -> Any:
    return np.uint32(np.uint32(held) << np.uint32(16)).view(np.float32)


@overload(number)  # type: ignore[untyped-decorator]
def _number(held: Any) -> Any:
    return _from_bits if isinstance(held, numba.types.Integer) else _as_it_is


@kernel(nogil=True, fastmath=_SUMS)
def dot_patches(features: Any, embeddings: Any, corners: Any, valid: Any, order: Any, dots: Any) -> None:
    """Fill dots (B, N, G, S, S) of valid points: of each of G groups of channels, over a patch.

    features: (B, H, W, G, C), also uint16 bits of bfloat16; embeddings: (B, N, G, C); corners: (B, N, 2) int64 first
    row and column of the patch;
    valid: (B, N) bool; order: (B, N) in which the points are taken, neighbours after each other so that what they share
    is still in the cache. A point that asks for the same as the one before it, as both ends of a surfel do, has its
    dots.
    """
    samples, points, groups, size, _ = dots.shape
    channels = features.shape[4]
    for b in range(samples):
        before = -1
        for m in range(points):
            n = order[b, m]
            if not valid[b, n]:
                continue
            if before >= 0 and _same(corners[b], embeddings[b], n, before):
                _copy(dots[b, before], dots[b, n])
                continue
            before = n
            row, column = corners[b, n, 0], corners[b, n, 1]
            for g in range(groups):
                embedding = embeddings[b, n, g]
                for r in range(size):
                    cells, line = features[b, row + r], dots[b, n, g, r]
                    for c in range(size):
                        cell = cells[column + c, g]
                        total = dots.dtype.type(0)
                        for k in range(channels):
                            total += number(cell[k]) * embedding[k]
                        line[c] = total


@kernel()
def _same(corners: Any, embeddings: Any, first: int, second: int) -> bool:
    """Corners (N, 2) and embeddings (N, G, C) of two points are equal."""
    if corners[first, 0] != corners[second, 0] or corners[first, 1] != corners[second, 1]:
        return False
    for g in range(embeddings.shape[1]):
        for k in range(embeddings.shape[2]):
            if embeddings[first, g, k] != embeddings[second, g, k]:
                return False
    return True


@kernel()
def _copy(dots: Any, to: Any) -> None:
    """Those (G, S, S) of a point to another."""
    for g in range(dots.shape[0]):
        for r in range(dots.shape[1]):
            for c in range(dots.shape[2]):
                to[g, r, c] = dots[g, r, c]


@kernel(nogil=True, fastmath=_SUMS)
def add_embedding_gradient(features: Any, corners: Any, valid: Any, gradient: Any, into: Any) -> None:
    """Add to into (B, N, G, C) what the gradient (B, N, G, S, S) of the dots says of the embeddings."""
    samples, points, groups, size, _ = gradient.shape
    channels = features.shape[4]
    for b in range(samples):
        for n in range(points):
            if not valid[b, n]:
                continue
            row, column = corners[b, n, 0], corners[b, n, 1]
            for g in range(groups):
                embedding = into[b, n, g]
                for r in range(size):
                    cells, line = features[b, row + r], gradient[b, n, g, r]
                    for c in range(size):
                        cell, weight = cells[column + c, g], line[c]
                        for k in range(channels):
                            embedding[k] += weight * cell[k]


@kernel(nogil=True, fastmath=_SUMS)
def add_feature_gradient(embeddings: Any, corners: Any, valid: Any, gradient: Any, into: Any) -> None:
    """Add to into (B, H, W, G, C) what the gradient (B, N, G, S, S) of the dots says of the features."""
    samples, points, groups, size, _ = gradient.shape
    channels = into.shape[4]
    for b in range(samples):
        for n in range(points):
            if not valid[b, n]:
                continue
            row, column = corners[b, n, 0], corners[b, n, 1]
            for g in range(groups):
                embedding = embeddings[b, n, g]
                for r in range(size):
                    cells, line = into[b, row + r], gradient[b, n, g, r]
                    for c in range(size):
                        cell, weight = cells[column + c, g], line[c]
                        for k in range(channels):
                            cell[k] += weight * embedding[k]


@kernel(nogil=True, fastmath=_SUMS)
def add_lattice_sums(dots: Any, local: Any, times: Any, size: int, into: Any) -> None:
    """Add to into (B, yaw, n S) the points' dots (B, N, S S), read bilinearly around where each lies in its patch.

    local: (B, N, yaw, 2) row and column in the patch; candidate (i, j) reads i rows and j columns beyond it; times:
    (B, N) how often each point counts, those that do not are not looked at. The last S - n columns of into mean
    nothing: they let one loop run through all rows.
    """
    samples, points, yaws, _ = local.shape
    steps = into.shape[2] // size
    for b in range(samples):
        for n in range(points):
            if times[b, n] == 0:
                continue
            for yaw in range(yaws):
                row, column = _first(local[b, n, yaw, 0], size - steps), _first(local[b, n, yaw, 1], size - steps)
                down, right = local[b, n, yaw, 0] - row, local[b, n, yaw, 1] - column
                upper, lower = times[b, n] * (1 - down), times[b, n] * down
                first, second = upper * (1 - right), upper * right
                third, fourth = lower * (1 - right), lower * right
                corner, flat = row * size + column, into[b, yaw]
                above, beside = dots[b, n, corner:], dots[b, n, corner + 1 :]
                below, across = dots[b, n, corner + size :], dots[b, n, corner + size + 1 :]
                for k in range((steps - 1) * size + steps):
                    flat[k] += first * above[k] + second * beside[k] + third * below[k] + fourth * across[k]


@kernel(inline="always")
def _first(place: Any, room: int) -> int:
    """The cell before a place, such that what is read lies on the patch."""
    first: int = min(max(math.floor(place), 0), room - 1)
    return first
