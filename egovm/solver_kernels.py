"""Dot products of embeddings with patches of a BEV map, channels last, and their gradients: loops for the CPU.

Features are read where they lie: gathering the patches first moves ten times as much memory and takes four times as
long. What the innermost loops walk along is taken as a view before them, so that they are vectorized.
"""

from typing import Any

from sensors.kernel import kernel

_SUMS = {"reassoc", "contract"}
"""Sums may be taken in any order, NaN and infinity stay what they are."""


@kernel(nogil=True, fastmath=_SUMS)
def dot_patches(features: Any, embeddings: Any, corners: Any, valid: Any, dots: Any) -> None:
    """Fill dots (B, N, G, S, S) of valid points: of each of G groups of channels, over a patch.

    features: (B, H, W, G, C); embeddings: (B, N, G, C); corners: (B, N, 2) int64 first row and column of the patch;
    valid: (B, N) bool.
    """
    samples, points, groups, size, _ = dots.shape
    channels = features.shape[4]
    for b in range(samples):
        for n in range(points):
            if not valid[b, n]:
                continue
            row, column = corners[b, n, 0], corners[b, n, 1]
            for g in range(groups):
                embedding = embeddings[b, n, g]
                for r in range(size):
                    cells, line = features[b, row + r], dots[b, n, g, r]
                    for c in range(size):
                        cell = cells[column + c, g]
                        total = dots.dtype.type(0)
                        for k in range(channels):
                            total += cell[k] * embedding[k]
                        line[c] = total


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
