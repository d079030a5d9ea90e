"""The columns of decisions.parquet: what became of each measurement, and where fixes lay against the reference."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.result import Decisions, Reason, Sensor
from replay.references import Samples, errors, evaluated_only, lever
from sensors.geodesy import MapFrame, map_from_llh, rotation_map_enu
from sensors.records import GnssFix, GnssStatus, Log, PoseFix
from sensors.rotation import wrap
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Columns = dict[str, NDArray[Any]]
Point = tuple[float, float, float]

APPLIED = (Reason.ACCEPTED, Reason.PARTLY_ACCEPTED, Reason.MODES_AGREE, Reason.USED_FOR_ALIGNMENT)
FIXES = (Sensor.GNSS_POSITION, Sensor.POSE_FIX)
"""Measurements of a point in the map."""
_IS_APPLIED = np.isin(np.arange(len(Reason)), APPLIED)
ERRORS = ("err_lon", "err_lat", "err_yaw")
_MEASURED = ("x", "y", "z", "yaw", *ERRORS)


def decision_columns(
    decisions: Decisions, rows: Rows, measured: Mapping[Sensor, Columns], *, all_columns: bool = True
) -> Columns:
    """The columns of decisions.parquet; all_columns: not only those that scoring reads.

    rows: (M,) of the records as the log holds them; measured: what ``gnss_columns`` and ``pose_columns`` say of the
    FIXES, one row per decision on one.
    """
    columns: Columns = {
        "t_ns": decisions.t_ns,
        "arrival_ns": decisions.arrival_ns,
        "sensor": decisions.sensor.astype(np.int8),
        "row": rows,
        "reason": decisions.reason.astype(np.int8),
        "accepted": _IS_APPLIED[decisions.reason],
    }
    if all_columns:
        columns |= _tests_of(decisions)
    spread: Columns = {name: np.full(len(rows), np.nan) for name in (_MEASURED if all_columns else ERRORS)}
    spread["status"] = np.full(len(rows), -1, np.int8)
    for sensor, fixes in measured.items():
        here = np.flatnonzero(decisions.sensor == sensor)
        for name in spread.keys() & fixes.keys():
            spread[name][here] = fixes[name]
    return columns | spread


def no_rows() -> Columns:
    """The columns of decisions.parquet, without a row."""
    t_ns, codes, one, three = np.empty(0, np.int64), np.empty(0, np.int8), np.empty(0), np.empty((0, 3))
    none = Decisions(t_ns, t_ns, codes, t_ns, codes, three, three, one, one, codes, one, one, one)
    return decision_columns(none, t_ns, {})


def _tests_of(decisions: Decisions) -> Columns:
    """Innovations and how they were judged."""
    columns: Columns = {}
    for name in ("innovation", "innovation_sigma"):
        columns |= {f"{name}_{i}": column.astype(np.float32) for i, column in enumerate(getattr(decisions, name).T)}
    for name in ("nis", "threshold", "moved_m", "moved_yaw", "weight"):
        columns[name] = getattr(decisions, name).astype(np.float32)
    return columns | {"dof": decisions.dof.astype(np.int8)}


class Fixes:
    """GNSS and pose fixes of a drive until a decision on each has been taken: decisions name them by row."""

    def __init__(self) -> None:
        self._waiting = {Sensor.GNSS_POSITION: _Waiting("llh", "yaw", "status"), Sensor.POSE_FIX: _Waiting("pose")}

    def add(self, piece: Log) -> None:
        """Take the fixes of the next piece, as the filter gets it."""
        for sensor, record in ((Sensor.GNSS_POSITION, piece.gnss), (Sensor.POSE_FIX, piece.pose_fixes)):
            if record is not None:
                self._waiting[sensor].add(record)

    def take(self, sensor: Sensor, rows: Rows) -> Columns:
        """Columns of rows (M,) of the drive's record, each asked for once."""
        return self._waiting[sensor].take(rows)


class _Waiting:
    """Columns of the rows of one record that nobody has asked for."""

    def __init__(self, *names: str) -> None:
        self._names, self._first = names, 0
        self._columns: Columns = {}
        self._asked = np.empty(0, np.bool_)

    def add(self, record: GnssFix | PoseFix) -> None:
        new = {name: getattr(record, name) for name in self._names}
        held = len(self._asked) > 0
        self._columns = {name: np.concatenate((self._columns[name], new[name])) for name in new} if held else new
        self._asked = np.concatenate((self._asked, np.zeros(len(record), np.bool_)))

    def take(self, rows: Rows) -> Columns:
        local = rows - self._first
        taken = {name: column[local] for name, column in self._columns.items()}
        self._asked[local] = True
        done = len(self._asked) if self._asked.all() else int(np.argmin(self._asked))
        self._columns = {name: column[done:] for name, column in self._columns.items()}
        self._asked = self._asked[done:]
        self._first += done
        return taken


def gnss_columns(fixes: Columns, vehicle: Vehicle, frame: MapFrame, samples: Samples | None, point: Point) -> Columns:
    """Antenna positions (map m), yaw (map axes) and errors of GNSS fixes; a fix of status none has neither.

    samples: the reference when the fixes were true, of the body's point; None: nothing to compare with.
    """
    p_map = map_from_llh(frame, fixes["llh"])
    yaw, status = fixes["yaw"], fixes["status"]
    if np.isfinite(yaw).any():
        R_map_enu, _ = rotation_map_enu(frame, fixes["llh"])
        yaw = wrap(yaw + np.arctan2(R_map_enu[:, 1, 0], R_map_enu[:, 0, 0]))
    columns = _fix_columns(p_map, yaw, vehicle.gnss_lever_arm, samples, point)
    for name in ERRORS:
        columns[name] = np.where(status > GnssStatus.NONE, columns[name], np.nan)
    return columns | {"z": p_map[:, 2], "status": status}


def pose_columns(fixes: Columns, vehicle: Vehicle, samples: Samples | None, point: Point) -> Columns:
    """Points, yaw and errors of pose fixes, map axes."""
    pose = fixes["pose"]
    return _fix_columns(pose[:, :2], pose[:, 2], vehicle.pose_lever_arm, samples, point)


def _fix_columns(p_map: Floats, yaw: Floats, measured: ArrayLike, samples: Samples | None, point: Point) -> Columns:
    """Measured points (N, 2 or 3) and yaw (N,), and their errors against the reference at that point of the body."""
    lon = lat = err_yaw = np.full(len(p_map), np.nan)
    if samples is not None:
        arm = lever(samples, np.asarray(measured, np.float64) - np.asarray(point))
        lon, lat = errors(samples, p_map[:, :2] - (samples.p_map + arm)[:, :2]).T
        if samples.has_heading:
            err_yaw = evaluated_only(samples, wrap(yaw - samples.heading))
    return {"x": p_map[:, 0], "y": p_map[:, 1], "yaw": yaw, "err_lon": lon, "err_lat": lat, "err_yaw": err_yaw}
