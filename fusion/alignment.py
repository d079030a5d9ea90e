"""The first state: levelled by gravity, gyro bias from rest, yaw from a pose fix, a dual antenna or the GNSS course."""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion.baselines import Fix, enu_between, moved, over_best_baseline
from fusion.config import FusionConfig
from fusion.events import Measurements, Parameters
from fusion.inheritance import inherit_gnss, inherit_pose
from fusion.layout import prior_variances
from fusion.levelling import ImuColumns, Rest, Window, level, window_before
from fusion.result import Sensor
from fusion.state import (
    E_ACCEL_BIAS,
    E_ATTITUDE,
    E_GYRO_BIAS,
    E_POSITION,
    E_VELOCITY,
    E_WHEEL_SCALE,
    GYRO_BIAS,
    LLH,
    NAV_SIZE,
    QUATERNION,
    VELOCITY,
    Floats,
)
from sensors.rotation import matrix_from_q, q_from_rpy
from sensors.vehicle import ImuSpec, Vehicle

_MG = 9.80665e-3
_TOWN_ACCELERATION = 1.2
"""Horizontal acceleration of a car in town, each axis, RMS, m/s^2."""
_STRAIGHT_RATE = 0.05
"""Turning faster than this is a turn, rad/s."""
_SLIP_SHARE = 0.25
"""Tyres slip as well, and the rate is not quite that of the velocity's time: so much of the slip is uncertain."""
_PATIENCE_NS = 1_000_000_000
"""A pose fix that is contradicted is believed after so long."""
_HEIGHT_SIGMA_M = 1000.0
"""Height where no GNSS gives it: anywhere on earth's surface."""
_KEPT = 64
"""Measurements of each kind that are looked back on."""

SERVING = (Sensor.GNSS_POSITION, Sensor.GNSS_VELOCITY, Sensor.GNSS_YAW, Sensor.POSE_FIX)
"""Sensors that an Aligner makes use of."""
Yaw = tuple[float, float]
"""From east, rad, and its variance."""
Velocity = tuple[Floats, Floats]
"""ENU (3,) m/s and its covariance."""


class Place(NamedTuple):
    """llh (3,) of a point of the vehicle, its ENU covariance, that point's lever arm, and the sensor that shows it."""

    llh: Floats
    cov: Floats
    arm: Floats
    sensor: Sensor


@dataclass(frozen=True)
class Initial:
    """First state: t_ns, nav (17,), P (n, n) and the sensor whose measurement completed it."""

    t_ns: int
    nav: Floats
    P: Floats
    sensor: Sensor


class Aligner:
    """Watches measurements in stamp order until one completes a first state. Knows nothing after its time."""

    def __init__(self, vehicle: Vehicle, config: FusionConfig, par: Parameters) -> None:
        self._vehicle, self._config, self._par = vehicle, config.alignment, par
        self._wheel_scale_var = config.motion.wheel_scale_sigma**2
        self._priors = prior_variances(vehicle, config)
        self._positions: deque[Fix] = deque(maxlen=_KEPT)
        self._velocities: deque[Fix] = deque(maxlen=_KEPT)
        self._poses: deque[Fix] = deque(maxlen=_KEPT)
        self._rest = Rest(config.alignment.window_s)
        self._derived = False
        """Velocities are differences of positions."""
        self._doubted_ns = 2**62
        """When a pose fix could first have been the first state."""
        self.first_imu_ns = 0
        """The IMU's first sample."""

    def offer(self, t_ns: int, sensor: int, row: int, m: Measurements, imu: ImuColumns) -> Initial | None:
        """Take one measurement of SERVING and the IMU samples up to its time; a state once it can be had."""
        window = window_before(t_ns, imu, self.first_imu_ns, self._config, self._par)
        still = window is not None and self._still(t_ns, window)
        self._take(t_ns, sensor, row, m)
        if window is None:
            return None
        if still:
            self._rest.add(t_ns, window)
        yaw = self._yaw(t_ns, sensor, row, m, window)
        velocity = None if yaw is None else self._velocity(t_ns, still)
        if yaw is None or velocity is None or self._in_turn(sensor, window):
            return None
        if sensor == Sensor.POSE_FIX and not self._confirmed(t_ns, velocity[0]):
            return None
        place = self._place(t_ns, sensor, velocity[0])
        if place is None:
            return None
        acceleration = (np.zeros(3), 0.0) if still else self._acceleration(t_ns, window)
        nav, P = self._state(yaw, velocity, place, window, acceleration)
        if place.sensor == Sensor.POSE_FIX:
            inherit_pose(P, self._poses[-1], nav, self._par, yaw_too=sensor == Sensor.POSE_FIX)
        else:
            inherit_gnss(P, self._positions[-1], nav, window.rate, acceleration[0], self._par)
        return Initial(t_ns, nav, P, Sensor(sensor))

    def _take(self, t_ns: int, sensor: int, row: int, m: Measurements) -> None:
        if sensor == Sensor.GNSS_POSITION:
            self._take_position(Fix(t_ns, m.gnss_llh[row], m.gnss_cov[row]))
        elif sensor == Sensor.GNSS_VELOCITY:
            self._derived = False
            self._velocities.append(Fix(t_ns, m.vel[row], m.vel_cov[row]))
        elif sensor == Sensor.POSE_FIX:
            self._poses.append(Fix(t_ns, np.append(m.pose_llh[row], m.pose_yaw[row]), m.pose_cov[row]))

    def _take_position(self, fix: Fix) -> None:
        """Keep a position, and where the receiver gives no velocity the one over the last positions."""
        self._positions.append(fix)
        if self._velocities and not self._derived and fix.t_ns - self._velocities[-1].t_ns <= 1e9:
            return
        best = over_best_baseline(self._positions)
        if best is not None:
            self._derived = True
            self._velocities.append(best)

    def _still(self, t_ns: int, window: Window) -> bool:
        """Whether the vehicle stands: steady driving is as quiet, so something must have seen that it is slow."""
        if not window.whole or not window.quiet(self._par):  # over a shorter time braking is quiet, too
            return False
        seen = [v for v in (*self._velocities, *self._pose_velocity()) if t_ns - v.t_ns <= 1e9]
        slow = all(np.linalg.norm(v.value[:2]) < 0.3 + 2.0 * math.sqrt(v.cov[0, 0] + v.cov[1, 1]) for v in seen)
        return slow and bool(seen)

    def _yaw(self, t_ns: int, sensor: int, row: int, m: Measurements, window: Window) -> Yaw | None:
        """What this measurement shows of the yaw."""
        if sensor == Sensor.GNSS_YAW:
            return float(m.yaw[row]), float(m.yaw_var[row])
        if sensor == Sensor.POSE_FIX:
            variance = float(m.pose_cov[row, 2, 2])
            if variance <= self._par.pose_limits[2] ** 2:
                return float(m.pose_yaw[row]), variance
        if self._velocities and self._velocities[-1].t_ns == t_ns:
            return self._course(self._velocities[-1], window)
        return None

    def _course(self, velocity: Fix, window: Window) -> Yaw | None:
        """Direction of motion, where it is fast enough and known well enough, less the slip of the antenna.

        In a turn only the rear axle moves along the body: an antenna l ahead of it slips by asin(rate l / speed).
        """
        limits = self._config
        east, north = velocity.value[:2]
        speed2 = float(east * east + north * north)
        if speed2 < limits.min_course_speed**2:
            return None
        normal = np.array([-north, east])
        variance = float(normal @ velocity.cov[:2, :2] @ normal) / speed2**2
        if variance > math.radians(limits.max_course_sigma_deg) ** 2:
            return None
        slip = 0.0
        if self._vehicle.land_vehicle:
            ahead = self._vehicle.gnss_lever_arm[0] - self._vehicle.rear_axle[0]
            slip = math.asin(float(np.clip(window.latest_rate[2] * ahead / math.sqrt(speed2), -1.0, 1.0)))
        sigma = math.hypot(math.radians(limits.course_sigma_deg), _SLIP_SHARE * slip)
        return math.atan2(north, east) - slip, variance + sigma**2

    def _in_turn(self, sensor: int, window: Window) -> bool:
        """Whether a course over a baseline lags; it waits for the end of the turn."""
        return self._derived and sensor == Sensor.GNSS_POSITION and abs(window.rate[2]) > _STRAIGHT_RATE

    def _confirmed(self, t_ns: int, velocity: Floats) -> bool:
        """Whether GNSS, or else the fix before it, confirms the last pose fix: one alone may be far off.

        Where they go on to differ the fix is believed after a while.
        """
        self._doubted_ns = min(self._doubted_ns, t_ns)
        fix, place = self._poses[-1], self._positions[-1] if self._positions else None
        if place is not None and t_ns - place.t_ns <= 0.5e9:
            level_axes = matrix_from_q(q_from_rpy(0.0, 0.0, float(fix.value[3]))[0])
            arm = level_axes @ (np.array(self._vehicle.pose_lever_arm) - np.array(self._vehicle.gnss_lever_arm))
        elif len(self._poses) > 1:
            place, arm = self._poses[-2], np.zeros(3)
        else:
            return True
        gone = enu_between(place.value, fix.value) - arm - velocity * (t_ns - place.t_ns) * 1e-9
        apart = gone[:2] @ np.linalg.solve((place.cov + fix.cov)[:2, :2], gone[:2])
        return bool(apart <= self._par.gate[1]) or t_ns - self._doubted_ns > _PATIENCE_NS

    def _velocity(self, t_ns: int, still: bool) -> Velocity | None:
        """GNSS or pose fixes within 0.5 s, else rest."""
        if self._velocities and t_ns - self._velocities[-1].t_ns <= 0.5e9:
            latest = self._velocities[-1]
            age = (t_ns - latest.t_ns) * 1e-9
            return latest.value, latest.cov + np.eye(3) * (3.0 * age) ** 2
        for latest in self._pose_velocity():
            if t_ns - latest.t_ns <= 0.5e9:
                return latest.value, latest.cov
        return (np.zeros(3), np.eye(3) * 0.1**2) if still else None

    def _pose_velocity(self) -> list[Fix]:
        """Velocity over the last pose fixes (level): none or one."""
        best = over_best_baseline(self._poses)
        if best is None:
            return []
        cov = best.cov.copy()
        cov[2], cov[:, 2] = 0.0, 0.0
        cov[2, 2] = 0.3**2
        return [Fix(best.t_ns, best.value * (1.0, 1.0, 0.0), cov)]

    def _place(self, t_ns: int, sensor: int, velocity: Floats) -> Place | None:
        """Where the pose fix says, if it is one that observes the place, else GNSS."""
        fix = self._positions[-1] if self._positions else None
        if sensor == Sensor.POSE_FIX and _largest_var(self._poses[-1]) <= max(self._par.pose_limits[:2]) ** 2:
            return self._pose_place(t_ns, self._poses[-1], fix)
        if fix is None or t_ns - fix.t_ns > 0.5e9:
            return None
        age = (t_ns - fix.t_ns) * 1e-9
        cov = fix.cov + np.eye(3) * (1.0 * age) ** 2
        arm = np.array(self._vehicle.gnss_lever_arm)
        return Place(moved(fix.value, velocity * age), cov, arm, Sensor.GNSS_POSITION)

    def _pose_place(self, t_ns: int, pose: Fix, fix: Fix | None) -> Place:
        """A pose fix's place, with its height from GNSS."""
        llh, cov = pose.value[:3].copy(), np.diag([0.0, 0.0, _HEIGHT_SIGMA_M**2])
        cov[:2, :2] = pose.cov[:2, :2]
        if fix is not None and t_ns - fix.t_ns <= 10e9:
            llh[2] = fix.value[2] - self._vehicle.gnss_lever_arm[2] + self._vehicle.pose_lever_arm[2]
            cov[2, 2] = fix.cov[2, 2] + 0.3**2
        return Place(llh, cov, np.array(self._vehicle.pose_lever_arm), Sensor.POSE_FIX)

    def _acceleration(self, t_ns: int, window: Window) -> tuple[Floats, float]:
        """ENU acceleration (3,) over the window, and the sigma of its horizontal axes, m/s^2.

        The change of GNSS velocity; where it is not known, nothing, give or take what a car does in town.
        """
        length = round((window.seconds + 0.3) * 1e9)
        used = [v for v in self._velocities if t_ns - v.t_ns <= length]
        span = (used[-1].t_ns - used[0].t_ns) * 1e-9 if len(used) > 1 else 0.0
        if span < 0.5 * window.seconds:
            return np.zeros(3), _TOWN_ACCELERATION
        sigma = math.sqrt((used[-1].cov + used[0].cov)[:2, :2].trace() / 2.0) / span
        return (used[-1].value - used[0].value) / span, sigma

    def _state(
        self, yaw: Yaw, velocity: Velocity, place: Place, window: Window, acceleration: tuple[Floats, float]
    ) -> tuple[Floats, Floats]:
        """nav (17,) and P (n, n)."""
        llh, arm = place.llh, place.arm
        roll, pitch, tilt_sigma = level(window, *acceleration, yaw[0], float(llh[0]), float(llh[2]))
        level_sigma = math.hypot(math.radians(self._config.level_sigma_deg), tilt_sigma)
        q = q_from_rpy(roll, pitch, yaw[0])[0]
        R = matrix_from_q(q)
        nav = np.zeros(NAV_SIZE)
        nav[LLH], nav[VELOCITY], nav[QUATERNION] = moved(llh, -(R @ arm)), velocity[0], q
        nav[GYRO_BIAS], bias_sigma = self._rest.gyro_bias(self._vehicle.imu, self._par, R, float(llh[0]))
        reach = np.linalg.norm(arm)
        P = np.diag(self._priors)
        P[E_POSITION, E_POSITION] = place.cov + np.eye(3) * (reach * level_sigma) ** 2
        P[E_VELOCITY, E_VELOCITY] = velocity[1] + np.eye(3) * (np.linalg.norm(window.rate) * reach) ** 2
        P[E_ATTITUDE, E_ATTITUDE] = np.diag([level_sigma**2, level_sigma**2, yaw[1]])
        P[E_GYRO_BIAS, E_GYRO_BIAS] = np.eye(3) * bias_sigma**2
        P[E_WHEEL_SCALE, E_WHEEL_SCALE] = self._wheel_scale_var
        P[E_ACCEL_BIAS, E_ACCEL_BIAS] = np.eye(3) * _accel_bias_sigma(self._vehicle.imu) ** 2
        return nav, P


def _largest_var(pose: Fix) -> float:
    """Of any horizontal direction, m^2."""
    return float(np.linalg.eigvalsh(pose.cov[:2, :2])[-1])


def _accel_bias_sigma(spec: ImuSpec) -> float:
    return (spec.accel_turn_on_bias_mg + spec.accel_bias_instability_mg) * _MG
