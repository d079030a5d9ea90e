"""Made-up drives for the tests of replay: a track with known errors and a fake result of the filter."""

import numpy as np
from numpy.typing import NDArray

from fusion.result import Decisions, FusionResult, Health, Level, Reason, Sensor, States
from sensors.clock import NS_PER_S
from sensors.geodesy import MapFrame, llh_from_map, rotation_map_enu
from sensors.records import GnssFix, GnssStatus, GnssVelocity, Imu, Log, PoseFix, Trajectory
from sensors.rotation import matrix_from_q, q_from_matrix, q_from_rpy
from sensors.vehicle import Vehicle

FRAME = MapFrame("enu", (49.0, 8.4, 110.0))
START_NS = 1_700_000_000 * NS_PER_S
Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]


def stamps(duration_s: float, hz: float, start_ns: int = START_NS) -> Nanoseconds:
    """Stamps from start_ns, the end left out."""
    return start_ns + np.rint(np.arange(round(duration_s * hz)) * (NS_PER_S / hz)).astype(np.int64)


def track(t_ns: Nanoseconds, speed: float = 10.0, turn: float = 0.02) -> tuple[Floats, Floats]:
    """Positions (N, 3) and yaw (N,) of a level circle driven at constant speed (m/s) and turn rate (rad/s)."""
    s = (t_ns - START_NS) / NS_PER_S
    yaw = turn * s
    radius = speed / turn
    return np.stack((radius * np.sin(yaw), radius * (1 - np.cos(yaw)), np.zeros(len(s))), axis=-1), yaw


def reference(t_ns: Nanoseconds, *, attitude: bool = True, sigma: tuple[float, float] | None = None) -> Trajectory:
    p_map, yaw = track(t_ns)
    zero = np.zeros(len(t_ns))
    spread = None if sigma is None else np.tile(sigma, (len(t_ns), 1))
    return Trajectory(t_ns, t_ns, p_map, q_from_rpy(zero, zero, yaw) if attitude else None, spread)  # type: ignore[arg-type]


def still_imu(duration_s: float) -> Imu:
    """Stamps that bound a log; the samples are not used by a fake result."""
    t_ns = stamps(duration_s, 100.0)
    return Imu(t_ns, t_ns, np.zeros((len(t_ns), 3)), np.tile((0.0, 0.0, 9.81), (len(t_ns), 1)))


def gnss(t_ns: Nanoseconds, offset: tuple[float, float, float] = (0.0, 0.0, 0.0), arm: Floats | None = None) -> GnssFix:
    """Fixed fixes of an antenna at arm (body, m), off by an offset in map axes."""
    p_map, yaw = track(t_ns)
    if arm is not None:
        p_map = p_map + to_map(yaw, arm)
    status = np.full(len(t_ns), GnssStatus.FIXED, np.int8)
    return GnssFix(
        t_ns, t_ns, llh_from_map(FRAME, p_map + offset), np.tile(1e-4 * np.eye(3), (len(t_ns), 1, 1)), status
    )


def gnss_velocity(t_ns: Nanoseconds) -> GnssVelocity:
    return GnssVelocity(t_ns, t_ns, np.zeros((len(t_ns), 3)), np.tile(1e-2 * np.eye(3), (len(t_ns), 1, 1)))


def pose_fixes(t_ns: Nanoseconds, error: tuple[float, float, float]) -> PoseFix:
    """Fixes with a constant error along and left (m) and in yaw (rad)."""
    p_map, yaw = track(t_ns)
    p_map = p_map + to_map(yaw, np.array((error[0], error[1], 0.0)))
    pose = np.stack((p_map[:, 0], p_map[:, 1], yaw + error[2]), axis=-1)
    return PoseFix(t_ns, t_ns, pose, np.tile(np.diag((0.01, 0.01, 1e-4)), (len(t_ns), 1, 1)))


def to_map(yaw: Floats, v_body: Floats) -> Floats:
    """(N, 3) a body vector of a level vehicle in map axes."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack((c * v_body[0] - s * v_body[1], s * v_body[0] + c * v_body[1], np.full(len(yaw), v_body[2])), -1)


def states(t_ns: Nanoseconds, error: tuple[float, float, float] = (0.0, 0.0, 0.0), sigma_m: float = 0.1) -> States:
    """States off the track by a constant error along and left (m) and in yaw (rad), in a small ENU map."""
    p_map, yaw = track(t_ns)
    p_map = p_map + to_map(yaw, np.array((error[0], error[1], 0.0)))
    n, zero = len(t_ns), np.zeros(len(t_ns))
    cov = np.tile(np.diag([sigma_m**2] * 3 + [1e-4] * 3), (n, 1, 1))
    velocity = 10.0 * np.stack((np.cos(yaw), np.sin(yaw), zero), axis=-1)
    llh = llh_from_map(FRAME, p_map)
    R_map_enu, _ = rotation_map_enu(FRAME, llh)
    R_map_body = matrix_from_q(q_from_rpy(zero, zero, yaw + error[2]).reshape(n, 4))
    return States(
        t_ns,
        llh,
        velocity,
        q_from_matrix(R_map_enu.transpose(0, 2, 1) @ R_map_body).reshape(n, 4),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        cov,
        np.full((n, 15), 0.1),
        np.full(n, Health.HEALTHY, np.int8),
        np.zeros(n, np.int8),
        np.full((n, 5), Level.GOOD, np.int8),
    )


def decisions(log: Log) -> Decisions:
    """One accepted decision per GNSS position and velocity and per pose fix, in the order in which they were true."""
    parts = [
        (Sensor.GNSS_POSITION, log.gnss, log.vehicle.gnss_delay_s),
        (Sensor.GNSS_VELOCITY, log.gnss_velocity, log.vehicle.gnss_velocity_delay_s),
        (Sensor.POSE_FIX, log.pose_fixes, 0.0),
    ]
    known = [(sensor, record, round(delay * NS_PER_S)) for sensor, record, delay in parts if record is not None]
    t_ns = np.concatenate([np.empty(0, np.int64), *(record.t_ns - delay for _, record, delay in known)])
    sensor = np.concatenate([np.empty(0, np.int8), *(np.full(len(record), s, np.int8) for s, record, _ in known)])
    row = np.concatenate([np.empty(0, np.int64), *(np.arange(len(record)) for _, record, _ in known)])
    order = np.argsort(t_ns, kind="stable")
    n = len(t_ns)
    return Decisions(
        t_ns[order],
        t_ns[order],
        sensor[order],
        row[order],
        np.full(n, Reason.ACCEPTED, np.int8),
        np.zeros((n, 3)),
        np.ones((n, 3)),
        np.zeros(n),
        np.full(n, 21.1),
        np.full(n, 3, np.int8),
        np.zeros(n),
        np.zeros(n),
        np.ones(n),
    )


def drive(
    duration_s: float = 60.0,
    *,
    state_error: tuple[float, float, float] = (0.0, 0.0, 0.0),
    pose_error: tuple[float, float, float] = (0.0, 0.0, 0.0),
    with_reference: bool = True,
    attitude: bool = True,
    aligned_s: float = 0.0,
    vehicle: Vehicle | None = None,
) -> tuple[Log, FusionResult]:
    """A log with 100 Hz reference, 10 Hz GNSS and pose fixes, and a result with states from aligned_s on."""
    slow = stamps(duration_s, 10.0)
    log = Log(
        imu=still_imu(duration_s),
        gnss=gnss(slow),
        pose_fixes=pose_fixes(slow, pose_error),
        reference=reference(stamps(duration_s, 100.0), attitude=attitude) if with_reference else None,
        vehicle=vehicle or Vehicle(),
        map_frame=FRAME,
    )
    at = slow[slow >= START_NS + round(aligned_s * NS_PER_S)]
    return log, FusionResult(states(at, state_error), decisions(log), int(at[0]) if len(at) else None)
