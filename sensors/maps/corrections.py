"""What is known of a given trajectory's errors, and corrections of some of its poses brought to all of its rows."""

from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sensors.bounds import Positive
from sensors.maps.pose_graph import Given, Solution
from sensors.records import Trajectory
from sensors.rotation import matrix_from_q, q_from_matrix, rotate
from sensors.vehicle import Vector3

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]


class ErrorModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a given trajectory errs."""

    sigma_m: Positive = 0.5
    """Standard deviation of its horizontal positions where it says none, m."""
    sigma_yaw_deg: Positive = 0.5
    """Standard deviation of its yaw where it says none, deg."""
    sigma_level_deg: Positive = 0.2
    """Standard deviation of its roll and pitch, deg."""
    height_factor: Positive = 1.5
    """Its heights are so many times worse than its horizontal positions."""
    correlation_s: Positive = 30.0
    """Over which its errors are forgotten, s."""


class Corrected(NamedTuple):
    """trajectory: refined, sigma as found; correction_m: (N,) horizontal; correction_yaw: (N,) rad; outside: rows of
    the given one that were not refined and are left out."""

    trajectory: Trajectory
    correction_m: Floats
    correction_yaw: Floats
    outside: int


def pose_sigmas(trajectory: Trajectory, t_ns: Nanoseconds, model: ErrorModel) -> Floats:
    """(N, 6) standard deviations at t_ns (N,) rising, of rotation rad and translation m in map axes."""
    row = np.clip(np.searchsorted(trajectory.t_ns, t_ns), 0, len(trajectory) - 1)
    position, yaw = trajectory.sigma[row].T
    position = np.where(position > 0.0, position, model.sigma_m)
    yaw = np.where(yaw > 0.0, yaw, np.radians(model.sigma_yaw_deg))
    level = np.full(len(t_ns), np.radians(model.sigma_level_deg))
    return np.stack((level, level, yaw, position, position, model.height_factor * position), axis=-1)


def corrected(trajectory: Trajectory, t_ns: Nanoseconds, given: Given, solution: Solution, arm: Vector3) -> Corrected:
    """The rows from the first to the last of the corrected poses at t_ns (K,), corrections linear in between.

    arm: the point of the body whose trajectory it is, m. sigma: the worst horizontal direction, and yaw.
    """
    inside = (trajectory.t_ns >= t_ns[0]) & (trajectory.t_ns <= t_ns[-1])
    rows = trajectory[inside]
    turn = Rotation.from_matrix(solution.R @ given.R.transpose(0, 2, 1)).as_rotvec()
    turn, shift = (_between(rows.t_ns, t_ns, part) for part in (turn, solution.p - given.p))
    known = np.isfinite(rows.q_map_body).all(axis=1)
    q, p = rows.q_map_body.copy(), rows.p_map + shift
    q[known] = q_from_matrix(Rotation.from_rotvec(turn[known]).as_matrix() @ matrix_from_q(q[known]))
    p[known] += rotate(q[known], np.asarray(arm)) - rotate(rows.q_map_body[known], np.asarray(arm))
    sigma = _between(rows.t_ns, t_ns, _sigma(solution.cov))
    moved = np.hypot(*(p - rows.p_map)[:, :2].T)
    return Corrected(Trajectory(rows.t_ns, rows.t_ns, p, q, sigma), moved, turn[:, 2], int((~inside).sum()))


def _between(t_ns: Nanoseconds, known_ns: Nanoseconds, values: Floats) -> Floats:
    """(N, C) columns of values (K, C) at t_ns, linear in time."""
    t, known = (t_ns - known_ns[0]).astype(np.float64), (known_ns - known_ns[0]).astype(np.float64)
    return np.column_stack([np.interp(t, known, column) for column in values.T])


def _sigma(cov: Floats) -> Floats:
    """(K, 2) m, rad."""
    a, b, c = cov[:, 3, 3], cov[:, 3, 4], cov[:, 4, 4]
    return np.sqrt(np.stack(((a + c) / 2 + np.hypot((a - c) / 2, b), cov[:, 2, 2]), axis=-1))
