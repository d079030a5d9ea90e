"""NovAtel OEM7 ASCII logs of a SPAN receiver, e.g. the PwrPak7D-E1: BESTPOSA, BESTVELA, RAWIMUSXA and INSPVAXA.

Positions come from BESTGNSSPOSA where it is logged, else from BESTPOSA, which is fused with the INS once it has
aligned. Heights above mean sea level plus undulation give the ellipsoid's. IMU counts are increments over the
interval that ends at the stamp, in the order Z, -Y, X of the IMU body frame (x right, y forward, z up when mounted
along the vehicle). Source: OEM7 Commands and Logs Reference Manual; SPAN reference frames.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.clock import utc_from_gps_week
from sensors.datasets.map_trajectory import q_from_aerospace, trajectory_from_llh
from sensors.datasets.novatel_imu import RAW_SCALES, TYPE_BY_NAME, RawScale, imu_spec
from sensors.datasets.novatel_lines import Lines, parse
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, utm_frame
from sensors.records import GnssFix, GnssStatus, GnssVelocity, Imu, LeftOut, Log, Trajectory
from sensors.rotation import wrap
from sensors.screening import screen
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Left = tuple[LeftOut, ...]

IMU_LOGS = {"RAWIMUSXA": 11, "RAWIMUXA": 11, "RAWIMUSA": 9, "RAWIMUA": 9}
HEADING_LOGS = ("DUALANTENNAHEADINGA", "HEADING2A")
LEAST_FIELDS = IMU_LOGS | {
    "BESTPOSA": 10,
    "BESTGNSSPOSA": 10,
    "BESTVELA": 7,
    "BESTGNSSVELA": 7,
    "INSPVAXA": 21,
    "DUALANTENNAHEADINGA": 8,
    "HEADING2A": 8,
    "INSCONFIGA": 1,
}
STATUS = {
    **dict.fromkeys(("NARROW_INT", "WIDE_INT", "L1_INT", "RTK_DIRECT_INS", "INS_RTKFIXED"), GnssStatus.FIXED),
    **dict.fromkeys(("NARROW_FLOAT", "L1_FLOAT", "IONOFREE_FLOAT", "INS_RTKFLOAT"), GnssStatus.FLOAT),
    **dict.fromkeys(("PPP", "PPP_CONVERGING", "INS_PPP", "INS_PPP_CONVERGING"), GnssStatus.FLOAT),
    **dict.fromkeys(("PSRDIFF", "WAAS", "SBAS", "OMNISTAR", "CDGPS", "INS_PSRDIFF", "INS_SBAS"), GnssStatus.DGNSS),
    **dict.fromkeys(("PPP_BASIC", "PPP_BASIC_CONVERGING", "INS_PPP_BASIC"), GnssStatus.DGNSS),
    **dict.fromkeys(("SINGLE", "INS_PSRSP", "PROPAGATED"), GnssStatus.SINGLE),
}
"""Position type -> quality. Types that are not GNSS at all (NONE, FIXEDPOS, DOPPLER_VELOCITY, INS) are left out."""
GOOD_INS = ("INS_SOLUTION_GOOD", "INS_ALIGNMENT_COMPLETE", "INS_SOLUTION_FREE")
VELOCITY_SIGMA = (0.05, 0.05, 0.1)
"""BESTVEL reports no accuracy; the receiver's specification is 0.03 m/s rms, east, north, up."""


def load(src: Path) -> Log:
    """Log of an ASCII log file."""
    if src.is_dir():
        raise EgolocError(f"{src}: expected an ASCII log file, got a folder")
    with src.open("rb") as file:
        lines = parse(file, LEAST_FIELDS)
    if not lines.bodies:
        wanted = ", ".join(("BESTPOSA", "BESTVELA", "RAWIMUSXA", "INSPVAXA"))
        bad = sum(lines.rejected.values())
        raise EgolocError(f"{src}: expected NovAtel ASCII logs such as {wanted}, got none ({bad} bad lines)")
    gnss, gnss_left = _positions(lines)
    velocity, velocity_left = _velocities(lines)
    imu, scale, imu_left = _imu(src, lines)
    frame = _frame(lines, gnss)
    reference, reference_left = _reference(lines, frame)
    vehicle = Vehicle() if scale is None else Vehicle(imu=imu_spec(scale))
    bad_lines = tuple(LeftOut(src.name, reason, count) for reason, count in lines.rejected.items())
    left_out = (*bad_lines, *imu_left, *gnss_left, *velocity_left, *reference_left)
    return Log(imu, gnss, velocity, None, None, reference, vehicle, frame, left_out)


def _first(lines: Lines, names: tuple[str, ...]) -> tuple[str, list[tuple[int, float, list[str]]]]:
    """The first of these logs that the file holds."""
    for name in names:
        if rows := lines.bodies.get(name):
            return name, rows
    return names[0], []


def _stamps(rows: list[tuple[int, float, list[str]]]) -> Nanoseconds:
    return utc_from_gps_week(np.array([row[0] for row in rows]), np.array([row[1] for row in rows]))


def _numbers(rows: list[tuple[int, float, list[str]]], columns: slice) -> Floats:
    """(N, C) numbers of the bodies; what is no number is NaN and screened out later."""
    return np.array([[_number(cell) for cell in row[2][columns]] for row in rows])


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _positions(lines: Lines) -> tuple[GnssFix | None, Left]:
    name, rows = _first(lines, ("BESTGNSSPOSA", "BESTPOSA"))
    if not rows:
        return None, ()
    t_ns = _stamps(rows)
    lat, lon, height, undulation = _numbers(rows, slice(2, 6)).T
    sigma = _numbers(rows, slice(7, 10))
    status = np.array([STATUS.get(row[2][1], GnssStatus.NONE) for row in rows], np.int8)
    checks = {
        "solution not computed": np.array([row[2][0] == "SOL_COMPUTED" for row in rows]),
        "position type is not GNSS": status > GnssStatus.NONE,
        "not finite": np.all(np.isfinite(np.column_stack((lat, lon, height, undulation, sigma))), axis=1),
        "sigma is not positive": np.all(sigma > 0, axis=1),
    }
    keep, left_out = screen(name, t_ns, t_ns, checks)
    if not keep.any():
        return None, left_out
    t = t_ns[keep]
    llh = np.stack((np.radians(lat), np.radians(lon), height + undulation), axis=1)[keep]
    cov = np.eye(3) * (sigma[keep][:, [1, 0, 2], None] ** 2)
    yaw, yaw_sigma = _headings(lines, t)
    return GnssFix(t, t, llh, cov, status[keep], yaw, yaw_sigma), left_out


def _headings(lines: Lines, t_ns: Nanoseconds) -> tuple[Floats, Floats]:
    """Dual-antenna yaw at the fixes of the same stamp, NaN elsewhere; the second antenna is taken to lie straight
    ahead."""
    yaw, sigma = np.full(len(t_ns), np.nan), np.full(len(t_ns), np.nan)
    _, rows = _first(lines, HEADING_LOGS)
    rows = [row for row in rows if row[2][0] == "SOL_COMPUTED"]
    if not rows:
        return yaw, sigma
    heading, spread = _numbers(rows, slice(3, 4))[:, 0], _numbers(rows, slice(6, 7))[:, 0]
    good = np.isfinite(heading) & (spread > 0)
    _, fix, row = np.intersect1d(t_ns, _stamps(rows)[good], return_indices=True)
    yaw[fix] = wrap(np.pi / 2 - np.radians(heading[good][row]))
    sigma[fix] = np.radians(spread[good][row])
    return yaw, sigma


def _velocities(lines: Lines) -> tuple[GnssVelocity | None, Left]:
    """Velocities at the time that they were true: the header's less the latency."""
    name, rows = _first(lines, ("BESTGNSSVELA", "BESTVELA"))
    if not rows:
        return None, ()
    latency, _, speed, track, up = _numbers(rows, slice(2, 7)).T
    arrival = _stamps(rows)
    t_ns = arrival - np.rint(np.nan_to_num(latency) * 1e9).astype(np.int64)
    course = np.radians(track)
    vel = np.stack((speed * np.sin(course), speed * np.cos(course), up), axis=1)
    checks = {
        "solution not computed": np.array([row[2][0] == "SOL_COMPUTED" for row in rows]),
        "not finite": np.all(np.isfinite(np.column_stack((vel, latency))), axis=1),
    }
    keep, left_out = screen(name, t_ns, arrival, checks)
    if not keep.any():
        return None, left_out
    cov = np.tile(np.diag(np.square(VELOCITY_SIGMA)), (int(keep.sum()), 1, 1))
    return GnssVelocity(t_ns[keep], arrival[keep], vel[keep], cov), left_out


def _imu(src: Path, lines: Lines) -> tuple[Imu | None, RawScale | None, Left]:
    """Increments times the IMU's rate, in FLU: x = Y, y = -X, z = Z of the IMU body frame."""
    name, rows = _first(lines, tuple(IMU_LOGS))
    if not rows:
        return None, None, ()
    skip = IMU_LOGS[name] - 9
    scale = _scale(src, name, lines, rows)
    values = _numbers(rows, slice(skip, skip + 9))
    t_ns = utc_from_gps_week(np.nan_to_num(values[:, 0]).astype(np.int64), np.nan_to_num(values[:, 1]))
    counts = _numbers(rows, slice(skip + 3, skip + 9))
    checks = {"not finite": np.all(np.isfinite(np.column_stack((values[:, :2], counts))), axis=1)}
    keep, left_out = screen(name, t_ns, _stamps(rows), checks)
    if not keep.any():
        return None, None, left_out
    accel, gyro = (_flu(counts[keep, part]) for part in (slice(0, 3), slice(3, 6)))
    t = t_ns[keep]
    return Imu(t, t, gyro * scale.gyro * scale.rate_hz, accel * scale.accel * scale.rate_hz), scale, left_out


def _flu(counts: Floats) -> Floats:
    z, minus_y, x = counts.T
    return np.stack((-minus_y, -x, z), axis=1)


def _scale(src: Path, name: str, lines: Lines, rows: list[tuple[int, float, list[str]]]) -> RawScale:
    """Scale by the IMU type of RAWIMU(S)X, else of INSCONFIG."""
    if IMU_LOGS[name] == 11:
        types = {int(row[2][1]) for row in rows if row[2][1].isdigit()}
    else:
        types = {TYPE_BY_NAME[c[2][0]] for c in lines.bodies.get("INSCONFIGA", []) if c[2][0] in TYPE_BY_NAME}
    if not types:
        raise EgolocError(f"{src}: {name}: IMU type unknown: expected RAWIMUSXA, or INSCONFIGA beside {name}")
    if len(types) > 1 or not types <= RAW_SCALES.keys():
        known = ", ".join(str(t) for t in RAW_SCALES)
        raise EgolocError(f"{src}: {name}: IMU type: expected one of {known}, got {', '.join(map(str, sorted(types)))}")
    return RAW_SCALES[types.pop()]


def _frame(lines: Lines, gnss: GnssFix | None) -> MapFrame | None:
    if gnss is not None:
        return utm_frame(gnss.llh[0])
    rows = lines.bodies.get("INSPVAXA", [])
    for lat, lon in _numbers(rows, slice(2, 4)) if rows else []:
        if np.isfinite(lat) and np.isfinite(lon):
            return utm_frame([np.radians(lat), np.radians(lon), 0.0])
    return None


def _reference(lines: Lines, frame: MapFrame | None) -> tuple[Trajectory | None, Left]:
    """The receiver's own GNSS and INS solution, at the IMU."""
    rows = lines.bodies.get("INSPVAXA", [])
    if not rows or frame is None:
        return None, ()
    t_ns, v = _stamps(rows), _numbers(rows, slice(2, 21))
    checks = {
        "INS is not aligned": np.array([row[2][0] in GOOD_INS for row in rows]),
        "not finite": np.all(np.isfinite(v[:, :19]), axis=1),
    }
    keep, left_out = screen("INSPVAXA", t_ns, t_ns, checks)
    if not keep.any():
        return None, left_out
    v = v[keep]
    llh = np.stack((np.radians(v[:, 0]), np.radians(v[:, 1]), v[:, 2] + v[:, 3]), axis=1)
    q = q_from_aerospace(*np.radians(v[:, 7:10]).T)
    sigma = np.stack((np.sqrt((v[:, 10] ** 2 + v[:, 11] ** 2) / 2), np.radians(v[:, 18])), axis=1)
    return trajectory_from_llh(frame, t_ns[keep], llh, q, sigma), left_out
