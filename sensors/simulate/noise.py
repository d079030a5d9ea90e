"""Random processes and time grids that the simulated sensors share."""

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.simulate import _kernels

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Rng = np.random.Generator


def stream(seed: int, name: str) -> Rng:
    """Random numbers of one component: they do not change when another component's config does."""
    return np.random.default_rng([seed, *name.encode()])


def stamps(start_ns: int, duration_s: float, rate_hz: float, phase_s: float = 0.0) -> Nanoseconds:
    """(N,) times at a constant rate from start_ns + phase_s to start_ns + duration_s."""
    count = int((duration_s - phase_s) * rate_hz + 1e-6) + 1
    grid: Nanoseconds = np.rint(np.arange(max(count, 0)) * (NS_PER_S / rate_hz)).astype(np.int64)
    return grid + (start_ns + round(phase_s * NS_PER_S))


def gauss_markov(rng: Rng, count: int, step: float, correlation: float) -> Floats:
    """(count,) stationary first-order Gauss-Markov process of unit variance; correlation: in step's unit, 0: white.

    Exact for any step: x[k] = a x[k-1] + sqrt(1 - a^2) w[k], a = exp(-step / correlation).
    """
    process = rng.standard_normal(count)
    if correlation > 0:
        a = float(np.exp(-step / correlation))
        process[1:] *= np.sqrt(1.0 - a * a)
        _kernels.first_order(process, a)
    return process


def correlated(rng: Rng, count: int, step: float, correlation: float, fraction: float) -> Floats:
    """(count,) errors of unit variance, of which fraction is Gauss-Markov and the rest white."""
    slow, white = gauss_markov(rng, count, step, correlation), rng.standard_normal(count)
    result: Floats = np.sqrt(fraction) * slow + np.sqrt(1.0 - fraction) * white
    return result


def delayed(t_ns: Nanoseconds, delay_s: float, jitter_s: float, rng: Rng) -> Nanoseconds:
    """(N,) arrival times: later by a normal delay (within 3 sigma), never before the measurement or out of order."""
    jitter = np.clip(rng.standard_normal(len(t_ns)), -3.0, 3.0) * jitter_s
    late = np.rint(np.maximum(delay_s + jitter, 0.0) * NS_PER_S).astype(np.int64)
    result: Nanoseconds = np.maximum.accumulate(t_ns + late)
    return result
