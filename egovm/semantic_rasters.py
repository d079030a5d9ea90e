"""What semantic supervision compares with: the map drawn into the BEV at the true pose, at every level."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovm.batch import TYPES
from egovm.config import BevConfig
from egovm.map_elements import standing
from egovm.polylines import line_pieces
from egovm.projection import bev_cells, on_plane, plane_height
from sensors.kernel import kernel
from sensors.maps.vector_map import Elements

Floats = NDArray[np.float64]

WIDTH_M = 0.3
"""How wide lines are drawn, and poles and signs around their middle."""
_PIECE_M = 4.0
"""Lines are drawn by pieces of at most this length: the box around a piece is searched, m."""


def semantic_rasters(
    elements: Elements, T_map_body: Floats, bev: BevConfig, ground_m: float
) -> tuple[NDArray[np.bool_], ...]:
    """For each level (TYPES - 1, H, W): cells whose middles lie on a line, a pole or a sign of each kind.

    T_map_body: (4, 4), the true pose; ground_m: height of the ground under the vehicle in body axes, m. Rows rise with
    the vehicle's x, columns with its y. Where cells are wider than a line, it is drawn as wide as a cell, and a point
    as wide as a cell's diagonal, so that nothing falls between the middles of cells. Surfels are not drawn.
    """
    height_m = plane_height(bev, ground_m)
    lines, line_kind = line_pieces(elements, _PIECE_M, corners=True)
    place, _, point_kind = standing(elements)
    lines = on_plane(lines[..., :2], T_map_body, height_m)
    points = np.repeat(on_plane(place[:, None, :2], T_map_body, height_m), 2, axis=1)
    return tuple(
        _raster(bev, level, (lines, line_kind, 0.5), (points, point_kind, 0.5**0.5)) for level in range(len(bev.cell_m))
    )


def _raster(bev: BevConfig, level: int, *drawn: tuple[Floats, NDArray[np.int8], float]) -> NDArray[np.bool_]:
    """drawn: segments (S, 2, 2) m, their kinds (S,), and their least half width in cells."""
    cells = bev.cells(level)
    raster = np.zeros((TYPES - 1, cells, cells), np.bool_)
    for ends, kind, least in drawn:
        radius = max(WIDTH_M / 2.0 / bev.cell_m[level], least)
        draw(raster, np.ascontiguousarray(bev_cells(ends, bev, level)), kind.astype(np.int64), radius)
    return raster


@kernel(nogil=True)
def draw(raster: Any, ends: Any, kind: Any, radius: Any) -> None:
    """Set the cells (kinds, H, W) whose middles are at most radius cells from segments; ends: (S, 2, 2) row, column."""
    _, height, width = raster.shape
    for s in range(len(ends)):
        r0, c0, r1, c1 = ends[s, 0, 0], ends[s, 0, 1], ends[s, 1, 0], ends[s, 1, 1]
        dr, dc = r1 - r0, c1 - c0
        squared = dr * dr + dc * dc
        top, bottom = max(min(r0, r1) - radius, 0.0), min(max(r0, r1) + radius, height - 1.0)
        left, right = max(min(c0, c1) - radius, 0.0), min(max(c0, c1) + radius, width - 1.0)
        for row in range(int(np.ceil(top)), int(np.floor(bottom)) + 1):
            for column in range(int(np.ceil(left)), int(np.floor(right)) + 1):
                part = 0.0
                if squared > 0.0:
                    part = min(max(((row - r0) * dr + (column - c0) * dc) / squared, 0.0), 1.0)
                to_r, to_c = row - r0 - part * dr, column - c0 - part * dc
                if to_r * to_r + to_c * to_c <= radius * radius:
                    raster[kind[s], row, column] = True
