"""The truth of a drive in map coordinates, as the reference that results are scored against."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import Positive
from sensors.geodesy import MapFrame, map_from_llh, rotation_map_enu
from sensors.records import Trajectory
from sensors.rotation import multiply, q_from_matrix
from sensors.simulate.trajectory import Motion, Truth
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]


class ReferenceSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The reference trajectory: the truth itself."""

    use: bool = True
    """Put a reference into the log."""
    rate_hz: Positive = 100.0
    """Rate, Hz."""
    sigma_m: Positive = 0.001
    """Stated sigma of its horizontal position, m."""
    sigma_yaw_deg: Positive = 0.001
    """Stated sigma of its yaw, deg."""


def attitude_in_map(motion: Motion, frame: MapFrame) -> Floats:
    """(N, 4) q_map_body: the attitude in map axes, convergence included."""
    rotation, _ = rotation_map_enu(frame, motion.llh)
    return multiply(q_from_matrix(rotation), motion.q_enu_body)


def reference(
    truth: Truth, t_ns: NDArray[np.int64], frame: MapFrame, vehicle: Vehicle, config: ReferenceSimulation
) -> Trajectory:
    """Truth of the vehicle's reference point at t_ns (N,)."""
    p_map, q_map_body = np.empty((len(t_ns), 3)), np.empty((len(t_ns), 4))
    for rows, motion in truth.chunks(t_ns):
        p_map[rows] = map_from_llh(frame, motion.place_of(vehicle.reference_lever_arm))
        q_map_body[rows] = attitude_in_map(motion, frame)
    sigma = np.broadcast_to([config.sigma_m, np.radians(config.sigma_yaw_deg)], (len(t_ns), 2))
    return Trajectory(t_ns, t_ns, p_map, q_map_body, sigma)
