"""Simulated wheel speed: forward speed of the rear axle with a scale error and white noise."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import NonNegative, Positive
from sensors.records import WheelSpeed
from sensors.rotation import matrix_from_q
from sensors.simulate.noise import Rng, delayed
from sensors.simulate.trajectory import Truth
from sensors.vehicle import Vehicle


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


def simulate_wheel(
    truth: Truth, t_ns: NDArray[np.int64], vehicle: Vehicle, config: WheelSimulation, rng: Rng
) -> WheelSpeed:
    """Wheel speeds at t_ns (N,); the stated sigma covers noise and scale error."""
    forward = np.empty(len(t_ns))
    for rows, motion in truth.chunks(t_ns):
        axis = matrix_from_q(motion.q_enu_body)[:, :, 0]
        forward[rows] = np.einsum("ni,ni->n", axis, motion.velocity_of(vehicle.rear_axle))
    scale = 1.0 + config.scale_sigma * rng.standard_normal()
    speed = scale * forward + np.where(forward == 0.0, 0.0, config.sigma) * rng.standard_normal(len(forward))
    sigma = np.hypot(config.sigma, config.scale_sigma * forward)
    return WheelSpeed(t_ns, delayed(t_ns, config.delay_s, config.jitter_s, rng), speed, sigma)
