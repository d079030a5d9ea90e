"""What the IMU alone says before the first state: roll and pitch by gravity, and the gyro's bias from rest."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.config import Alignment
from fusion.events import Parameters
from fusion.state import Floats
from sensors._kernels import EARTH_RATE, gravity_enu
from sensors.vehicle import ImuSpec

ImuColumns = tuple[NDArray[np.int64], Floats, Floats]
"""t (N,) ns, gyro (N, 3) rad/s, accel (N, 3) m/s^2."""

_DEG_PER_H = math.pi / 180.0 / 3600.0
_FEWEST = 10
"""IMU samples in a window, at least."""


@dataclass(frozen=True)
class Window:
    """IMU over so many seconds: gyro, accel (n, 3) in rad/s and m/s^2; whole: over the configured time, not less."""

    gyro: Floats
    accel: Floats
    seconds: float
    whole: bool

    @property
    def rate(self) -> Floats:
        """Mean rate (3,), rad/s."""
        mean: Floats = self.gyro.mean(axis=0)
        return mean

    @property
    def latest_rate(self) -> Floats:
        """Mean rate (3,) over the last samples, rad/s."""
        mean: Floats = self.gyro[-_FEWEST:].mean(axis=0)
        return mean

    @property
    def force(self) -> Floats:
        """Mean specific force (3,), m/s^2."""
        mean: Floats = self.accel.mean(axis=0)
        return mean

    def quiet(self, par: Parameters) -> bool:
        """Whether it shakes no more than at rest. Steady driving does not either, nor braking over a shorter time."""
        force_var = float(np.linalg.norm(self.accel, axis=1).var())
        return force_var < par.still_accel_var and float(self.gyro[:, 2].var()) < par.still_rate_var


def window_before(t_ns: int, imu: ImuColumns, first_imu_ns: int, config: Alignment, par: Parameters) -> Window | None:
    """Samples of (t - window_s, t]; None where they leave a gap. Less will do while the IMU has only just begun."""
    t, gyro, accel = imu
    length = round(config.window_s * 1e9)
    first, last = np.searchsorted(t, (t_ns - length, t_ns), side="right")
    if last - first < _FEWEST:
        return None
    shortest = round(config.first_window_s * 1e9) if t_ns - first_imu_ns < length else 0.8 * length
    span = t[last - 1] - t[first]
    if span < min(shortest, 0.8 * length) or np.diff(t[first:last]).max() > par.max_gap_ns:
        return None
    return Window(gyro[first:last], accel[first:last], span * 1e-9, bool(span >= 0.8 * length))


def level(
    window: Window, acceleration: Floats, sigma: float, yaw: float, lat: float, height: float
) -> tuple[float, float, float]:
    """Roll and pitch that turn the window's mean force into an acceleration minus gravity, and their sigma, rad.

    acceleration: (3,) ENU m/s^2, over the window; sigma: of its horizontal axes; yaw: from east, at the window's end.
    """
    north, up = gravity_enu(math.sin(lat), math.cos(lat), height)
    wanted = np.array([0.0, -north, -up]) + acceleration
    middle = yaw - window.rate[2] * window.seconds / 2.0
    c, s = math.cos(middle), math.sin(middle)
    ahead, left, above = c * wanted[0] + s * wanted[1], c * wanted[1] - s * wanted[0], wanted[2]
    fx, fy, fz = window.force
    # Rx(roll) leaves x and brings y to `left`; Ry(pitch) then turns (x, z) onto (ahead, above)
    roll = math.atan2(fy, fz) - math.asin(float(np.clip(left / math.hypot(fy, fz), -1.0, 1.0)))
    lifted = fy * math.sin(roll) + fz * math.cos(roll)
    pitch = math.atan2(ahead, above) - math.atan2(fx, lifted)
    return roll, pitch, sigma / above


@dataclass
class Rest:
    """Mean rates of windows at rest that do not overlap, each over window_s."""

    window_s: float
    total: Floats | None = None
    count: int = 0
    until_ns: int = 0

    def add(self, t_ns: int, window: Window) -> None:
        """Take a window at rest that ends at t_ns, unless it overlaps the last one."""
        if t_ns >= self.until_ns:
            self.total = window.rate if self.total is None else self.total + window.rate
            self.count += 1
            self.until_ns = t_ns + round(self.window_s * 1e9)

    def gyro_bias(self, spec: ImuSpec, par: Parameters, R: Floats, lat: float) -> tuple[Floats, float]:
        """Bias (mean rate minus the earth's) at attitude R and its sigma, rad/s: zero and turn-on without rest."""
        if self.total is None:
            return np.zeros(3), (spec.gyro_turn_on_bias_deg_per_h + spec.gyro_bias_instability_deg_per_h) * _DEG_PER_H
        earth = R.T @ np.array([0.0, EARTH_RATE * math.cos(lat), EARTH_RATE * math.sin(lat)])
        white = par.noise.gyro_psd / (self.count * self.window_s)
        return self.total / self.count - earth, math.sqrt(white + par.noise.gyro_bias_var + (5 * _DEG_PER_H) ** 2)
