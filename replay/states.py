"""The columns of states.parquet: states in map coordinates beside the reference, with their errors.

Everything that scoring needs stands in these columns, so that a run can be scored again without its log. States are
compared at the body's origin. Where the reference has no attitude of its own, it is brought there from its point (an
antenna) by the estimate's attitude, which is the same as comparing at that point.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.result import FusionResult, States
from replay.hiding import stretch_index
from replay.references import Reference, errors, evaluated_only, lever, nothing, only, sample
from sensors.geodesy import MapFrame, map_from_llh, rotation_map_enu
from sensors.records import Log
from sensors.rotation import matrix_from_q, wrap

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Columns = dict[str, NDArray[Any]]


def state_columns(
    result: FusionResult, log: Log, frame: MapFrame, reference: Reference | None, period_ns: int
) -> Columns:
    """The columns of states.parquet: one row per state and per grid epoch of the reference without one (NaN there)."""
    states = result.states
    estimate, R_map_body, pose_cov = _map_columns(states, frame)
    missing = _epochs_without_state(states.t_ns, log, reference, period_ns)
    t_ns = np.r_[states.t_ns, missing]
    order = np.argsort(t_ns, kind="stable") if len(missing) else slice(None)
    spread = {name: _append_nan(column, len(missing))[order] for name, column in estimate.items()}
    rotations, cov = (_append_nan(a, len(missing))[order] for a in (R_map_body, pose_cov))
    compared = _compare(t_ns[order], spread, rotations, cov, reference)
    return {"t_ns": t_ns[order], **spread, "pose_cov": cov.reshape(len(cov), 36), **compared}


def _map_columns(states: States, frame: MapFrame) -> tuple[Columns, Floats, Floats]:
    """State columns in map axes, R_map_body (N, 3, 3) and the pose covariance (N, 6, 6): x, y, z, rotation x, y, z."""
    p_map = map_from_llh(frame, states.llh)
    R_map_enu, scale = rotation_map_enu(frame, states.llh)
    R = R_map_enu @ matrix_from_q(states.q_enu_body)
    turn = np.zeros((len(R), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = R_map_enu
    turn[:, :2, :3] *= scale[:, None, None]
    cov = turn @ states.pose_cov @ turn.transpose(0, 2, 1)
    columns = dict(zip("xyz", p_map.T, strict=True))
    columns |= {
        "roll": np.arctan2(R[:, 2, 1], R[:, 2, 2]),
        "pitch": np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0)),
        "yaw": np.arctan2(R[:, 1, 0], R[:, 0, 0]),
    }
    columns |= dict(zip(("ve", "vn", "vu"), states.vel_enu.T, strict=True))
    columns |= {
        "lat_deg": np.degrees(states.llh[:, 0]),
        "lon_deg": np.degrees(states.llh[:, 1]),
        "height_m": states.llh[:, 2],
    }
    for name, bias in (("gyro_bias", states.gyro_bias), ("accel_bias", states.accel_bias)):
        columns |= {f"{name}_{axis}": column for axis, column in zip("xyz", bias.T, strict=True)}
    return columns, R, cov


def _epochs_without_state(known: Nanoseconds, log: Log, reference: Reference | None, period_ns: int) -> Nanoseconds:
    """Stamps of the output grid, within log and reference, without a state: before alignment, after the end."""
    if reference is None or log.imu is None or not len(log.imu) or not len(reference.trajectory):
        return np.empty(0, np.int64)
    track = reference.trajectory.t_ns
    start, end = max(log.imu.t_ns[0], track[0]), min(log.imu.t_ns[-1], track[-1])
    anchor = int(known[0]) if len(known) else -(-int(start) // period_ns) * period_ns
    first = anchor - (anchor - int(start)) // period_ns * period_ns
    grid = np.arange(first, int(end) + 1, period_ns, dtype=np.int64)
    if not len(known):
        return grid
    after = np.clip(np.searchsorted(known, grid), 1, len(known) - 1) if len(known) > 1 else np.zeros(len(grid), np.intp)
    nearest = np.minimum(np.abs(known[after] - grid), np.abs(known[after - 1] - grid))
    missing: Nanoseconds = grid[nearest > period_ns // 2]
    return missing


def _compare(
    t_ns: Nanoseconds, estimate: Columns, R_map_body: Floats, cov: Floats, reference: Reference | None
) -> Columns:
    """Reference, error and sigma columns of the states."""
    p_map = np.stack([estimate[axis] for axis in "xyz"], axis=-1)
    stretch = np.full(len(t_ns), -1, np.int32)
    samples = nothing(t_ns) if reference is None else sample(reference.trajectory, t_ns)
    if reference is not None and reference.stretches is not None:
        stretch = stretch_index(t_ns, reference.stretches)
        samples = only(samples, stretch >= 0)
    point = np.zeros(3) if reference is None else np.asarray(reference.point, np.float64)
    ref_body = samples.p_map - lever(samples, point, R_map_body)
    ref_yaw = samples.heading if samples.has_heading else np.full(len(t_ns), np.nan)
    lon, lat = errors(samples, p_map - ref_body).T
    arm = np.zeros(3) if samples.has_heading else point
    sigma_lon, sigma_lat = _sigmas(
        cov, R_map_body @ arm, np.where(np.isfinite(samples.heading), samples.heading, estimate["yaw"])
    )
    return {
        **dict(zip(("ref_x", "ref_y", "ref_z"), ref_body.T, strict=True)),
        "ref_yaw": ref_yaw,
        "ref_speed": samples.speed,
        "ref_sigma_m": samples.sigma[:, 0],
        "ref_sigma_yaw": samples.sigma[:, 1],
        "excluded": samples.excluded,
        "err_lon": lon,
        "err_lat": lat,
        "err_yaw": evaluated_only(samples, wrap(estimate["yaw"] - ref_yaw)),
        "sigma_lon": sigma_lon,
        "sigma_lat": sigma_lat,
        "sigma_yaw": np.sqrt(cov[:, 5, 5]),
        "stretch": stretch,
    }


def _sigmas(cov: Floats, arm: Floats, heading: Floats) -> tuple[Floats, Floats]:
    """(N,) m each, along and left of a heading, of the body's point at arm (N, 3), map axes."""
    G = np.zeros((len(cov), 2, 6))
    G[:, 0, 0] = G[:, 1, 1] = 1.0  # left error: the point moves by dp + dtheta x arm
    G[:, 0, 4], G[:, 0, 5] = arm[:, 2], -arm[:, 1]
    G[:, 1, 3], G[:, 1, 5] = -arm[:, 2], arm[:, 0]
    plane = G @ cov @ G.transpose(0, 2, 1) if arm.any() else cov[:, :2, :2]
    c, s = np.cos(heading), np.sin(heading)
    a, b, d = plane[:, 0, 0], plane[:, 0, 1], plane[:, 1, 1]
    return np.sqrt(c * c * a + 2 * c * s * b + s * s * d), np.sqrt(s * s * a - 2 * c * s * b + c * c * d)


def _append_nan(column: Floats, count: int) -> Floats:
    """The rows, and count rows of NaN behind them."""
    if not count:
        return column
    return np.concatenate((column, np.full((count, *column.shape[1:]), np.nan)))
