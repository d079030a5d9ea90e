"""Trajectories from files, told apart by their columns: TUM, CSV with named columns, Applanix as in Boreas.

TUM       rows of t x y z qx qy qz qw in seconds and map coordinates, separated by blanks.
CSV       t_ns, t_s or timestamp (its unit follows from its size), then x, y[, z] in map coordinates or lat_deg, lon_deg
          [, height_m]; attitude qx, qy, qz, qw or [roll, pitch,] yaw, or the same with _deg; optional sigma_m and
          sigma_yaw or sigma_yaw_deg. Angles and quaternions as in ``sensors``: body in map axes, in ENU with lat_deg.
Applanix  GPSTime (us of Unix time), easting, northing, altitude, roll, pitch, heading: pose of a sensor in UTM.
"""

import logging
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.datasets.map_trajectory import filled, trajectory_from_llh
from sensors.datasets.text_columns import numbers, read_table, read_text
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, map_from_llh, utm_frame
from sensors.records import Trajectory
from sensors.rotation import q_from_rpy, wrap
from sensors.screening import screen

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Placed = tuple[Trajectory, MapFrame | None]

log = logging.getLogger(__name__)

APPLANIX_ZONE = 17
"""UTM zone of an Applanix file where no UTM map frame says otherwise (Toronto, where Boreas was driven), north."""
MAX_COORDINATE = 2e7
"""Of a point on a map, m; no coordinate on earth is larger."""
_APPLANIX = ("GPSTime", "easting", "northing", "altitude", "roll", "pitch", "heading")
_TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_TIMES = {"t_ns": 1, "t_s": 10**9}
_QUATERNION = ("qx", "qy", "qz", "qw")


def read_trajectory(path: Path, map_frame: MapFrame | None) -> Placed:
    """The trajectory in map_frame, and the map frame it is in: map_frame, or one made for a geodetic or UTM file.

    None comes back where the file is in map coordinates and no frame was given. Rows that are not finite or whose
    stamps do not increase are left out with a warning.
    """
    text = read_text(path)
    first = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    if not first:
        raise EgolocError(f"{path}: expected a trajectory (TUM, CSV with named columns or Applanix), the file is empty")
    if not any(character.isalpha() and character not in "eEnNaAiIfF" for character in first):
        return _tum(path, text, map_frame)
    header, rows = read_table(path)
    if {"easting", "northing"} <= set(header):
        return _applanix(path, header, rows, map_frame)
    return _csv(path, header, rows, map_frame)


def _tum(path: Path, text: str, frame: MapFrame | None) -> Placed:
    lines = enumerate(text.splitlines(), start=1)
    rows = [(number, line.split()) for number, line in lines if line.strip() and not line.startswith("#")]
    for number, row in rows:
        if len(row) != len(_TUM):
            raise EgolocError(f"{path}: line {number}: expected the 8 columns {' '.join(_TUM)}, got {len(row)}")
    cells = [row for _, row in rows]
    values = numbers(path, _TUM, cells)
    t_ns = _exact_ns(path, "t", [row[0] for row in cells], 10**9)
    keep = _usable(path, t_ns, values, values[:, 1:4])
    return Trajectory(t_ns[keep], t_ns[keep], values[keep, 1:4], _unit(values[keep, 4:])), frame


def _csv(path: Path, header: list[str], rows: list[list[str]], frame: MapFrame | None) -> Placed:
    values = numbers(path, header, rows)
    column = {name: values[:, i] for i, name in enumerate(header)}
    t_ns = _csv_stamps(path, header, rows)
    geodetic = "lat_deg" in column
    names = ("lat_deg", "lon_deg", "height_m") if geodetic else ("x", "y", "z")
    for name in names[:2]:
        if name not in column:
            raise EgolocError(
                f"{path}: column {name}: not there; expected x, y or lat_deg, lon_deg in {', '.join(header)}"
            )
    position = np.stack([column.get(name, np.zeros(len(values))) for name in names], axis=1)
    keep = _usable(path, t_ns, position, position)
    q, sigma = _attitude(path, column), _sigma(column)
    q, sigma = (None if x is None else x[keep] for x in (q, sigma))
    t, position = t_ns[keep], position[keep]
    if not geodetic:
        return Trajectory(t, t, position, *filled(len(t), q, sigma)), frame
    llh = np.column_stack((np.radians(position[:, :2]), position[:, 2]))
    frame = frame or utm_frame(llh[0])
    return trajectory_from_llh(frame, t, llh, q, sigma), frame


def _csv_stamps(path: Path, header: list[str], rows: list[list[str]]) -> Nanoseconds:
    """Time column of a CSV, exact to the nanosecond."""
    for name, unit in _TIMES.items():
        if name in header:
            return _exact_ns(path, name, [row[header.index(name)] for row in rows], unit)
    if "timestamp" not in header:
        raise EgolocError(f"{path}: column t_ns: not there; expected t_ns, t_s or timestamp in {', '.join(header)}")
    cells = [row[header.index("timestamp")] for row in rows]
    size = abs(float(cells[0] or "nan"))
    unit = next((unit for limit, unit in ((1e17, 1), (1e14, 10**3), (1e11, 10**6)) if size >= limit), 10**9)
    return _exact_ns(path, "timestamp", cells, unit)


def _exact_ns(path: Path, name: str, cells: Sequence[str], unit_ns: int) -> Nanoseconds:
    """Decimal text to integer nanoseconds without passing through a double (which holds a date to 0.2 us)."""
    try:
        return np.array([int((Decimal(cell) * unit_ns).to_integral_value()) for cell in cells], np.int64)
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise EgolocError(f"{path}: column {name}: expected times: {error}") from error


def _attitude(path: Path, column: dict[str, Floats]) -> Floats | None:
    """(N, 4) quaternions of the attitude columns, None where there are none."""
    given = [name for name in _QUATERNION if name in column]
    if given:
        missing = [name for name in _QUATERNION if name not in column]
        if missing:
            raise EgolocError(f"{path}: column {missing[0]}: not there beside {', '.join(given)}")
        return _unit(np.stack([column[name] for name in _QUATERNION], axis=1))
    roll, pitch, yaw = (_angle(column, name) for name in ("roll", "pitch", "yaw"))
    if yaw is None:
        if roll is not None or pitch is not None:
            raise EgolocError(f"{path}: column yaw: not there beside roll and pitch")
        return None
    zero = np.zeros_like(yaw)
    angles = np.stack([zero if roll is None else roll, zero if pitch is None else pitch, yaw])
    known = np.isfinite(angles).all(axis=0)
    q = np.full((len(yaw), 4), np.nan)
    q[known] = q_from_rpy(*angles[:, known])
    return q


def _unit(q: Floats) -> Floats:
    """(N, 4) quaternions of unit length; NaN where they are no rotation (zeros)."""
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(norm > 0.5, q / np.where(norm > 0.5, norm, 1.0), np.nan)


def _angle(column: dict[str, Floats], name: str) -> Floats | None:
    if f"{name}_deg" in column:
        return np.radians(column[f"{name}_deg"])
    return column.get(name)


def _sigma(column: dict[str, Floats]) -> Floats | None:
    position, yaw = column.get("sigma_m"), _angle(column, "sigma_yaw")
    if position is None and yaw is None:
        return None
    known = position if position is not None else yaw
    assert known is not None
    unknown = np.full(len(known), np.nan)
    return np.stack((unknown if position is None else position, unknown if yaw is None else yaw), axis=1)


def _applanix(path: Path, header: list[str], rows: list[list[str]], frame: MapFrame | None) -> Placed:
    """Boreas' *_poses.csv, angles as the drive itself shows them: R_map_body = Rz(turn - heading) Ry(pitch) Rx(-roll).

    Pitch is minus the slope of the track (gain 1.00, so it is positive nose down, in car axes); heading counts
    clockwise with the sensor's own constant turn against the direction of travel, which the track gives; roll is
    positive left side down (the body leans out of its turns).
    """
    missing = [name for name in _APPLANIX if name not in header]
    if missing:
        raise EgolocError(f"{path}: column {missing[0]}: not there beside easting, northing")
    values = numbers(path, header, rows)
    t_ns = _exact_ns(path, "GPSTime", [row[header.index("GPSTime")] for row in rows], 1000)
    chosen = values[:, [header.index(name) for name in _APPLANIX]]
    keep = _usable(path, t_ns, chosen, chosen[:, 1:4])
    t, utm = t_ns[keep], chosen[keep, 1:4]
    roll, pitch, heading = chosen[keep, 4:7].T
    q = q_from_rpy(-roll, pitch, _turn_to_travel(t, utm, heading) - heading)
    if frame is None:
        frame = MapFrame("utm", (float(utm[0, 0] // 1000 * 1000), float(utm[0, 1] // 1000 * 1000), 0.0), APPLANIX_ZONE)
    if frame.kind == "utm":
        p_map = utm - frame.origin
    else:
        p_map = map_from_llh(frame, llh_from_map(MapFrame("utm", zone=APPLANIX_ZONE), utm))
    return Trajectory(t, t, p_map, q), frame


def _turn_to_travel(t_ns: Nanoseconds, p: Floats, heading: Floats) -> float:
    """Median of course plus heading, rad: constant where heading counts clockwise; 0 for a track that stands."""
    velocity = np.gradient(p, (t_ns - t_ns[0]) * 1e-9, axis=0)
    fast = np.hypot(velocity[:, 0], velocity[:, 1]) > 3.0
    if fast.sum() < 10:
        return 0.0
    turn = np.arctan2(velocity[fast, 1], velocity[fast, 0]) + heading[fast]
    middle = np.angle(np.exp(1j * turn).mean())
    return float(middle + np.median(wrap(turn - middle)))


def _usable(path: Path, t_ns: Nanoseconds, values: Floats, position: Floats) -> NDArray[np.bool_]:
    """Finite rows on earth with increasing stamps; what is left out is logged."""
    checks = {
        "not finite": np.all(np.isfinite(values), axis=1),
        f"position beyond {MAX_COORDINATE:g}": np.all(np.abs(position) <= MAX_COORDINATE, axis=1),
    }
    keep, left_out = screen(path.name, t_ns, t_ns, checks)
    for rows in left_out:
        log.warning("%s: %d rows left out: %s", path, rows.count, rows.reason)
    if not keep.any():
        raise EgolocError(f"{path}: no usable row of {len(keep)}")
    return keep
