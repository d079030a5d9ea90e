"""The columns of decisions.parquet: what became of each measurement, and where fixes lay against the reference."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.result import Decisions, Reason, Sensor
from replay.hiding import Rows
from replay.references import Reference, errors, evaluated_only, lever, sample
from sensors.clock import NS_PER_S
from sensors.geodesy import MapFrame, map_from_llh, rotation_map_enu
from sensors.records import GnssFix, GnssStatus, Log, PoseFix
from sensors.rotation import wrap

Floats = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

APPLIED = (Reason.ACCEPTED, Reason.PARTLY_ACCEPTED, Reason.USED_FOR_ALIGNMENT)
FIX_COLUMNS = ("x", "y", "z", "yaw", "err_lon", "err_lat", "err_yaw")


def decision_columns(
    decisions: Decisions, log: Log, frame: MapFrame, reference: Reference | None, rows: Mapping[Sensor, Rows]
) -> Columns:
    """The columns of decisions.parquet. log: as the filter got it; rows: where thinned records kept the original's."""
    columns: Columns = {
        "t_ns": decisions.t_ns,
        "arrival_ns": decisions.arrival_ns,
        "sensor": decisions.sensor.astype(np.int8),
        "row": _original_rows(decisions, rows),
        "reason": decisions.reason.astype(np.int8),
        "accepted": np.isin(decisions.reason, APPLIED),
    }
    for name in ("innovation", "innovation_sigma"):
        columns |= {f"{name}_{i}": column.astype(np.float32) for i, column in enumerate(getattr(decisions, name).T)}
    columns |= {
        name: getattr(decisions, name).astype(np.float32) for name in ("nis", "threshold", "moved_m", "moved_yaw")
    }
    columns["dof"] = decisions.dof.astype(np.int8)
    measured: Columns = {name: np.full(len(decisions.t_ns), np.nan) for name in FIX_COLUMNS}
    measured["status"] = np.full(len(decisions.t_ns), -1, np.int8)
    for sensor, fixes in _fixes(log, frame, reference).items():
        here = np.flatnonzero(decisions.sensor == sensor)
        for name, column in fixes.items():
            measured[name][here] = column[decisions.row[here]]
    return columns | measured


def _fixes(log: Log, frame: MapFrame, reference: Reference | None) -> dict[Sensor, Columns]:
    """Measured points of GNSS and pose fixes in map coordinates, with their errors, one row per row of the record."""
    fixes = {}
    if log.gnss is not None:
        hidden = reference is not None and reference.stretches is not None  # its own fixes are the reference
        fixes[Sensor.GNSS_POSITION] = gnss_columns(log.gnss, log, frame, None if hidden else reference)
    if log.pose_fixes is not None:
        fixes[Sensor.POSE_FIX] = pose_columns(log.pose_fixes, log, reference)
    return fixes


def gnss_columns(gnss: GnssFix, log: Log, frame: MapFrame, reference: Reference | None) -> Columns:
    """Antenna positions (map m), yaw (map axes) and errors of GNSS fixes; a fix of status none has neither."""
    p_map = map_from_llh(frame, gnss.llh)
    yaw = gnss.yaw
    if np.isfinite(yaw).any():
        R_map_enu, _ = rotation_map_enu(frame, gnss.llh)
        yaw = wrap(yaw + np.arctan2(R_map_enu[:, 1, 0], R_map_enu[:, 0, 0]))
    t_ns = gnss.t_ns - round(log.vehicle.gnss_delay_s * NS_PER_S)
    columns = _fix_columns(t_ns, p_map, yaw, log.vehicle.gnss_lever_arm, reference)
    for name in ("err_lon", "err_lat", "err_yaw"):
        columns[name] = np.where(gnss.status > GnssStatus.NONE, columns[name], np.nan)
    return columns | {"z": p_map[:, 2], "status": gnss.status}


def pose_columns(fixes: PoseFix, log: Log, reference: Reference | None) -> Columns:
    """Points, yaw and errors of pose fixes, map axes."""
    return _fix_columns(fixes.t_ns, fixes.pose[:, :2], fixes.pose[:, 2], log.vehicle.pose_lever_arm, reference)


def _fix_columns(
    t_ns: NDArray[np.int64], p_map: Floats, yaw: Floats, point: ArrayLike, reference: Reference | None
) -> Columns:
    """Measured points (N, 2 or 3) and yaw (N,), and their errors against the reference at that point of the body."""
    lon = lat = err_yaw = np.full(len(t_ns), np.nan)
    if reference is not None:
        samples = sample(reference.trajectory, t_ns)
        arm = lever(samples, np.asarray(point) - np.asarray(reference.point))
        lon, lat = errors(samples, p_map[:, :2] - (samples.p_map + arm)[:, :2]).T
        if samples.has_heading:
            err_yaw = evaluated_only(samples, wrap(yaw - samples.heading))
    return {"x": p_map[:, 0], "y": p_map[:, 1], "yaw": yaw, "err_lon": lon, "err_lat": lat, "err_yaw": err_yaw}


def _original_rows(decisions: Decisions, rows: Mapping[Sensor, Rows]) -> NDArray[np.int64]:
    """Row numbers of the records as the log holds them."""
    original = decisions.row.astype(np.int64)
    for sensor, kept in rows.items():
        here = decisions.sensor == sensor
        original[here] = kept[original[here]]
    return original
