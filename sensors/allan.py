"""Overlapping Allan deviation of an inertial sensor at rest, and the noise that explains it.

The deviation over an averaging time tau is how far means over neighbouring stretches of that length differ (IEEE Std
952-2020, annex C; NIST SP 1065, eq. 10). It is three lines, so no library is asked for it: allantools (LGPL) brings
matplotlib, pytest and numpydoc along and a second of import; tests hold these lines to NIST's published figures.

The model is the filter's: white noise and a first-order Gauss-Markov drift, besides quantization. Its Allan variance is
fitted to the measured one, each point weighted by how many stretches it rests on: the generalized method of wavelet
moments (Guerrier et al. 2013, doi:10.1080/01621459.2013.799920) with the Haar wavelet.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from sensors.errors import EgolocError

Floats = NDArray[np.float64]

LEAST_CLUSTERS = 5
"""The longest averaging time that is looked at fits into the record so often."""
FLICKER = 0.6642824703
"""Deviation of flicker noise over its coefficient: sqrt(2 ln 2 / pi) (IEEE Std 952, C.1.2.3)."""
DRIFT_SPAN_S = 600.0
"""In a shorter record a drift is not told from settling, wind and people: only noise is looked for, s."""
SHORTEST_DRIFT_S = 3.0
"""A drift faster than this is not told from vibration, s."""
PER_DECADE = 48
"""Time constants that are tried in each decade."""
SHARED = 2.0
"""Neighbouring octaves share part of what they show: over simulated records the errors of fits that took them as
independent were 1.2 to 1.45 times as large as stated. Freedom is divided by this."""
ROUNDS = 6
"""Of the fit: weights follow the model of the round before."""


@dataclass(frozen=True, slots=True, eq=False)
class AllanCurve:
    """tau: (K,) s, octaves of the sampling interval; variance: (K, C) of each axis, unit^2; clusters: (K,) stretches of
    tau in the record; span_s: its length."""

    tau: Floats
    variance: Floats
    clusters: Floats
    span_s: float

    @property
    def error(self) -> Floats:
        """(K,) relative standard deviation of the deviation: 1 / sqrt(2 (clusters - 1)) (IEEE Std 952, eq. C.20)."""
        result: Floats = 1.0 / np.sqrt(2.0 * (self.clusters - 1.0))
        return result


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """What explains an Allan curve, in the sensor's unit u (rad/s, m/s^2); `*_error`: one standard deviation.

    random_walk: of the integral, u sqrt(s); drift_rate: driving noise of the drift, u/sqrt(s), the coefficient of rate
    random walk on times far below its time constant; drift_sigma u and drift_time_s: the Gauss-Markov process, inf
    where the record is too short to show that the drift ever turns back; quantization: u s. A drift_rate of 0: none
    shows. instability: least deviation over 0.664, u, at instability_tau_s; where the curve still falls at its end that
    is only an upper bound (instability_reached is False).
    """

    random_walk: float
    random_walk_error: float
    drift_rate: float
    drift_rate_error: float
    drift_sigma: float
    drift_time_s: float
    drift_time_range_s: tuple[float, float]
    quantization: float
    instability: float
    instability_error: float
    instability_tau_s: float
    instability_reached: bool


def allan_curve(signal: Floats, interval_s: float) -> AllanCurve:
    """The overlapping Allan variance of (N, C) samples taken every interval_s.

    Raises EgolocError where there are fewer than 2 * LEAST_CLUSTERS samples.
    """
    count = len(signal)
    if count < 2 * LEAST_CLUSTERS:
        raise EgolocError(f"Allan deviation: expected at least {2 * LEAST_CLUSTERS} samples, got {count}")
    factors = 2 ** np.arange(int(np.log2(count // LEAST_CLUSTERS)) + 1)
    angle = np.zeros((count + 1, signal.shape[1]))
    np.cumsum(signal - signal.mean(axis=0), axis=0, out=angle[1:])
    variance = np.array([overlapping_variance(angle, int(m)) for m in factors])
    return AllanCurve(interval_s * factors.astype(np.float64), variance, count / factors, count * interval_s)


def overlapping_variance(angle: Floats, factor: int) -> Floats:
    """(C,) Allan variance over factor samples; angle: (N + 1, C) sum of the samples, unit times interval."""
    bend = angle[2 * factor :] - 2.0 * angle[factor:-factor] + angle[: -2 * factor]
    result: Floats = np.einsum("nc,nc->c", bend, bend) / (2.0 * factor**2 * len(bend))
    return result


def gauss_markov_variance(tau: Floats, time_s: float) -> Floats:
    """Allan variance of a first-order Gauss-Markov process of unit variance (IEEE Std 952, C.1.2.6).

    It is 2 tau / (3 T) far below the time constant T and 2 T / tau far above it.
    """
    x = np.asarray(tau, np.float64) / time_s
    near = 2.0 * x / 3.0 - x**2 / 2.0 + 7.0 * x**3 / 30.0
    safe = np.maximum(x, 1e-3)
    far = 2.0 / safe * (1.0 - (3.0 - 4.0 * np.exp(-safe) + np.exp(-2.0 * safe)) / (2.0 * safe))
    result: Floats = np.where(x < 1e-3, near, far)
    return result


def pooled(curve: AllanCurve) -> AllanCurve:
    """One curve of all axes: the mean of their variances, which rests on as many stretches more."""
    axes = curve.variance.shape[1]
    mean = curve.variance.mean(axis=1, keepdims=True)
    return AllanCurve(curve.tau, mean, axes * (curve.clusters - 1.0) + 1.0, curve.span_s)


def noise_of(curve: AllanCurve, axis: int = 0) -> SensorNoise:
    """The noise that explains one axis of a curve; a record below DRIFT_SPAN_S is explained without a drift."""
    variance, freedom = curve.variance[:, axis], (curve.clusters - 1.0) / SHARED
    if not (variance > 0).all():
        raise EgolocError("Allan deviation: expected noise, got samples that do not change")
    times = _times(curve)
    fits = [_fit(curve.tau, variance, freedom, time_s) for time_s in times]
    misfit = np.array([fit.misfit for fit in fits])
    best = fits[int(np.argmin(misfit))]
    likely = np.flatnonzero(misfit <= misfit.min() + 1.0)
    lowest = int(np.argmin(variance))
    deviation = np.sqrt(variance[lowest])
    long_enough = curve.span_s >= DRIFT_SPAN_S
    shows = (
        long_enough and best.drift_rate > 2.0 * best.drift_rate_error and best.misfit < _fit_white(curve, axis) - 4.0
    )
    ends = np.isinf(times[likely[-1]]) or not shows
    return SensorNoise(
        random_walk=best.random_walk,
        random_walk_error=best.random_walk_error,
        drift_rate=best.drift_rate if shows else 0.0,
        drift_rate_error=best.drift_rate_error if shows else 0.0,
        drift_sigma=float("inf") if ends else best.drift_rate * np.sqrt(best.time_s / 2.0),
        drift_time_s=float("inf") if ends else best.time_s,
        drift_time_range_s=(float(times[likely[0]]), float(times[likely[-1]])),
        quantization=best.quantization,
        instability=float(deviation / FLICKER),
        instability_error=float(curve.error[lowest] * deviation / FLICKER),
        instability_tau_s=float(curve.tau[lowest]),
        instability_reached=bool(shows and lowest < len(variance) - 1),
    )


@dataclass(frozen=True, slots=True)
class _Fit:
    """The fit for one time constant; misfit: its deviance (chi-square to second order)."""

    time_s: float
    misfit: float
    random_walk: float
    random_walk_error: float
    drift_rate: float
    drift_rate_error: float
    quantization: float


def _times(curve: AllanCurve) -> Floats:
    """Time constants to try, s: the last is a drift that never turns back; 0: no drift at all."""
    low, high = max(8.0 * curve.tau[0], SHORTEST_DRIFT_S), 2.0 * curve.span_s
    if curve.span_s < DRIFT_SPAN_S:
        return np.zeros(1)
    count = int(np.ceil(PER_DECADE * np.log10(high / low))) + 1
    return np.append(np.geomspace(low, high, count), np.inf)


def _columns(tau: Floats, time_s: float) -> Floats:
    """(K, 3) Allan variance of quantization, white noise and a drift of unit rate (IEEE Std 952, C.1.2)."""
    noise = np.stack((3.0 / tau**2, 1.0 / tau), axis=-1)
    if not time_s:
        return np.column_stack((noise, np.zeros_like(tau)))
    drift = tau / 3.0 if np.isinf(time_s) else time_s / 2.0 * gauss_markov_variance(tau, time_s)
    return np.column_stack((noise, drift))


def _fit(tau: Floats, variance: Floats, freedom: Floats, time_s: float) -> _Fit:
    """Squares of the coefficients, none below zero; a measured variance is the model's times chi-square / freedom."""
    columns = _columns(tau, time_s)
    squares, model = _solve(columns, variance, freedom)
    errors = _errors(tau, time_s, squares, np.sqrt(freedom / 2.0) / model)
    quantization, walk, rate = np.sqrt(squares)
    # the coefficient's error from its square's
    walk_error, rate_error = (errors[i] / (2.0 * x) if x > 0 else 0.0 for i, x in ((1, walk), (2, rate)))
    return _Fit(time_s, _deviance(variance, model, freedom), walk, walk_error, rate, rate_error, quantization)


def _errors(tau: Floats, time_s: float, squares: Floats, share: Floats) -> Floats:
    """(3,) standard deviations of the squares, the time constant not being known either (0: at its bound)."""
    columns = _columns(tau, time_s)
    used = np.append(squares > 0, np.isfinite(time_s) and squares[2] > 0)
    if used[3]:
        change = (_columns(tau, 1.01 * time_s) - columns)[:, 2] * squares[2] / 0.01
        columns = np.column_stack((columns, change))
    weighted = (columns * share[:, None])[:, used[: columns.shape[1]]]
    errors = np.zeros(4)
    errors[used] = np.sqrt(np.diag(np.linalg.pinv(weighted.T @ weighted)))
    return errors[:3]


def _fit_white(curve: AllanCurve, axis: int) -> float:
    """Misfit without any drift."""
    variance, freedom = curve.variance[:, axis], (curve.clusters - 1.0) / SHARED
    _, model = _solve(_columns(curve.tau, 0.0), variance, freedom)
    return _deviance(variance, model, freedom)


def _solve(columns: Floats, variance: Floats, freedom: Floats) -> tuple[Floats, Floats]:
    """Non-negative squares (n,) and the model (K,), by iteratively reweighted least squares."""
    model, squares = variance, np.zeros(columns.shape[1])
    for _ in range(ROUNDS):
        share = np.sqrt(freedom / 2.0) / model
        size = np.linalg.norm(columns * share[:, None], axis=0)
        size[size == 0.0] = 1.0
        scaled, _ = nnls(columns * share[:, None] / size, variance * share)
        squares = scaled / size
        model = np.maximum(columns @ squares, 1e-3 * variance)
    return squares, model


def _deviance(variance: Floats, model: Floats, freedom: Floats) -> float:
    """Twice the log-likelihood lost against a perfect model, of chi-square distributed variances."""
    ratio = variance / model
    return float((freedom * (ratio - 1.0 - np.log(ratio))).sum())
