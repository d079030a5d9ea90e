"""Random processes and time grids of the simulated sensors; what goes on from piece to piece is a class."""

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.simulate import _sensor_kernels

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Rng = np.random.Generator


def stream(seed: int, name: str) -> Rng:
    """Random numbers of one component: they do not change when another component's config does."""
    return np.random.default_rng([seed, *name.encode()])


def stamps(start_ns: int, duration_s: float, rate_hz: float, phase_s: float = 0.0) -> Nanoseconds:
    """(N,) times at a constant rate from start_ns + phase_s to start_ns + duration_s."""
    return rows_between(start_ns, duration_s, rate_hz, phase_s, 0.0, np.inf)


def rows_between(
    start_ns: int, duration_s: float, rate_hz: float, phase_s: float, begin_s: float, end_s: float
) -> Nanoseconds:
    """Those of the stamps that lie in [begin_s, end_s) after start_ns."""
    count = max(int((duration_s - phase_s) * rate_hz + 1e-6) + 1, 0)
    first = min(max(int((begin_s - phase_s) * rate_hz) - 1, 0), count)
    last = count if end_s > duration_s else min(max(int((end_s - phase_s) * rate_hz) + 2, 0), count)
    grid = np.rint(np.arange(first, last) * (NS_PER_S / rate_hz)).astype(np.int64) + round(phase_s * NS_PER_S)
    inside = grid >= round(begin_s * NS_PER_S)
    if np.isfinite(end_s):
        inside &= grid < round(end_s * NS_PER_S)
    result: Nanoseconds = grid[inside] + start_ns
    return result


def gauss_markov(rng: Rng, count: int, step: float, correlation: float) -> Floats:
    """(count,) stationary first-order Gauss-Markov process of unit variance; correlation: in step's unit, 0: white.

    Exact for any step: x[k] = a x[k-1] + sqrt(1 - a^2) w[k], a = exp(-step / correlation).
    """
    return GaussMarkov(rng, 1, step, correlation).rows(count)[:, 0]


class GaussMarkov:
    """Independent first-order Gauss-Markov processes of unit variance, as gauss_markov, some rows at a time."""

    def __init__(self, rng: Rng, columns: int, step: float, correlation: float) -> None:
        self._rng = rng
        self._memory = float(np.exp(-step / correlation)) if correlation > 0 else 0.0
        self._last = np.full(columns, np.nan)

    def rows(self, count: int) -> Floats:
        """The next (count, columns)."""
        process = self._rng.standard_normal((count, len(self._last)))
        if count:
            _sensor_kernels.first_order(process, self._memory, self._last)
        return process


class Delay:
    """Arrival times: later by a normal delay (within 3 sigma), never before the measurement or out of order."""

    def __init__(self, delay_s: float, jitter_s: float, rng: Rng) -> None:
        self._delay_s, self._jitter_s, self._rng = delay_s, jitter_s, rng
        self._last = np.iinfo(np.int64).min

    def arrivals(self, t_ns: Nanoseconds) -> Nanoseconds:
        """(N,) arrival times of the measurements at t_ns (N,), which follow the last ones."""
        jitter = np.clip(self._rng.standard_normal(len(t_ns)), -3.0, 3.0) * self._jitter_s
        late = np.rint(np.maximum(self._delay_s + jitter, 0.0) * NS_PER_S).astype(np.int64)
        result: Nanoseconds = np.maximum(np.maximum.accumulate(t_ns + late), self._last)
        if len(result):
            self._last = int(result[-1])
        return result
