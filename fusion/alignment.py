"""The first state: levelled by gravity, gyro bias from rest, yaw from a pose fix, a dual antenna or the GNSS course."""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusion.baselines import Fix, enu_between, moved, over_best_baseline
from fusion.config import FusionConfig
from fusion.events import Measurements, Parameters
from fusion.result import Sensor
from fusion.state import (
    E_ACCEL_BIAS,
    E_ATTITUDE,
    E_GYRO_BIAS,
    E_POSITION,
    E_VELOCITY,
    E_WHEEL_SCALE,
    ERROR_SIZE,
    GYRO_BIAS,
    LLH,
    NAV_SIZE,
    QUATERNION,
    VELOCITY,
    Floats,
)
from sensors._kernels import EARTH_RATE, gravity_enu
from sensors.rotation import matrix_from_q, q_from_rpy
from sensors.vehicle import ImuSpec, Vehicle

_DEG_PER_H = math.pi / 180.0 / 3600.0
_MG = 9.80665e-3
_TOWN_ACCELERATION = 1.2
"""Horizontal acceleration of a car in town, each axis, RMS, m/s^2."""
_STRAIGHT_RATE = 0.05
"""Turning faster than this is a turn, rad/s."""
_PATIENCE_NS = 1_000_000_000
"""A pose fix that is contradicted is believed after so long."""
_FEWEST = 10
"""IMU samples in a window, at least."""
_HEIGHT_SIGMA_M = 1000.0
"""Height where no GNSS gives it: anywhere on earth's surface."""


@dataclass(frozen=True)
class Initial:
    """First state: t_ns, nav (17,), P (16, 16) and the sensor whose measurement completed it."""

    t_ns: int
    nav: Floats
    P: Floats
    sensor: Sensor


@dataclass
class _Window:
    """IMU over the alignment window: mean gyro (rad/s) and accel (m/s^2), and whether it was quiet."""

    gyro: Floats
    accel: Floats
    still: bool
    seconds: float


@dataclass
class Aligner:
    """Watches measurements in stamp order until one completes a first state. Knows nothing after its time."""

    vehicle: Vehicle
    config: FusionConfig
    par: Parameters
    first_imu_ns: int = 0
    """The IMU's first sample."""
    positions: deque[Fix] = field(default_factory=lambda: deque(maxlen=64))
    velocities: deque[Fix] = field(default_factory=lambda: deque(maxlen=64))
    poses: deque[Fix] = field(default_factory=lambda: deque(maxlen=64))
    rest: tuple[Floats, int] | None = None
    """Sum of mean rates over windows at rest and their number."""
    rest_until_ns: int = 0
    doubted_ns: int = 2**62
    """When a pose fix could first have been the first state."""
    _derived: bool = False
    """Velocities are differences of positions."""

    def offer(
        self, t_ns: int, sensor: int, row: int, m: Measurements, imu: tuple[NDArray[np.int64], Floats, Floats]
    ) -> Initial | None:
        """Take one measurement and the IMU samples (t, gyro, accel) up to its time; a state once it can be had."""
        window = self._window(t_ns, imu)
        if sensor == Sensor.GNSS_POSITION:
            self._take_position(Fix(t_ns, m.gnss_llh[row], m.gnss_cov[row]))
        elif sensor == Sensor.GNSS_VELOCITY:
            self._derived = False
            self.velocities.append(Fix(t_ns, m.vel[row], m.vel_cov[row]))
        elif sensor == Sensor.POSE_FIX:
            value = np.append(m.pose_llh[row], m.pose_yaw[row])
            self.poses.append(Fix(t_ns, value, m.pose_cov[row]))
        if window is None:
            return None
        self._watch_rest(t_ns, window)
        yaw, yaw_var = self._yaw(t_ns, sensor, row, m)
        if yaw is None:
            return None
        if self._derived and sensor == Sensor.GNSS_POSITION and abs(window.gyro[2]) > _STRAIGHT_RATE:
            return None  # a course over a baseline lags in a turn: wait for its end
        velocity = self._velocity(t_ns, window)
        if velocity is None or (sensor == Sensor.POSE_FIX and not self._confirmed(t_ns, velocity[0])):
            return None
        return self._build(t_ns, Sensor(sensor), yaw, yaw_var, velocity, window)

    def _take_position(self, fix: Fix) -> None:
        """Keep a position, and where the receiver gives no velocity the one over the last positions."""
        self.positions.append(fix)
        if self.velocities and not self._derived and fix.t_ns - self.velocities[-1].t_ns <= 1e9:
            return
        best = over_best_baseline(self.positions)
        if best is not None:
            self._derived = True
            self.velocities.append(best)

    def _window(self, t_ns: int, imu: tuple[NDArray[np.int64], Floats, Floats]) -> _Window | None:
        """Averages over (t - window, t]; None where the IMU does not cover it. Less will do when it has just begun."""
        t, gyro, accel = imu
        length = round(self.config.alignment.window_s * 1e9)
        first, last = np.searchsorted(t, (t_ns - length, t_ns), side="right")
        if last - first < _FEWEST:
            return None
        begun_ns = t_ns - self.first_imu_ns
        shortest = round(self.config.alignment.first_window_s * 1e9) if begun_ns < length else 0.8 * length
        if t[last - 1] - t[first] < min(shortest, 0.8 * length):
            return None
        if np.diff(t[first:last]).max() > self.par.max_gap_ns:
            return None
        g, f = gyro[first:last], accel[first:last]
        quiet = float(np.linalg.norm(f, axis=1).var()) < self.par.still_accel_var
        quiet = quiet and float(g[:, 2].var()) < self.par.still_rate_var
        seen = [v for v in (*self.velocities, *self._pose_velocity()) if t_ns - v.t_ns <= 1e9]
        # steady driving is as quiet as rest: something must have seen that the vehicle is slow
        slow = all(np.linalg.norm(v.value[:2]) < 0.3 + 2.0 * math.sqrt(v.cov[0, 0] + v.cov[1, 1]) for v in seen)
        # and over a shorter time braking is quiet, too
        still = quiet and slow and bool(seen) and t[last - 1] - t[first] >= 0.8 * length
        return _Window(g.mean(axis=0), f.mean(axis=0), still, (t[last - 1] - t[first]) * 1e-9)

    def _watch_rest(self, t_ns: int, window: _Window) -> None:
        """Average the rates of windows at rest that do not overlap."""
        if window.still and t_ns >= self.rest_until_ns:
            total, count = self.rest or (np.zeros(3), 0)
            self.rest = (total + window.gyro, count + 1)
            self.rest_until_ns = t_ns + round(self.config.alignment.window_s * 1e9)

    def _yaw(self, t_ns: int, sensor: int, row: int, m: Measurements) -> tuple[float | None, float]:
        """Yaw from east and its variance, where this measurement shows it."""
        if sensor == Sensor.GNSS_YAW:
            return float(m.yaw[row]), float(m.yaw_var[row])
        if sensor == Sensor.POSE_FIX:
            cov = m.pose_cov[row]
            limits = self.par.pose_limits
            place = float(np.linalg.eigvalsh(cov[:2, :2])[-1])
            if cov[2, 2] <= limits[2] ** 2 and place <= max(limits[0], limits[1]) ** 2:
                return float(m.pose_yaw[row]), float(cov[2, 2])
        if self.velocities and self.velocities[-1].t_ns == t_ns:
            return self._course(self.velocities[-1])
        return None, 0.0

    def _confirmed(self, t_ns: int, velocity: Floats) -> bool:
        """Whether GNSS, or else the fix before it, confirms the last pose fix: one alone may be far off.

        Where they go on to differ the fix is believed after a while.
        """
        self.doubted_ns = min(self.doubted_ns, t_ns)
        fix, place = self.poses[-1], self.positions[-1] if self.positions else None
        if place is not None and t_ns - place.t_ns <= 0.5e9:
            level = matrix_from_q(q_from_rpy(0.0, 0.0, float(fix.value[3]))[0])
            arm = level @ (np.array(self.vehicle.pose_lever_arm) - np.array(self.vehicle.gnss_lever_arm))
        elif len(self.poses) > 1:
            place, arm = self.poses[-2], np.zeros(3)
        else:
            return True
        gone = enu_between(place.value, fix.value) - arm - velocity * (t_ns - place.t_ns) * 1e-9
        apart = gone[:2] @ np.linalg.solve((place.cov + fix.cov)[:2, :2], gone[:2])
        return bool(apart <= self.par.gate[1]) or t_ns - self.doubted_ns > _PATIENCE_NS

    def _course(self, velocity: Fix) -> tuple[float | None, float]:
        """Direction of motion and its variance, where it is fast enough and known well enough."""
        limits = self.config.alignment
        east, north = velocity.value[:2]
        speed2 = float(east * east + north * north)
        if speed2 < limits.min_course_speed**2:
            return None, 0.0
        normal = np.array([-north, east])
        variance = float(normal @ velocity.cov[:2, :2] @ normal) / speed2**2
        if variance > math.radians(limits.max_course_sigma_deg) ** 2:
            return None, 0.0
        return math.atan2(north, east), variance + math.radians(limits.course_sigma_deg) ** 2

    def _pose_velocity(self) -> list[Fix]:
        """Velocity over the last pose fixes (level): none or one."""
        best = over_best_baseline(self.poses)
        if best is None:
            return []
        cov = best.cov.copy()
        cov[2], cov[:, 2] = 0.0, 0.0
        cov[2, 2] = 0.3**2
        return [Fix(best.t_ns, best.value * (1.0, 1.0, 0.0), cov)]

    def _velocity(self, t_ns: int, window: _Window) -> tuple[Floats, Floats] | None:
        """ENU velocity and covariance: GNSS or pose fixes within 0.5 s, else rest."""
        if self.velocities and t_ns - self.velocities[-1].t_ns <= 0.5e9:
            latest = self.velocities[-1]
            age = (t_ns - latest.t_ns) * 1e-9
            return latest.value, latest.cov + np.eye(3) * (3.0 * age) ** 2
        for latest in self._pose_velocity():
            if t_ns - latest.t_ns <= 0.5e9:
                return latest.value, latest.cov
        return (np.zeros(3), np.eye(3) * 0.1**2) if window.still else None

    def _build(
        self,
        t_ns: int,
        sensor: Sensor,
        yaw: float,
        yaw_var: float,
        velocity: tuple[Floats, Floats],
        window: _Window,
    ) -> Initial | None:
        place = self._place(t_ns, sensor, velocity[0])
        if place is None:
            return None
        llh, place_cov, arm = place
        rpy, level_sigma = self._level(t_ns, float(llh[0]), float(llh[2]), yaw, window)
        q = q_from_rpy(rpy[0], rpy[1], yaw)[0]
        R = matrix_from_q(q)
        nav = np.zeros(NAV_SIZE)
        nav[LLH] = moved(llh, -(R @ np.array(arm)))
        nav[VELOCITY], nav[QUATERNION] = velocity[0], q
        bias, bias_sigma = self._gyro_bias(R, float(llh[0]))
        nav[GYRO_BIAS] = bias
        P = np.zeros((ERROR_SIZE, ERROR_SIZE))
        P[E_POSITION, E_POSITION] = place_cov + np.eye(3) * (np.linalg.norm(arm) * level_sigma) ** 2
        P[E_VELOCITY, E_VELOCITY] = velocity[1] + np.eye(3) * (np.linalg.norm(window.gyro) * np.linalg.norm(arm)) ** 2
        P[E_ATTITUDE, E_ATTITUDE] = np.diag([level_sigma**2, level_sigma**2, yaw_var])
        P[E_GYRO_BIAS, E_GYRO_BIAS] = np.eye(3) * bias_sigma**2
        P[E_WHEEL_SCALE, E_WHEEL_SCALE] = self.config.motion.wheel_scale_sigma**2
        P[E_ACCEL_BIAS, E_ACCEL_BIAS] = np.eye(3) * _accel_bias_sigma(self.vehicle.imu) ** 2
        return Initial(t_ns, nav, P, sensor)

    def _place(self, t_ns: int, sensor: Sensor, velocity: Floats) -> tuple[Floats, Floats, Floats] | None:
        """Position llh of a point of the vehicle, ENU covariance and that point's lever arm."""
        fix = self.positions[-1] if self.positions else None
        if sensor == Sensor.POSE_FIX:
            pose = self.poses[-1]
            llh, cov = pose.value[:3].copy(), np.diag([0.0, 0.0, _HEIGHT_SIGMA_M**2])
            cov[:2, :2] = pose.cov[:2, :2]
            if fix is not None and t_ns - fix.t_ns <= 10e9:
                llh[2] = fix.value[2] - self.vehicle.gnss_lever_arm[2] + self.vehicle.pose_lever_arm[2]
                cov[2, 2] = fix.cov[2, 2] + 0.3**2
            return llh, cov, np.array(self.vehicle.pose_lever_arm)
        if fix is None or t_ns - fix.t_ns > 0.5e9:
            return None
        age = (t_ns - fix.t_ns) * 1e-9
        cov = fix.cov + np.eye(3) * (1.0 * age) ** 2
        return moved(fix.value, velocity * age), cov, np.array(self.vehicle.gnss_lever_arm)

    def _level(self, t_ns: int, lat: float, height: float, yaw: float, window: _Window) -> tuple[Floats, float]:
        """Roll and pitch that turn the mean specific force into acceleration minus gravity, and their sigma, rad.

        The acceleration is zero at rest, else the change of GNSS velocity over the window; where neither is known, what
        a car does in town is added to sigma.
        """
        north, up = gravity_enu(math.sin(lat), math.cos(lat), height)
        wanted = np.array([0.0, -north, -up])
        unknown = 0.0
        if not window.still:
            length = round((window.seconds + 0.3) * 1e9)
            used = [v for v in self.velocities if t_ns - v.t_ns <= length]
            span = (used[-1].t_ns - used[0].t_ns) * 1e-9 if len(used) > 1 else 0.0
            if span >= 0.5 * window.seconds:
                wanted = wanted + (used[-1].value - used[0].value) / span
                unknown = math.sqrt((used[-1].cov + used[0].cov)[:2, :2].trace() / 2.0) / span
            else:
                unknown = _TOWN_ACCELERATION
        middle = yaw - window.gyro[2] * window.seconds / 2.0
        c, s = math.cos(middle), math.sin(middle)
        ahead, left, above = c * wanted[0] + s * wanted[1], c * wanted[1] - s * wanted[0], wanted[2]
        fx, fy, fz = window.accel
        # Rx(roll) leaves x and brings y to `left`; Ry(pitch) then turns (x, z) onto (ahead, above)
        roll = math.atan2(fy, fz) - math.asin(float(np.clip(left / math.hypot(fy, fz), -1.0, 1.0)))
        lifted = fy * math.sin(roll) + fz * math.cos(roll)
        pitch = math.atan2(ahead, above) - math.atan2(fx, lifted)
        own = math.radians(self.config.alignment.level_sigma_deg)
        return np.array([roll, pitch]), math.hypot(own, unknown / above)

    def _gyro_bias(self, R: Floats, lat: float) -> tuple[Floats, float]:
        """Bias seen at rest (mean rate minus the earth's), else zero with the turn-on sigma, rad/s."""
        spec = self.vehicle.imu
        if self.rest is None:
            return np.zeros(3), (spec.gyro_turn_on_bias_deg_per_h + spec.gyro_bias_instability_deg_per_h) * _DEG_PER_H
        earth = R.T @ np.array([0.0, EARTH_RATE * math.cos(lat), EARTH_RATE * math.sin(lat)])
        seconds = self.rest[1] * self.config.alignment.window_s
        white = self.par.noise.gyro_psd / seconds
        return self.rest[0] / self.rest[1] - earth, math.sqrt(
            white + self.par.noise.gyro_bias_var + (5 * _DEG_PER_H) ** 2
        )


def _accel_bias_sigma(spec: ImuSpec) -> float:
    return (spec.accel_turn_on_bias_mg + spec.accel_bias_instability_mg) * _MG
