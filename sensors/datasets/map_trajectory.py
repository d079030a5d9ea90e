"""A trajectory in geodetic coordinates and ENU attitude becomes a reference in map coordinates."""

import numpy as np
from numpy.typing import NDArray

from sensors.geodesy import MapFrame, map_from_llh, rotation_map_enu
from sensors.records import Trajectory
from sensors.rotation import multiply, q_from_matrix, q_from_rpy

Floats = NDArray[np.float64]


def trajectory_from_llh(
    frame: MapFrame, t_ns: NDArray[np.int64], llh: Floats, q_enu_body: Floats | None, sigma: Floats | None
) -> Trajectory:
    """Reference of (N, 3) llh and (N, 4) xyzw attitude (NaN rows where unknown); arrival is the stamp."""
    q = None
    if q_enu_body is not None:
        q = multiply(q_from_matrix(rotation_map_enu(frame, llh)[0]), q_enu_body)
    return Trajectory(t_ns, t_ns, map_from_llh(frame, llh), *filled(len(t_ns), q, sigma))


def filled(n: int, q: Floats | None, sigma: Floats | None) -> tuple[Floats, Floats]:
    """(N, 4) attitude and (N, 2) sigma, NaN where there are none."""
    return np.full((n, 4), np.nan) if q is None else q, np.full((n, 2), np.nan) if sigma is None else sigma


def q_from_aerospace(roll: Floats, pitch: Floats, heading: Floats) -> Floats:
    """(N, 4) q_enu_body (FLU) of aerospace angles, rad: right side down, nose up, heading clockwise from north."""
    return q_from_rpy(roll, -np.asarray(pitch), np.pi / 2 - np.asarray(heading))
