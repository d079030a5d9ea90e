"""Free inertial runs for tests: the real kernel from a given first state, with or without measurements."""

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.alignment import Initial
from fusion.config import Alignment, FusionConfig, Gates
from fusion.events import Events, Measurements, Recorder, new_recorder
from fusion.navigator import feed, start
from fusion.result import Sensor
from fusion.sensor_models import GnssModel, ImuNoise, MotionModel, PoseModel
from fusion.sources import APPLY, sources, split
from fusion.state import ACCEL_BIAS, E_ATTITUDE, E_VELOCITY, ERROR_SIZE, GYRO_BIAS, LLH, QUATERNION, VELOCITY, Core
from fusion.timeline import merge, parameters
from sensors._kernels import EARTH_RATE, gravity_enu
from sensors.geodesy import ecef_from_llh, meridian_radius, transverse_radius
from sensors.records import Imu, Log
from sensors.rotation import matrix_from_q
from sensors.simulate.drive import DriveConfig, city_truth
from sensors.simulate.imu import simulate_imu
from sensors.simulate.trajectory import Motion, Truth
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

FREE = FusionConfig(
    imu=ImuNoise(noise_scale=1.0, max_gap_s=0.5),
    gnss=GnssModel(inflation=4.0, lasting_share=0.0),
    pose=PoseModel(inflation=4.0, lasting_share=0.0, yaw_offset_sigma_deg=0.0),
    motion=MotionModel(
        zero_velocity=False, non_holonomic=False, wheel_slip=0.0, wheel_scale_sigma=0.0, wheel_scale_walk=0.0
    ),
)
"""Nothing but what the log holds."""
HONEST = FusionConfig(
    imu=ImuNoise(noise_scale=1.0, max_gap_s=0.5, coast_accel=3.0, coast_rate_deg=20.0),
    gnss=GnssModel(
        inflation=1.0,
        lasting_share=0.0,
        velocity_inflation=1.0,
        sigma_floor_horizontal_m=0.0,
        sigma_floor_vertical_m=0.0,
        sigma_floor_velocity=0.0,
        yaw_sigma_floor_deg=0.0,
    ),
    pose=PoseModel(
        inflation=1.0,
        lasting_share=0.0,
        yaw_offset_sigma_deg=0.0,
        sigma_floor_m=0.0,
        sigma_floor_yaw_deg=0.0,
        max_sigma_longitudinal_m=0.47,
        max_sigma_lateral_m=0.47,
        max_sigma_yaw_deg=0.47,
    ),
    motion=MotionModel(
        rate_hz=10.0,
        lateral_sigma=0.1,
        vertical_sigma=0.2,
        sigma_per_speed=0.01,
        unknown_sigma=0.3,
        learning_s=0.0,
        min_speed=2.0,
        still_window_s=1.0,
        still_accel=0.15,
        still_rate_deg=0.3,
        still_drift=0.08,
        still_max_speed=0.3,
        zero_velocity_sigma=0.03,
        zero_rate_sigma_deg=0.1,
        wheel_slip=0.0,
        wheel_scale_sigma=0.0,
        wheel_scale_walk=0.0,
    ),
    gates=Gates(probability=0.9999),
    alignment=Alignment(window_s=1.0, min_course_speed=3.0, course_sigma_deg=2.0, level_sigma_deg=1.0),
)
"""Noise as the simulator draws it: no inflation, no floors. All numbers are given: tests do not hang on defaults."""
HONEST_FREE = msgspec.structs.replace(HONEST, motion=FREE.motion)


def grid(truth: Truth, duration_s: float, hz: int) -> Nanoseconds:
    """Stamps from the truth's start to duration_s at a whole rate."""
    return truth.start_ns + np.arange(round(duration_s * hz) + 1, dtype=np.int64) * (1_000_000_000 // hz)


def city(duration_s: float = 300.0, seed: int = 3) -> Truth:
    return city_truth(duration_s, seed, DriveConfig())


def exact_imu(truth: Truth, t_ns: Nanoseconds, vehicle: Vehicle) -> Imu:
    """Samples without errors."""
    return simulate_imu(truth, t_ns, vehicle.imu, None)[0]


def at_rest(nav: Floats, t_ns: Nanoseconds, push: Floats | None = None) -> Imu:
    """Exact samples of a body that keeps its attitude to the local axes, with the biases of nav (17,).

    push: (3,) m/s^2 on top of gravity's reaction over the first third.
    """
    north, up = gravity_enu(np.sin(nav[0]), np.cos(nav[0]), nav[2])
    earth = EARTH_RATE * np.array([0.0, np.cos(nav[0]), np.sin(nav[0])])
    to_body = matrix_from_q(nav[QUATERNION]).T
    accel = np.repeat((to_body @ [0.0, -north, -up] + nav[ACCEL_BIAS])[None], len(t_ns), axis=0)
    if push is not None:
        accel[: len(t_ns) // 3] += push
    gyro = np.repeat((to_body @ earth + nav[GYRO_BIAS])[None], len(t_ns), axis=0)
    return Imu(t_ns, t_ns, gyro, accel)


def nav_of(motion: Motion, row: int = 0) -> Floats:
    """(17,) nominal state of a true motion, biases and wheel scale zero."""
    return np.concatenate((motion.llh[row], motion.vel_enu[row], motion.q_enu_body[row], np.zeros(7)))


def core_at(nav: Floats, imu: Imu, P: Floats | None = None, row: int = 0) -> Core:
    """A core at sample row of imu; P (16, 16), zeros if not given."""
    cov = np.zeros((ERROR_SIZE, ERROR_SIZE)) if P is None else P
    return start(Initial(int(imu.t_ns[row]), nav.copy(), cov.copy(), Sensor.POSE_FIX), imu)


def go(
    core: Core, imu: Imu, vehicle: Vehicle, config: FusionConfig = FREE, log: Log | None = None
) -> tuple[Recorder, Events]:
    """Run the samples after the core's time with the log's measurements and the outputs of config."""
    rest = imu[imu.t_ns > core.clock[0]]
    _, found = split(sources(log or Log(vehicle=vehicle), config), int(core.clock[0]))
    timeline = merge(found, int(core.clock[0]) + 1, int(rest.t_ns[-1]), config, vehicle.land_vehicle)
    rec = new_recorder(len(timeline.events.t), len(timeline.events.t))
    feed(core, rest, timeline.events, found.measurements, parameters(vehicle, config), rec)
    return rec, timeline.events


def go_with(core: Core, imu: Imu, vehicle: Vehicle, t_ns: Nanoseconds, kind: int) -> Recorder:
    """Run the samples after the core's time with events of one kind (MOTION, OUTPUT) at t_ns."""
    n = len(t_ns)
    events = Events(t_ns, np.full(n, kind, np.int8), np.full(n, -1), np.full(n, APPLY, np.int8))
    rec = new_recorder(n, n)
    rest = imu[imu.t_ns > core.clock[0]]
    feed(core, rest, events, sources(Log(vehicle=vehicle), FREE).measurements, parameters(vehicle, FREE), rec)
    return rec


def distance(nav: Floats, motion: Motion, row: int = -1) -> float:
    """Metres in 3-D between the state and a true place."""
    here = ecef_from_llh(np.stack((nav[:3], motion.llh[row])))
    return float(np.linalg.norm(here[0] - here[1]))


def nothing(vehicle: Vehicle) -> tuple[Events, Measurements, Recorder]:
    """No events, no measurements, and nowhere to record."""
    none = np.empty(0, np.int64)
    events = Events(none, none.astype(np.int8), none, none.astype(np.int8))
    return events, sources(Log(vehicle=vehicle), FREE).measurements, new_recorder(0, 0)


def plus(nav: Floats, dx: Floats) -> Floats:
    """Plain numpy: nav (17,) moved by the error dx (16,), metres to radians there, attitude on the left."""
    moved = nav.copy()
    meridian, transverse = float(meridian_radius(nav[0])) + nav[2], float(transverse_radius(nav[0])) + nav[2]
    moved[LLH] += np.array([dx[1] / meridian, dx[0] / (transverse * np.cos(nav[0])), dx[2]])
    moved[VELOCITY] += dx[E_VELOCITY]
    moved[QUATERNION] = (Rotation.from_rotvec(dx[E_ATTITUDE]) * Rotation.from_quat(nav[QUATERNION])).as_quat()
    moved[10:] += dx[9:]
    return moved


def minus(a: Floats, b: Floats) -> Floats:
    """(16,) error that ``plus`` adds to b to get a (to first order in position)."""
    meridian, transverse = float(meridian_radius(b[0])) + b[2], float(transverse_radius(b[0])) + b[2]
    dlat, dlon, up = a[LLH] - b[LLH]
    turn = (Rotation.from_quat(a[QUATERNION]) * Rotation.from_quat(b[QUATERNION]).inv()).as_rotvec()
    place = (dlon * transverse * np.cos(b[0]), dlat * meridian, up)
    return np.concatenate((place, a[VELOCITY] - b[VELOCITY], turn, a[10:] - b[10:]))


def random_covariance(seed: int, scale: Floats) -> Floats:
    """A full (n, n) covariance whose sigmas are about scale (n,)."""
    root = np.random.default_rng(seed).standard_normal((len(scale), len(scale)))
    result: Floats = np.outer(scale, scale) * (root @ root.T / len(scale) + 0.1 * np.eye(len(scale)))
    return result
