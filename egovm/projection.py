"""Map points onto the BEV plane, in body axes: Eq. S1-S4 of the paper's supplement, with a pose of six degrees.

Most maps do not say how high a point lies, and roads are not level: so a point of the map is the place where the
vertical line through it meets a plane that rolls and pitches with the vehicle. The paper's plane goes through the
LiDAR; where the road climbs by 5 %, that moves paint 1.85 m below it by 9 cm. Ours is the ground.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from egovm.config import BevConfig
from sensors.errors import EgolocError

Floats = NDArray[np.float64]

_STEEPEST = math.cos(math.radians(60.0))
_NEAR_M = (3.0, 12.0)
"""Ground is looked for this far around the vehicle: nearer, LiDARs see its roof."""
_FEWEST = 50
_BIN_M = 0.1


def plane_height(bev: BevConfig, ground_m: float) -> float:
    """Height of the BEV plane in body axes, m. ground_m: that of the ground under the vehicle, below 0 as a rule."""
    return ground_m if bev.plane_height_m is None else bev.plane_height_m


def on_plane(xy: ArrayLike, T_map_body: Floats, height_m: float) -> Floats:
    """(..., 2) m, body axes: where vertical lines through map points (..., 2) m meet the plane z = height_m.

    T_map_body: (4, 4) float64. Its place is subtracted first, for float32 is 0.25 to 0.5 m coarse at UTM northings.
    Raises EgolocError for a vehicle that lies on its side.
    """
    R, t = T_map_body[:3, :3], T_map_body[:3, 3]
    n = R[:, 2]
    if not n[2] > _STEEPEST:
        tilt = math.degrees(math.acos(min(max(float(n[2]), -1.0), 1.0))) if math.isfinite(n[2]) else math.nan
        raise EgolocError(f"initial pose: expected a tilt under 60 deg, got {tilt:.0f} deg")
    # d = p - t with n . d = height (Eq. S1, S2), then R^T d (S3): one matrix of the two known components of d
    known = R[:2, :2] - np.outer(n[:2], R[2, :2]) / n[2]
    placed: Floats = (np.asarray(xy, np.float64) - t[:2]) @ known + height_m / n[2] * R[2, :2]
    return placed


def bev_cells(xy: ArrayLike, bev: BevConfig, level: int) -> Floats:
    """(..., 2) row and column, in cells, of places (..., 2) m in body axes: Eq. S4.

    Rows rise with x, columns with y; whole numbers are middles of cells.
    """
    cells: Floats = (np.asarray(xy, np.float64) + bev.half_m) / bev.cell_m[level] - 0.5
    return cells


def ground_under(xyz: NDArray[np.floating]) -> float | None:
    """Height of the ground in body axes, m, from LiDAR points (N, 3) m: the commonest height near the vehicle.

    None where there are too few points around it. For a vehicle whose calibration does not say how high it stands.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    z = xyz[(distance > _NEAR_M[0]) & (distance < _NEAR_M[1]), 2].astype(np.float64)
    if len(z) < _FEWEST:
        return None
    bins = np.floor(z / _BIN_M).astype(np.int64)
    counts = np.bincount(bins - bins.min())
    commonest = (int(counts.argmax()) + int(bins.min()) + 0.5) * _BIN_M
    return float(np.median(z[np.abs(z - commonest) <= _BIN_M]))
