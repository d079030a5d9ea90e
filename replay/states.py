"""The columns of states.parquet: states in map coordinates beside the reference, with their errors.

Everything that scoring needs stands in these columns, so that a run can be scored again without its log. States are
compared at the body's origin. Where the reference has no attitude of its own, it is brought there from its point (an
antenna) by the estimate's attitude, which is the same as comparing at that point.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.result import Health, States
from replay._kernels import axis_sigmas, turn_states
from replay.health import LEVELS
from replay.hiding import Stretches, stretch_index
from replay.references import Samples, errors, evaluated_only, lever, only
from sensors.geodesy import MapFrame, map_from_llh, rotation_map_enu
from sensors.rotation import wrap

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Columns = dict[str, NDArray[Any]]

_FIRST = int(Health.INITIALIZING)
"""First of the codes: no cause, and no sensor seen, in the other columns."""


def state_columns(
    states: States,
    missing: Nanoseconds,
    frame: MapFrame,
    samples: Samples,
    point: tuple[float, float, float],
    first_ns: int,
    stretches: Stretches | None,
) -> Columns:
    """The columns of states.parquet: one row per state and per epoch without one (missing (M,): NaN, initializing and
    no sensor seen there), in order.

    samples: the reference at all these times, in order, of the body's point (m) and from first_ns on; stretches: the
    only times that are scored, None: all.
    """
    estimate, R_map_body, pose_cov = _map_columns(states, frame)
    if len(missing):
        order = np.argsort(np.concatenate((states.t_ns, missing)), kind="stable")
        spread = {name: _append(column, len(missing))[order] for name, column in estimate.items()}
        R_map_body, pose_cov = (_append(a, len(missing))[order] for a in (R_map_body, pose_cov))
    else:
        spread = estimate
    compared = _compare(spread, R_map_body, pose_cov, samples, np.asarray(point, np.float64), first_ns, stretches)
    return {"t_ns": samples.t_ns, **spread, "pose_cov": pose_cov.reshape(len(pose_cov), 36), **compared}


def _map_columns(states: States, frame: MapFrame) -> tuple[Columns, Floats, Floats]:
    """State columns in map axes, R_map_body (N, 3, 3) and the pose covariance (N, 6, 6): x, y, z, rotation x, y, z."""
    p_map = map_from_llh(frame, states.llh)
    R_map_enu, scale = rotation_map_enu(frame, states.llh)
    R, cov = turn_states(R_map_enu, scale, states.q_enu_body, states.pose_cov)
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
    columns |= {"health": states.health, "health_cause": states.cause}
    columns |= dict(zip(LEVELS, states.levels.T, strict=True))
    return columns, R, cov


def _compare(
    estimate: Columns,
    R_map_body: Floats,
    cov: Floats,
    samples: Samples,
    point: Floats,
    first_ns: int,
    stretches: Stretches | None,
) -> Columns:
    """Reference, error and sigma columns of the states."""
    t_ns = samples.t_ns
    stretch = np.full(len(t_ns), -1, np.int32)
    if stretches is not None:
        stretch = stretch_index(t_ns, stretches)
        samples = only(samples, stretch >= 0)
    p_map = np.stack([estimate[axis] for axis in "xyz"], axis=-1)
    ref_body = samples.p_map - lever(samples, point, R_map_body)
    ref_yaw = samples.heading if samples.has_heading else np.full(len(t_ns), np.nan)
    lon, lat = errors(samples, p_map - ref_body).T
    arm = R_map_body @ (np.zeros(3) if samples.has_heading else point)
    arm[t_ns < first_ns] = 0.0
    heading = np.where(np.isfinite(samples.heading), samples.heading, estimate["yaw"])
    sigma_lon, sigma_lat = axis_sigmas(cov, arm, heading)
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


def _append(column: NDArray[Any], count: int) -> NDArray[Any]:
    """The rows, and count rows of NaN, of codes the first, behind them."""
    fill = np.nan if column.dtype.kind == "f" else _FIRST
    return np.concatenate((column, np.full((count, *column.shape[1:]), fill, column.dtype)))
