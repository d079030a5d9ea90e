"""Simulated IMU: exact rate and specific force, plus the errors of a datasheet."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import NonNegative
from sensors.records import Imu
from sensors.simulate.noise import Rng, gauss_markov
from sensors.simulate.trajectory import Truth
from sensors.vehicle import ImuSpec

Floats = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665
"""What datasheets call g, m/s^2."""


class ImuSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the IMU is sampled; its errors are those of the vehicle's ImuSpec."""

    rate_hz: Annotated[float, msgspec.Meta(ge=10.0)] = 100.0
    """Sample rate, Hz."""
    errors: bool = True
    """Add the datasheet's biases and noise; without: exact samples."""
    delay_s: NonNegative = 0.001
    """From measurement to arrival, s."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuBiases:
    """True biases at the IMU's stamps (sample = truth + bias + noise). gyro: (N, 3) rad/s; accel: (N, 3) m/s^2."""

    gyro: Floats
    accel: Floats


def simulate_imu(
    truth: Truth, t_ns: NDArray[np.int64], spec: ImuSpec, rng: Rng | None, delay_s: float = 0.0
) -> tuple[Imu, ImuBiases]:
    """Samples at t_ns (N >= 2, evenly spaced) and their true biases; without rng: no errors. delay_s: to their arrival.

    spec.samples says whether a sample is instantaneous or the mean over the interval that ends at its stamp.
    White noise has the datasheet's density at any rate; a bias is a turn-on constant plus a Gauss-Markov process.
    """
    interval_s = float(np.median(np.diff(t_ns))) * 1e-9
    gyro, accel = truth.inertial_means(t_ns, interval_s) if spec.samples == "increment" else truth.inertial(t_ns)
    biases = ImuBiases(np.zeros_like(gyro), np.zeros_like(accel))
    if rng is not None:
        degrees, milli_g = np.pi / 180, STANDARD_GRAVITY / 1000
        gyro_errors = _Errors(
            turn_on=spec.gyro_turn_on_bias_deg_per_h * degrees / 3600,
            drift=spec.gyro_bias_instability_deg_per_h * degrees / 3600,
            density=spec.gyro_noise_deg_per_sqrt_h * degrees / 60,
            time_constant_s=spec.bias_time_constant_s,
        )
        accel_errors = _Errors(
            turn_on=spec.accel_turn_on_bias_mg * milli_g,
            drift=spec.accel_bias_instability_mg * milli_g,
            density=spec.accel_noise_m_per_s_per_sqrt_h / 60,
            time_constant_s=spec.bias_time_constant_s,
        )
        _add_errors(gyro, biases.gyro, interval_s, gyro_errors, rng)
        _add_errors(accel, biases.accel, interval_s, accel_errors, rng)
    return Imu(t_ns, t_ns + round(delay_s * 1e9), gyro, accel), biases


class _Errors(NamedTuple):
    """A datasheet in SI: standard deviations of both biases, density of the white noise per sqrt(Hz)."""

    turn_on: float
    drift: float
    density: float
    time_constant_s: float


def _add_errors(samples: Floats, biases: Floats, interval_s: float, errors: _Errors, rng: Rng) -> None:
    """Fill biases (N, 3) and add them and white noise to samples (N, 3), axis by axis."""
    count = len(samples)
    for axis in range(3):
        constant = errors.turn_on * rng.standard_normal()
        biases[:, axis] = constant + errors.drift * gauss_markov(rng, count, interval_s, errors.time_constant_s)
        samples[:, axis] += biases[:, axis] + (errors.density / np.sqrt(interval_s)) * rng.standard_normal(count)
