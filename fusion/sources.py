"""Measurements of a log as the kernel reads them: stamps corrected by delays, effective covariances, one sorted list.

Whatever waits for the IMU waits as ``Sources``: they can be joined and split.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.events import Measurements
from fusion.linearized import linearize, raise_to, turn_into_enu
from fusion.modes import spread_of
from fusion.result import Reason, Sensor
from fusion.state import Floats
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, rotation_map_enu
from sensors.records import GnssFix, GnssStatus, GnssVelocity, Log, PoseFix, WheelSpeed
from sensors.vehicle import Vehicle

APPLY = -1
Nanoseconds = NDArray[np.int64]
Rows = NDArray[np.int64]
Verdict = NDArray[np.int8]
Record = GnssFix | GnssVelocity | PoseFix | WheelSpeed


class Sources(NamedTuple):
    """Measurements, and for each of them (M,), sorted by true time, then by sensor: t_ns, arrival_ns, kind (Sensor),
    row into its columns, log_row into its record of the drive, verdict (APPLY or the Reason that is only recorded)."""

    measurements: Measurements
    t_ns: Nanoseconds
    arrival_ns: Nanoseconds
    kind: NDArray[np.int8]
    row: Rows
    log_row: Rows
    verdict: Verdict

    def chosen(self, rows: slice | Rows) -> "Sources":
        """Some of the measurements, with everyone's columns."""
        return Sources(
            self.measurements,
            self.t_ns[rows],
            self.arrival_ns[rows],
            self.kind[rows],
            self.row[rows],
            self.log_row[rows],
            self.verdict[rows],
        )


RECORDS = ("gnss", "gnss_velocity", "pose_fixes", "wheel")
"""Records of a Log that measurements come from."""
_SENSORS = (
    *(Sensor.GNSS_POSITION,) * 2,
    *(Sensor.GNSS_VELOCITY,) * 2,
    *(Sensor.GNSS_YAW,) * 2,
    *(Sensor.POSE_FIX,) * 5,
    *(Sensor.WHEEL,) * 2,
)
"""Whose each column of Measurements is."""
_COLUMNS: dict[int, list[int]] = {
    sensor: [i for i, whose in enumerate(_SENSORS) if whose == sensor] for sensor in _SENSORS
}


def joined(parts: Sequence[Sources]) -> Sources:
    """All measurements of the parts (one or more)."""
    if len(parts) == 1:
        return parts[0]
    columns = [np.concatenate(column) for column in zip(*(part.measurements for part in parts), strict=True)]
    t, arrival, kind, row, log_row, verdict = (np.concatenate(column) for column in list(zip(*parts, strict=True))[1:])
    counts = [len(part.t_ns) for part in parts]
    for sensor in dict.fromkeys(_SENSORS):
        lengths = [len(part.measurements[_SENSORS.index(sensor)]) for part in parts]
        before = np.repeat(np.cumsum([0, *lengths[:-1]]), counts)
        row += np.where(kind == sensor, before, 0)
    return Sources(Measurements(*columns), t, arrival, kind, row, log_row, verdict).chosen(np.lexsort((kind, t)))


def split(found: Sources, last_ns: int) -> tuple[Sources, Sources]:
    """Measurements up to last_ns, and those after it."""
    count = int(np.searchsorted(found.t_ns, last_ns, side="right"))
    return found.chosen(slice(count)), compact(found.chosen(slice(count, None)))


def put(found: Sources, columns: Measurements, rows: Rows) -> None:
    """Write the numbers of each measurement into these rows (M,) of other columns."""
    if len(rows) == 1:  # as in live use
        ours, theirs = int(rows[0]), int(found.row[0])
        for i in _COLUMNS[int(found.kind[0])]:
            columns[i][ours] = found.measurements[i][theirs]
        return
    for sensor in set(found.kind.tolist()):
        mine = np.flatnonzero(found.kind == sensor)
        for i in _COLUMNS[sensor]:
            columns[i][rows[mine]] = found.measurements[i][found.row[mine]]


def compact(found: Sources) -> Sources:
    """The same measurements without the columns' rows of others."""
    columns, row = list(found.measurements), found.row.copy()
    for sensor in dict.fromkeys(_SENSORS):
        mine = found.kind == sensor
        used, row[mine] = np.unique(row[mine], return_inverse=True)
        columns = [c[used] if s == sensor else c for c, s in zip(columns, _SENSORS, strict=True)]
    return found._replace(measurements=Measurements(*columns), row=row)


def sources(log: Log, config: FusionConfig, first_rows: Mapping[str, int] | None = None) -> Sources:
    """Every measurement of a log, sorted: see ``parts``."""
    return joined([_NOTHING, *parts(log, config, first_rows)])


def parts(log: Log, config: FusionConfig, first_rows: Mapping[str, int] | None = None) -> list[Sources]:
    """The measurements of a log with their effective covariances, of each sensor for itself.

    first_rows: of each of RECORDS, in the drive's. Raises EgolocError when the log holds pose fixes but no map frame to
    place them.
    """
    first = first_rows or dict.fromkeys(RECORDS, 0)
    found = list[Sources]()
    if log.gnss is not None:
        found += _gnss(log.gnss, log.vehicle, config, first["gnss"])
    if log.gnss_velocity is not None:
        found.append(_velocity(log.gnss_velocity, log.vehicle, config, first["gnss_velocity"]))
    if log.pose_fixes is not None:
        if log.map_frame is None:
            raise EgolocError(
                "the log has pose fixes but no map frame: expected [map_frame] in its metadata or the config"
            )
        found.append(_poses(log.pose_fixes, log.map_frame, config, first["pose_fixes"]))
    if log.wheel is not None:
        columns = {"wheel": log.wheel.speed, "wheel_var": log.wheel.sigma**2 * config.motion.wheel_inflation}
        verdict = _switch(config.motion.wheel, len(log.wheel))
        found.append(_of(Sensor.WHEEL, log.wheel, 0.0, columns, verdict, first["wheel"]))
    return found


def _of(
    sensor: Sensor, record: Record, delay_s: float, columns: Mapping[str, Floats], verdict: Verdict, first_row: int
) -> Sources:
    """The rows of one record: true when stamped less delay_s; columns: of Measurements, by name."""
    rows = np.arange(len(record))
    return Sources(
        _NOTHING.measurements._replace(**columns),
        record.t_ns - round(delay_s * 1e9),
        record.arrival_ns,
        np.full(len(rows), sensor, np.int8),
        rows,
        rows + first_row,
        verdict,
    )


def _switch(on: bool, n: int) -> Verdict:
    return np.full(n, APPLY if on else Reason.SWITCHED_OFF, np.int8)


def _gnss(fixes: GnssFix, vehicle: Vehicle, config: FusionConfig, first_row: int) -> list[Sources]:
    """Positions, and yaws of two antennas where their accuracy is known."""
    model, verdict = config.gnss, _switch(config.gnss.use, len(fixes))
    low = fixes.status < max(model.min_status, GnssStatus.SINGLE)
    verdict = np.where(low & (verdict == APPLY), np.int8(Reason.STATUS), verdict)
    floors = np.array([model.sigma_floor_horizontal_m] * 2 + [model.sigma_floor_vertical_m]) ** 2
    arm_var = 0.0 if config.estimate.lever_arm else vehicle.gnss_lever_arm_sigma_m**2
    cov = _floor(fixes.cov_enu, model.inflation, floors, arm_var)
    place = {"gnss_llh": fixes.llh, "gnss_cov": cov}
    positions = _of(Sensor.GNSS_POSITION, fixes, vehicle.gnss_delay_s, place, verdict, first_row)
    known = np.flatnonzero(np.isfinite(fixes.yaw) & np.isfinite(fixes.yaw_sigma))
    yaw_var = np.maximum(fixes.yaw_sigma, np.radians(model.yaw_sigma_floor_deg)) ** 2
    turn = {"yaw": fixes.yaw, "yaw_var": yaw_var}
    yaws = _of(Sensor.GNSS_YAW, fixes, vehicle.gnss_delay_s, turn, verdict, first_row)
    return [positions, yaws.chosen(known)]


def _velocity(velocity: GnssVelocity, vehicle: Vehicle, config: FusionConfig, first_row: int) -> Sources:
    model = config.gnss
    cov = _floor(velocity.cov_enu, model.velocity_inflation, np.full(3, model.sigma_floor_velocity**2))
    columns = {"vel": velocity.vel_enu, "vel_cov": cov}
    verdict = _switch(model.use and model.use_velocity, len(velocity))
    return _of(Sensor.GNSS_VELOCITY, velocity, vehicle.gnss_velocity_delay_s, columns, verdict, first_row)


def _poses(fixes: PoseFix, frame: MapFrame, config: FusionConfig, first_row: int) -> Sources:
    llh, yaw, tilt, cov, spread = pose_columns(fixes, frame, config)
    columns = {"pose_llh": llh, "pose_yaw": yaw, "pose_tilt": tilt, "pose_cov": cov, "pose_spread": spread}
    return _of(Sensor.POSE_FIX, fixes, 0.0, columns, _switch(config.pose.use, len(fixes)), first_row)


_NONE = np.empty(0)
_NOTHING = Sources(
    measurements=Measurements(
        gnss_llh=_NONE.reshape(0, 3),
        gnss_cov=_NONE.reshape(0, 3, 3),
        vel=_NONE.reshape(0, 3),
        vel_cov=_NONE.reshape(0, 3, 3),
        yaw=_NONE,
        yaw_var=_NONE,
        pose_llh=_NONE.reshape(0, 3),
        pose_yaw=_NONE,
        pose_tilt=_NONE.reshape(0, 2),
        pose_cov=_NONE.reshape(0, 3, 3),
        pose_spread=_NONE.reshape(0, 3),
        wheel=_NONE,
        wheel_var=_NONE,
    ),
    t_ns=np.empty(0, np.int64),
    arrival_ns=np.empty(0, np.int64),
    kind=np.empty(0, np.int8),
    row=np.empty(0, np.int64),
    log_row=np.empty(0, np.int64),
    verdict=np.empty(0, np.int8),
)


def _floor(cov: Floats, factor: float, floors: Floats, added: float = 0.0) -> Floats:
    """``raise_to`` in a new array."""
    raised = np.empty(cov.shape)
    raise_to(cov, factor, floors, added, raised)
    return raised


def pose_columns(
    fixes: PoseFix, frame: MapFrame, config: FusionConfig
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Pose fixes in geodetic terms: llh on the map's ground (N, 3), yaw from east (N,), tilt (N, 2), cov ENU (N, 3, 3)
    with the spread (N, 3) of two modes in it.

    The map is linearized at each fix: (x, y) = scale R_map_enu[:2] (offset ENU). tilt is what a metre of height moves
    the point horizontally in ENU (zero in UTM; in one ENU plane the verticals differ with distance).
    """
    model = config.pose
    n = len(fixes)
    p_map = np.column_stack((fixes.pose[:, :2], np.zeros(n)))
    llh = llh_from_map(frame, p_map)
    rotation, scale = rotation_map_enu(frame, llh)
    transform, tilt, yaw = np.empty((n, 3, 3)), np.empty((n, 2)), np.empty(n)
    linearize(rotation, scale, np.ascontiguousarray(fixes.pose[:, 2]), transform, tilt, yaw)
    floors = np.array([model.sigma_floor_m, model.sigma_floor_m, np.radians(model.sigma_floor_yaw_deg)]) ** 2
    quantization = np.array([model.step_m, model.step_m, np.radians(model.step_deg)]) ** 2 / 12.0
    turned, spread = np.empty((n, 3, 3)), np.empty((n, 3))
    modes = spread_of(fixes) if model.modes else np.zeros((n, 3))
    turn_into_enu(transform, fixes.cov, quantization, modes, turned, spread)
    cov = _floor(turned, model.inflation, floors)
    if spread.any():
        cov += spread[:, :, None] * spread[:, None, :]
    return llh, yaw, tilt, cov, spread
