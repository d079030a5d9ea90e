"""Which tile of a map an element or a surfel belongs to."""

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

MOST = 12_000
"""Vertices and surfels of a tile beyond which it is quartered: so a query reads no more where a city is dense."""
HALVINGS = 10
"""How often a tile's side is halved at most; what lies in one place stays together."""


def tile_numbers(places: NDArray[np.float64], weights: NDArray[np.int64], side: float) -> Ints:
    """(N,) tiles 0, 1, 2, ... of places (N, 2), none empty; neighbours in a column of tiles follow each other.

    weights: (N,) vertices at each place; side: of a tile, in the unit of the places.
    """
    if not len(places):
        return np.empty(0, np.int64)
    corner = np.floor(places / side)
    column, row = (corner - corner.min(axis=0)).astype(np.int64).T
    numbers = _numbered(column * (row.max() + 1) + row)
    for halving in range(1, HALVINGS + 1):
        full = np.bincount(numbers, weights) > MOST
        rows = np.flatnonzero(full[numbers])
        if not len(rows):
            break
        quarter = np.floor(places[rows] * (2**halving / side)).astype(np.int64) & 1
        numbers *= 4
        numbers[rows] += 2 * quarter[:, 0] + quarter[:, 1]
        numbers = _numbered(numbers)
    return numbers


def _numbered(keys: Ints) -> Ints:
    """(N,) the rank of each key among those that occur."""
    ranks: Ints = np.unique(keys, return_inverse=True)[1].astype(np.int64)
    return ranks
