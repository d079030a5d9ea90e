"""Log and configuration as the kernel reads them: effective covariances, and one sorted list of events.

Ordering lives here, outside the core: measurements are laid out by the time at which they were true.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion.config import FusionConfig, check
from fusion.covariance import Noise
from fusion.events import MOTION, OUTPUT, Events, Measurements, Parameters
from fusion.result import Reason, Sensor
from fusion.state import Floats
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, rotation_map_enu
from sensors.records import GnssFix, GnssStatus, GnssVelocity, Log, PoseFix
from sensors.vehicle import ImuSpec, Vehicle

APPLY = -1
Rows = NDArray[np.int64]
Verdict = NDArray[np.int8]
STANDARD_GRAVITY = 9.80665

_ROOT_HOUR = 60.0
_DEG_PER_H = np.pi / 180.0 / 3600.0


def noise_of(spec: ImuSpec, scale: float) -> Noise:
    """Process noise per second from datasheet units; scale multiplies the white noise's standard deviation."""
    gyro = np.radians(spec.gyro_noise_deg_per_sqrt_h) / _ROOT_HOUR * scale
    accel = spec.accel_noise_m_per_s_per_sqrt_h / _ROOT_HOUR * scale
    return Noise(
        gyro_psd=float(gyro**2),
        accel_psd=float(accel**2),
        gyro_bias_var=float((spec.gyro_bias_instability_deg_per_h * _DEG_PER_H) ** 2),
        accel_bias_var=float((spec.accel_bias_instability_mg * 1e-3 * STANDARD_GRAVITY) ** 2),
        bias_rate=1.0 / spec.bias_time_constant_s,
    )


def parameters(vehicle: Vehicle, config: FusionConfig) -> Parameters:
    """The configuration in SI units."""
    gates, motion, pose = config.gates, config.motion, config.pose
    check(config)
    if gates.use:
        first, second, third = (float(chi2.ppf(gates.probability, dof)) for dof in (1, 2, 3))
    else:
        first = second = third = np.inf
    noise = noise_of(vehicle.imu, config.imu.noise_scale)
    return Parameters(
        noise=noise,
        increments=vehicle.imu.samples == "increment",
        max_gap_ns=round(config.imu.max_gap_s * 1e9),
        bridge_ns=round(config.imu.max_bridge_s * 1e9),
        coast_accel=config.imu.coast_accel,
        coast_rate=float(np.radians(config.imu.coast_rate_deg)),
        gate=(first, second, third),
        gnss_arm=_vector(vehicle.gnss_lever_arm),
        pose_arm=_vector(vehicle.pose_lever_arm),
        axle=_vector(vehicle.rear_axle),
        pose_limits=(
            pose.max_sigma_longitudinal_m,
            pose.max_sigma_lateral_m,
            float(np.radians(pose.max_sigma_yaw_deg)),
        ),
        zero_velocity=motion.zero_velocity and vehicle.land_vehicle,
        non_holonomic=motion.non_holonomic and vehicle.land_vehicle,
        lateral_var=motion.lateral_sigma**2,
        vertical_var=motion.vertical_sigma**2,
        per_speed=motion.sigma_per_speed,
        min_speed=motion.min_speed,
        still_window_ns=round(motion.still_window_s * 1e9),
        still_ratio=motion.still_ratio,
        still_accel_var=motion.still_accel**2,
        still_rate_var=float(np.radians(motion.still_rate_deg) ** 2),
        still_max_speed=motion.still_max_speed,
        zero_velocity_var=motion.zero_velocity_sigma**2,
        zero_rate_var=float(np.radians(motion.zero_rate_sigma_deg) ** 2) + noise.gyro_psd * motion.rate_hz,
    )


def _vector(given: tuple[float, float, float]) -> tuple[float, float, float]:
    return float(given[0]), float(given[1]), float(given[2])


class Sources(NamedTuple):
    """Measurements, and for each of them (M,): t_ns true time, arrival_ns, kind (Sensor), row into its columns,
    log_row into the log's record, verdict (APPLY or the Reason that is only recorded)."""

    measurements: Measurements
    t_ns: NDArray[np.int64]
    arrival_ns: NDArray[np.int64]
    kind: NDArray[np.int8]
    row: NDArray[np.int64]
    log_row: NDArray[np.int64]
    verdict: NDArray[np.int8]

    def at(self, i: int, first_log_row: int) -> "Sources":
        """Measurement i alone; its record's first row is first_log_row of the log."""
        wanted, row = _GROUP[int(self.kind[i])], int(self.row[i])
        columns = [
            column[row : row + 1] if group == wanted else column[:0]
            for group, column in zip(_GROUPS, self.measurements, strict=True)
        ]
        one = slice(i, i + 1)
        return Sources(
            Measurements(*columns),
            self.t_ns[one],
            self.arrival_ns[one],
            self.kind[one],
            np.zeros(1, np.int64),
            self.log_row[one] + first_log_row,
            self.verdict[one],
        )


_GROUPS = ("gnss", "gnss", "vel", "vel", "gnss", "gnss", "pose", "pose", "pose", "pose", "wheel", "wheel")
"""Which record each column of Measurements belongs to."""
_GROUP = {
    int(Sensor.GNSS_POSITION): "gnss",
    int(Sensor.GNSS_YAW): "gnss",
    int(Sensor.GNSS_VELOCITY): "vel",
    int(Sensor.POSE_FIX): "pose",
    int(Sensor.WHEEL): "wheel",
}


def concatenate(parts: Sequence[Sources]) -> Sources:
    """Sources of one measurement each (``Sources.at``) as one."""
    columns = [np.concatenate(column) for column in zip(*(part.measurements for part in parts), strict=True)]
    seen = dict.fromkeys(_GROUPS, 0)
    rows = np.empty(len(parts), np.int64)
    for i, part in enumerate(parts):
        group = _GROUP[int(part.kind[0])]
        rows[i] = seen[group]
        seen[group] += 1
    t, arrival, kind, _, log_row, verdict = (np.concatenate(column) for column in list(zip(*parts, strict=True))[1:])
    return Sources(Measurements(*columns), t, arrival, kind, rows, log_row, verdict)


def sources(log: Log, config: FusionConfig) -> Sources:
    """Every measurement of a log with its effective covariance, unsorted.

    Raises EgolocError when the log holds pose fixes but no map frame to place them.
    """
    vehicle = log.vehicle
    columns: list[tuple[Rows, Rows, Sensor, Rows, Verdict]] = []

    def add(sensor: Sensor, t: Rows, arrival: Rows, rows: Rows, verdict: Verdict) -> None:
        columns.append((t, arrival, sensor, rows, verdict))

    empty = np.empty((0, 3))
    llh, gnss_cov, yaw, yaw_var = empty, np.empty((0, 3, 3)), np.empty(0), np.empty(0)
    if log.gnss is not None:
        llh, gnss_cov, yaw, yaw_var = _gnss_columns(log.gnss, vehicle, config)
        verdict = _gnss_verdict(log.gnss, config)
        t = log.gnss.t_ns - round(vehicle.gnss_delay_s * 1e9)
        add(Sensor.GNSS_POSITION, t, log.gnss.arrival_ns, np.arange(len(t)), verdict)
        rows = np.flatnonzero(np.isfinite(yaw_var))
        add(Sensor.GNSS_YAW, t[rows], log.gnss.arrival_ns[rows], rows, verdict[rows])
    vel, vel_cov = empty, np.empty((0, 3, 3))
    if log.gnss_velocity is not None:
        vel, vel_cov = log.gnss_velocity.vel_enu, _velocity_cov(log.gnss_velocity, config)
        t = log.gnss_velocity.t_ns - round(vehicle.gnss_velocity_delay_s * 1e9)
        verdict = _switch(config.gnss.use and config.gnss.use_velocity, len(t))
        add(Sensor.GNSS_VELOCITY, t, log.gnss_velocity.arrival_ns, np.arange(len(t)), verdict)
    pose = (empty, np.empty(0), np.empty((0, 2)), np.empty((0, 3, 3)))
    if log.pose_fixes is not None:
        if log.map_frame is None:
            raise EgolocError(
                "the log has pose fixes but no map frame: expected [map_frame] in its metadata or the config"
            )
        pose = pose_columns(log.pose_fixes, log.map_frame, config)
        t = log.pose_fixes.t_ns
        add(Sensor.POSE_FIX, t, log.pose_fixes.arrival_ns, np.arange(len(t)), _switch(config.pose.use, len(t)))
    wheel, wheel_var = np.empty(0), np.empty(0)
    if log.wheel is not None:
        wheel, wheel_var = log.wheel.speed, log.wheel.sigma**2
        verdict = _switch(config.motion.wheel, len(wheel))
        add(Sensor.WHEEL, log.wheel.t_ns, log.wheel.arrival_ns, np.arange(len(wheel)), verdict)
    measurements = Measurements(llh, gnss_cov, vel, vel_cov, yaw, yaw_var, *pose, wheel, wheel_var)
    return Sources(
        measurements,
        np.concatenate([np.empty(0, np.int64), *(c[0] for c in columns)]),
        np.concatenate([np.empty(0, np.int64), *(c[1] for c in columns)]),
        np.concatenate([np.empty(0, np.int8), *(np.full(len(c[0]), c[2], np.int8) for c in columns)]),
        rows := np.concatenate([np.empty(0, np.int64), *(c[3] for c in columns)]),
        rows,
        np.concatenate([np.empty(0, np.int8), *(c[4] for c in columns)]),
    )


def _switch(on: bool, n: int) -> Verdict:
    return np.full(n, APPLY if on else Reason.SWITCHED_OFF, np.int8)


def _gnss_verdict(fixes: GnssFix, config: FusionConfig) -> NDArray[np.int8]:
    verdict = _switch(config.gnss.use, len(fixes))
    low = fixes.status < max(config.gnss.min_status, GnssStatus.SINGLE)
    return np.where(low & (verdict == APPLY), np.int8(Reason.STATUS), verdict)


def _gnss_columns(fixes: GnssFix, vehicle: Vehicle, config: FusionConfig) -> tuple[Floats, Floats, Floats, Floats]:
    """llh, effective ENU covariance, yaw and its effective variance (NaN without a yaw of known accuracy)."""
    model = config.gnss
    floors = np.array([model.sigma_floor_horizontal_m] * 2 + [model.sigma_floor_vertical_m]) ** 2
    cov = _floor(fixes.cov_enu * model.inflation, floors)
    cov = cov + np.eye(3) * vehicle.gnss_lever_arm_sigma_m**2
    yaw_var = np.maximum(fixes.yaw_sigma, np.radians(model.yaw_sigma_floor_deg)) ** 2
    return fixes.llh, cov, fixes.yaw, np.where(np.isfinite(fixes.yaw), yaw_var, np.nan)


def _velocity_cov(velocity: GnssVelocity, config: FusionConfig) -> Floats:
    floor = config.gnss.sigma_floor_velocity**2
    return _floor(velocity.cov_enu * config.gnss.velocity_inflation, np.full(3, floor))


def _floor(cov: Floats, variances: Floats) -> Floats:
    """Raise diagonals to at least these variances; raising a diagonal keeps a matrix positive definite."""
    raised = cov.copy()
    i = np.arange(3)
    raised[:, i, i] = np.maximum(raised[:, i, i], variances)
    return raised


def pose_columns(fixes: PoseFix, frame: MapFrame, config: FusionConfig) -> tuple[Floats, Floats, Floats, Floats]:
    """Pose fixes in geodetic terms: llh on the map's ground (N, 3), yaw from east (N,), tilt (N, 2), cov ENU (N, 3, 3).

    The map is linearized at each fix: (x, y) = scale R_map_enu[:2] (offset ENU). tilt is what a metre of height moves
    the point horizontally in ENU (zero in UTM; in one ENU plane the verticals differ with distance).
    """
    model = config.pose
    n = len(fixes)
    p_map = np.column_stack((fixes.pose[:, :2], np.zeros(n)))
    llh = llh_from_map(frame, p_map)
    rotation, scale = rotation_map_enu(frame, llh)
    jacobian = rotation[:, :2, :] * scale[:, None, None]
    to_enu = np.empty((n, 2, 2))
    determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
    to_enu[:, 0, 0], to_enu[:, 0, 1] = jacobian[:, 1, 1], -jacobian[:, 0, 1]
    to_enu[:, 1, 0], to_enu[:, 1, 1] = -jacobian[:, 1, 0], jacobian[:, 0, 0]
    to_enu /= determinant[:, None, None]
    tilt = np.einsum("nij,nj->ni", to_enu, jacobian[:, :, 2])
    c, s = np.cos(fixes.pose[:, 2]), np.sin(fixes.pose[:, 2])
    east = to_enu[:, 0, 0] * c + to_enu[:, 0, 1] * s
    north = to_enu[:, 1, 0] * c + to_enu[:, 1, 1] * s
    transform = np.zeros((n, 3, 3))
    transform[:, :2, :2] = to_enu
    transform[:, 2, 2] = 1.0
    floors = np.array([model.sigma_floor_m, model.sigma_floor_m, np.radians(model.sigma_floor_yaw_deg)]) ** 2
    cov = _floor(transform @ (fixes.cov * model.inflation) @ transform.transpose(0, 2, 1), floors)
    return llh, np.arctan2(north, east), tilt, cov


def grid(first_ns: int, last_ns: int, rate_hz: float) -> NDArray[np.int64]:
    """Multiples of the period in [first, last], ns."""
    period = round(1e9 / rate_hz)
    start = -(-first_ns // period)
    return np.arange(start, last_ns // period + 1, dtype=np.int64) * period


class Timeline(NamedTuple):
    """Events in order, and for each its arrival and its row in the log's record (-1: none)."""

    events: Events
    arrival_ns: NDArray[np.int64]
    log_row: NDArray[np.int64]


def merge(found: Sources, first_ns: int, last_ns: int, config: FusionConfig, land_vehicle: bool) -> Timeline:
    """All measurements in [first, last] with motion ticks and outputs, sorted.

    At equal times sensors come in the order of ``Sensor``, then motion, then output.
    """
    inside = (found.t_ns >= first_ns) & (found.t_ns <= last_ns)
    outputs = grid(first_ns, last_ns, config.output_hz)
    motion = config.motion
    wanted = land_vehicle and (motion.zero_velocity or motion.non_holonomic)
    ticks = grid(first_ns, last_ns, motion.rate_hz) if wanted else np.empty(0, np.int64)
    made = np.concatenate((np.full(len(ticks), MOTION, np.int8), np.full(len(outputs), OUTPUT, np.int8)))
    none = np.full(len(made), -1)
    t = np.concatenate((found.t_ns[inside], ticks, outputs))
    kind = np.concatenate((found.kind[inside], made))
    order = np.lexsort((kind, t))
    events = Events(
        t[order],
        kind[order],
        np.concatenate((found.row[inside], none))[order],
        np.concatenate((found.verdict[inside], np.full(len(made), APPLY, np.int8)))[order],
    )
    arrival = np.concatenate((found.arrival_ns[inside], ticks, outputs))[order]
    return Timeline(events, arrival, np.concatenate((found.log_row[inside], none))[order])
