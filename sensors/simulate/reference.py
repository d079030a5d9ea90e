"""The truth of a drive in map coordinates, as the reference that results are scored against."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import NonNegative, Positive
from sensors.geodesy import MapFrame, map_from_llh, rotation_map_enu
from sensors.records import Trajectory
from sensors.rotation import multiply, q_from_matrix, wrap, yaw_from_q
from sensors.simulate.trajectory import Motion
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]


class ReferenceSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The reference trajectory: the truth itself."""

    use: bool = True
    """Put a reference into the log."""
    rate_hz: Positive = 100.0
    """Rate, Hz."""
    start_s: NonNegative = 0.0
    """It begins this long after power-up: a system is switched on before it is judged, s."""
    sigma_m: Positive = 0.001
    """Stated sigma of its horizontal position, m."""
    sigma_yaw_deg: Positive = 0.001
    """Stated sigma of its yaw, deg."""


def convergence(llh: Floats, frame: MapFrame) -> Floats:
    """(N,) rad, by which ENU axes at llh (N, 3) are turned against a UTM frame's."""
    rotation, _ = rotation_map_enu(frame, llh)
    angle: Floats = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    return angle


def attitude_in_map(motion: Motion, frame: MapFrame) -> Floats:
    """(N, 4) q_map_body: the attitude in map axes, convergence included."""
    if frame.kind == "enu":
        return multiply(q_from_matrix(rotation_map_enu(frame, motion.llh)[0]), motion.q_enu_body)
    half = 0.5 * convergence(motion.llh, frame)
    cosine, sine = np.cos(half), np.sin(half)
    x, y, z, w = motion.q_enu_body.T
    q = (cosine * x - sine * y, cosine * y + sine * x, cosine * z + sine * w, cosine * w - sine * z)
    return np.stack(q, axis=-1)


def yaw_in_map(motion: Motion, frame: MapFrame) -> Floats:
    """(N,) rad, yaw in map axes."""
    if frame.kind == "enu":
        return yaw_from_q(attitude_in_map(motion, frame))
    return wrap(yaw_from_q(motion.q_enu_body) + convergence(motion.llh, frame))


def reference(motion: Motion, frame: MapFrame, vehicle: Vehicle, config: ReferenceSimulation) -> Trajectory:
    """Truth of the vehicle's reference point at the times of motion (N,)."""
    p_map = map_from_llh(frame, motion.place_of(vehicle.reference_lever_arm))
    sigma = np.broadcast_to([config.sigma_m, np.radians(config.sigma_yaw_deg)], (len(p_map), 2))
    return Trajectory(motion.t_ns, motion.t_ns, p_map, attitude_in_map(motion, frame), sigma)
