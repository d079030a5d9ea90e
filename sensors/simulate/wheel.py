"""Simulated wheel speed: forward speed of the rear axle with scale error, drift, slip, quantization and white noise."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import NonNegative, Positive
from sensors.clock import seconds
from sensors.records import WheelSpeed
from sensors.simulate.course import Course
from sensors.simulate.noise import Delay, Rng, gauss_markov
from sensors.simulate.trajectory import Truth
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]

DRIFT_NODE_S = 10.0
"""The scale's drift is a straight line over this long."""


class WheelSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Wheel odometry from the vehicle's bus."""

    use: bool = True
    """Simulate wheel speeds at all."""
    rate_hz: Positive = 50.0
    """Rate, Hz."""
    delay_s: NonNegative = 0.01
    """From measurement to arrival, s."""
    jitter_s: NonNegative = 0.001
    """Standard deviation of that delay, s."""
    sigma: Positive = 0.05
    """White noise while moving, m/s; a wheel at rest reads exactly zero."""
    scale_sigma: NonNegative = 0.003
    """Standard deviation of the constant scale error (tyre radius), -."""
    drift_sigma: NonNegative = 0.0
    """Standard deviation of the scale's drift with temperature and pressure, -."""
    drift_s: Positive = 1800.0
    """Correlation time of that drift, s."""
    quantum: NonNegative = 0.0
    """Step of the speeds on the bus; 0: none, m/s."""
    slip_above: NonNegative = 1.5
    """Wheels slip beyond this acceleration or braking, m/s^2."""
    slip_per_accel: NonNegative = 0.0
    """Slip for every m/s^2 beyond it: the wheels run ahead under power and behind under braking, 1/(m/s^2)."""


class WheelSensor:
    """Wheel speeds over one drive, some at a time; the stated sigma covers noise, scale error and drift."""

    def __init__(self, truth: Truth, course: Course, vehicle: Vehicle, config: WheelSimulation, rng: Rng) -> None:
        self._truth, self._course, self._vehicle, self._config = truth, course, vehicle, config
        drawn, self._noise, late = rng.spawn(3)
        nodes = int((course.t_ns[-1] - course.t_ns[0]) * 1e-9 / DRIFT_NODE_S) + 2
        drift = config.drift_sigma * gauss_markov(drawn, nodes, DRIFT_NODE_S, config.drift_s)
        self._scale = 1.0 + config.scale_sigma * drawn.standard_normal() + drift
        self._scale_at = DRIFT_NODE_S * np.arange(nodes)
        self._delay = Delay(config.delay_s, config.jitter_s, late)

    def sense(self, t_ns: NDArray[np.int64]) -> WheelSpeed:
        """Wheel speeds at t_ns (N,), which follow the last ones."""
        config = self._config
        forward = self._truth.forward_speed(t_ns, self._vehicle.rear_axle)
        t = seconds(t_ns, self._course.t_ns[0])
        scale = np.interp(t, self._scale_at, self._scale)
        if config.slip_per_accel:
            scale += self._slip(t)
        noise = np.where(forward == 0.0, 0.0, config.sigma) * self._noise.standard_normal(len(t_ns))
        speed = scale * forward + noise
        if config.quantum:
            speed = np.rint(speed / config.quantum) * config.quantum
        sigma = np.hypot(config.sigma, np.hypot(config.scale_sigma, config.drift_sigma) * forward)
        return WheelSpeed(t_ns, self._delay.arrivals(t_ns), speed, sigma)

    def _slip(self, t: Floats) -> Floats:
        """(N,) slip under the acceleration along the course."""
        known = seconds(self._course.t_ns, self._course.t_ns[0])
        accel = np.interp(t, known, np.gradient(np.gradient(self._course.s, known), known))
        beyond = np.maximum(np.abs(accel) - self._config.slip_above, 0.0)
        slip: Floats = self._config.slip_per_accel * np.sign(accel) * beyond
        return slip
