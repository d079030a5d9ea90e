"""Surfels of a point cloud: the paper's section 5, planes of voxels, the thin ones, one in a cell of the ground.

A plane has no side: normals point up (z >= 0), wherever the cloud was seen from.
"""

from collections.abc import Iterable
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import Positive
from sensors.maps.vector_map import NO_SURFELS, Surfels
from sensors.maps.voxels import Voxels

Floats = NDArray[np.float64]

BATCH = 1 << 15
"""Voxels whose windows are looked at together: 80 MB."""


class SurfelConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How planes are found and which are kept."""

    cell_m: Positive = 1.0
    """Side of a cell of the ground (x, y) that keeps one surfel, m (paper: 1)."""
    window_m: Positive = 1.0
    """Side of the cubes in which planes are looked for, m."""
    overlap: Annotated[int, msgspec.Meta(ge=1, le=8)] = 2
    """Cubes begin every window_m / overlap: 1 side by side, 2 overlapping by half."""
    max_ratio: Positive = 0.1
    """Largest lambda1/lambda2 (paper: 0.1)."""
    min_points: Annotated[int, msgspec.Meta(ge=3)] = 10
    """Points of a plane."""
    min_spread_m: Positive = 0.1
    """Least extent across its longest axis, sqrt(lambda2), m: points along one line of a scanner are no plane."""


def surfels_of(points: Floats | Iterable[Floats], config: SurfelConfig | None = None) -> Surfels:
    """Surfels of points (N, 3) m in map axes, or of an iterator of such chunks in any order.

    Sorted by cell, x first. Memory follows the occupied voxels: about 150 bytes each.
    Raises EgolocError for points that are not finite.
    """
    config = config or SurfelConfig()
    voxels = Voxels(config.window_m / config.overlap)
    for chunk in (points,) if isinstance(points, np.ndarray) else points:
        voxels.add(chunk)
    return surfels_in(voxels, config)


def surfels_in(voxels: Voxels, config: SurfelConfig, least_sightings: int = 1) -> Surfels:
    """Surfels of gathered points; voxels sighted less often are left out."""
    kept = voxels.sighted(least_sightings)
    rows = np.flatnonzero(kept)
    found = [_planes(voxels, rows[i : i + BATCH], kept, config) for i in range(0, len(rows), BATCH)]
    if not found:
        return NO_SURFELS
    columns = (np.concatenate([getattr(part, name) for part in found]) for name in Surfels.__slots__)
    return best_of_cells(Surfels(*columns), config.cell_m)


def _planes(voxels: Voxels, rows: NDArray[np.int64], kept: NDArray[np.bool_], config: SurfelConfig) -> Surfels:
    """The thin planes among the windows of these voxels."""
    _, mean, cov, middle = voxels.windows(rows, kept, config.overlap, config.min_points)
    values, vectors = np.linalg.eigh(cov)
    first, second, third = np.maximum(values, 0.0).T
    thin = (first <= config.max_ratio * second) & (second >= config.min_spread_m**2)
    thin &= _through_the_middle(vectors[:, :, 0], mean - middle, voxels.voxel_m)
    first, second, third, mean = first[thin], second[thin], third[thin], mean[thin]
    normal = upward(vectors[thin, :, 0])
    ratios = np.stack((first / second, first / third), axis=-1)
    return Surfels(mean[:, :2], mean[:, 2], normal, ratios)


def _through_the_middle(normal: Floats, offset: Floats, step_m: float) -> NDArray[np.bool_]:
    """(K,) whether planes at offset (K, 3) from their cubes' middles pass no farther from these than a cube next door.

    A cube whose side runs along a plane holds a slice of its noise: the thinnest of all, and up to 3 cm beside it.
    """
    away = np.abs(np.einsum("ki,ki->k", normal, offset))
    inside: NDArray[np.bool_] = away <= step_m / 2.0 * np.abs(normal).max(axis=1) + 1e-6
    return inside


def upward(normal: Floats) -> Floats:
    """(K, 3) the same planes' normals, z >= 0; of upright ones y >= 0, then x > 0."""
    x, y, z = normal.T
    down = (z < 0.0) | ((z == 0.0) & ((y < 0.0) | ((y == 0.0) & (x < 0.0))))
    return np.where(down[:, None], -normal, normal)


def best_of_cells(surfels: Surfels, cell_m: float) -> Surfels:
    """Of the surfels in each cell of the ground the one with the smallest lambda1/lambda2; sorted by cell."""
    column, row = np.floor(surfels.p / cell_m).T
    order = np.lexsort((surfels.z, surfels.ratios[:, 1], surfels.ratios[:, 0], row, column))
    first = np.ones(len(order), np.bool_)
    first[1:] = (np.diff(column[order]) != 0.0) | (np.diff(row[order]) != 0.0)
    return surfels.chosen(order[first])
