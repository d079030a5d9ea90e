"""RTKLIB solution text (.pos, latitude/longitude/height): positions, velocities, their covariances and quality.

Source: RTKLIB manual, solution file; Q and the signed square roots of covariances as in solution.c.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.clock import GPS_EPOCH_NS, WEEK_NS, utc_from_gps
from sensors.datasets.text_columns import read_text
from sensors.errors import EgolocError
from sensors.records import GnssFix, GnssStatus, GnssVelocity, LeftOut, positive_definite
from sensors.screening import screen

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

QUALITY = {
    1: GnssStatus.FIXED,
    2: GnssStatus.FLOAT,
    3: GnssStatus.DGNSS,
    4: GnssStatus.DGNSS,
    5: GnssStatus.SINGLE,
    6: GnssStatus.FLOAT,
}
"""Q: 1 fixed, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP (decimetres: as float)."""

_NEEDED = (
    "latitude(deg)",
    "longitude(deg)",
    "height(m)",
    "Q",
    "sdn(m)",
    "sde(m)",
    "sdu(m)",
    "sdne(m)",
    "sdeu(m)",
    "sdun(m)",
)
_VELOCITY = ("vn(m/s)", "ve(m/s)", "vu(m/s)", "sdvn", "sdve", "sdvu", "sdvne", "sdveu", "sdvun")


def read_solution(path: Path) -> tuple[GnssFix, GnssVelocity, tuple[LeftOut, ...]]:
    """GNSS positions and velocities (none where the file has no velocity columns) of an RTKLIB .pos file in llh."""
    names, gps, rows = _solution_rows(path)
    t_ns = _stamps(path, rows, gps)
    values = _solution_values(path, rows, len(names))
    column = {name: values[:, i] for i, name in enumerate(names)}
    llh = np.stack((np.radians(column[_NEEDED[0]]), np.radians(column[_NEEDED[1]]), column[_NEEDED[2]]), axis=1)
    cov = signed_covariance(*(column[name] for name in _NEEDED[4:]))
    quality = np.nan_to_num(column["Q"]).astype(np.int64)
    status = np.array([QUALITY.get(int(q), GnssStatus.NONE) for q in quality], np.int8)
    checks = {
        "position is not finite": np.all(np.isfinite(llh), axis=1),
        "no solution (Q)": status > GnssStatus.NONE,
        "covariance is not positive definite": positive_definite(cov),
    }
    keep, left_out = screen(path.name, t_ns, t_ns, checks)
    if not keep.any():
        raise EgolocError(f"{path}: no usable position in {len(rows)} rows")
    fixes = GnssFix(t_ns[keep], t_ns[keep], llh[keep], cov[keep], status[keep])
    velocity, velocity_left = _velocities(path, t_ns, column, keep)
    return fixes, velocity, (*left_out, *velocity_left)


def _velocities(
    path: Path, t_ns: Nanoseconds, column: dict[str, Floats], keep: NDArray[np.bool_]
) -> tuple[GnssVelocity, tuple[LeftOut, ...]]:
    """Velocities of the rows that are kept."""
    if not all(name in column for name in _VELOCITY):
        empty = np.empty(0, np.int64)
        return GnssVelocity(empty, empty, np.empty((0, 3)), np.empty((0, 3, 3))), ()
    vel = np.stack([column[name] for name in ("ve(m/s)", "vn(m/s)", "vu(m/s)")], axis=1)
    cov = signed_covariance(*(column[name] for name in _VELOCITY[3:]))
    good, left_out = screen(
        f"{path.name} velocity",
        t_ns[keep],
        t_ns[keep],
        {
            "not finite": np.all(np.isfinite(vel[keep]), axis=1),
            "covariance is not positive definite": positive_definite(cov[keep]),
        },
    )
    return GnssVelocity(t_ns[keep][good], t_ns[keep][good], vel[keep][good], cov[keep][good]), left_out


def signed_covariance(sdn: Floats, sde: Floats, sdu: Floats, sdne: Floats, sdeu: Floats, sdun: Floats) -> Floats:
    """(N, 3, 3) ENU covariance of RTKLIB's sigmas; the mixed ones are signed square roots of covariances."""
    n, e, u = sdn**2, sde**2, sdu**2
    ne, eu, un = (np.sign(s) * s**2 for s in (sdne, sdeu, sdun))
    return np.stack([np.stack(row, axis=-1) for row in ((e, ne, eu), (ne, n, un), (eu, un, u))], axis=-2)


def _solution_rows(path: Path) -> tuple[list[str], bool, list[list[str]]]:
    """Column names after the two of time, whether time is GPST, and the rows of cells."""
    lines = read_text(path).splitlines()
    headers = [line for line in lines if line.startswith("%") and "latitude(deg)" in line]
    if not headers:
        raise EgolocError(f"{path}: expected an RTKLIB header line with latitude(deg), got none")
    words = re.split(r"[,\s]+", headers[-1].lstrip("% ").strip())
    clock, names = words[0], words[1:]
    if clock not in ("GPST", "UTC"):
        raise EgolocError(f"{path}: time: expected GPST or UTC in the header, got {clock}")
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise EgolocError(f"{path}: column {missing[0]}: not in the header")
    rows = [re.split(r"[,\s]+", line.strip()) for line in lines if line.strip() and not line.startswith("%")]
    if not rows:
        raise EgolocError(f"{path}: no solution rows")
    return names, clock == "GPST", rows


def _stamps(path: Path, rows: list[list[str]], gps: bool) -> Nanoseconds:
    """UTC of calendar (2025/07/08 19:34:18.499) or week and second stamps."""
    try:
        if "/" in rows[0][0]:
            text = [f"{row[0].replace('/', '-')}T{row[1]}" for row in rows]
            since_1970 = np.array(text, "datetime64[ns]").astype(np.int64)
        else:
            week = np.array([int(row[0]) for row in rows], np.int64)
            milli = np.array([round(float(row[1]) * 1e3) for row in rows], np.int64)
            since_1970 = GPS_EPOCH_NS + week * WEEK_NS + milli * 1_000_000
    except (ValueError, IndexError) as error:
        raise EgolocError(f"{path}: time: expected yyyy/mm/dd hh:mm:ss.sss or week and seconds: {error}") from error
    return utc_from_gps(since_1970 - GPS_EPOCH_NS) if gps else since_1970


def _solution_values(path: Path, rows: list[list[str]], width: int) -> Floats:
    for number, row in enumerate(rows, start=1):
        if len(row) != width + 2:
            raise EgolocError(f"{path}: solution row {number}: expected {width + 2} columns, got {len(row)}")
    try:
        return np.array([row[2:] for row in rows], np.float64)
    except ValueError as error:
        raise EgolocError(f"{path}: expected numbers: {error}") from error
