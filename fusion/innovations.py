"""What a run's innovations say by themselves: whether they are as large as stated, and how long they last.

A filter that is right about its noise leaves white innovations of the variance that it states (Mehra 1970,
doi:10.1109/TAC.1970.1099422). The reverse does not hold for errors that last: the filter follows them, and what is left
understates them. ``fusion.adaptive`` asks which noise makes the innovations likely instead.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.result import Decisions, Reason, Sensor
from sensors.clock import NS_PER_S

Floats = NDArray[np.float64]

AXES: Mapping[Sensor, Mapping[str, tuple[int, ...]]] = {
    Sensor.GNSS_POSITION: {"horizontal": (0, 1), "vertical": (2,)},
    Sensor.GNSS_VELOCITY: {"horizontal": (0, 1), "vertical": (2,)},
    Sensor.GNSS_YAW: {"yaw": (0,)},
    Sensor.POSE_FIX: {"longitudinal": (0,), "lateral": (1,), "yaw": (2,)},
    Sensor.WHEEL: {"forward": (0,)},
}
"""Components of a sensor's innovation that are judged together."""
LONGEST_LAG = 400
"""Of the autocovariance, in innovations."""
FEWEST = 50
"""Innovations of which something can be said."""
TIMES = 60
"""Correlation times that are tried."""


@dataclass(frozen=True, slots=True)
class AxisInnovations:
    """One axis of a sensor's applied measurements, each innovation over its stated sigma.

    count; factor: their mean square, 1 where the sigma is right, and its standard deviation (which knows how long they
    last); share: part of it that lasts from one innovation to the next, and correlation_s, how long (None: white).
    """

    sensor: Sensor
    axis: str
    count: int
    factor: float
    factor_error: float
    share: float
    correlation_s: float | None


def consistency(decisions: Decisions) -> tuple[AxisInnovations, ...]:
    """Every axis with at least FEWEST innovations. Partly accepted fixes have no axes and are left out."""
    return tuple(_axes(decisions))


def _axes(decisions: Decisions) -> Iterator[AxisInnovations]:
    applied = decisions.reason == Reason.ACCEPTED
    for sensor, axes in AXES.items():
        rows = np.flatnonzero(applied & (decisions.sensor == sensor))
        for axis, members in axes.items():
            scores = (decisions.innovation[rows] / decisions.innovation_sigma[rows])[:, members]
            known = np.isfinite(scores).all(axis=1)
            if known.sum() >= FEWEST:
                yield _judged(sensor, axis, decisions.t_ns[rows][known], scores[known])


def _judged(sensor: Sensor, axis: str, t_ns: NDArray[np.int64], scores: Floats) -> AxisInnovations:
    step = max(float(np.median(np.diff(t_ns))), 1.0)
    covariance, pairs = autocovariance(t_ns, scores, step)
    correlation = covariance / covariance[0]
    # of a mean square of Gaussian numbers (Bartlett 1946)
    together = 1.0 + 2.0 * float((correlation[1:] ** 2).sum())
    factor = float(covariance[0])
    share, lasts = _exponential(correlation[1:], pairs[1:])
    times = step / NS_PER_S
    return AxisInnovations(
        sensor,
        axis,
        len(scores),
        factor,
        factor * float(np.sqrt(2.0 * together / scores.size)),
        share,
        None if lasts is None else lasts * times,
    )


def autocovariance(t_ns: NDArray[np.int64], scores: Floats, step_ns: float) -> tuple[Floats, Floats]:
    """(L,) mean products (about zero) of (N, C) scores that are 0, 1, .. L - 1 steps apart, and (L,) how many pairs.

    Pairs across pauses, whose stamps are not so many steps apart to half a step, do not count.
    """
    lags = min(LONGEST_LAG, len(scores) // 4)
    products, pairs = np.zeros(lags), np.zeros(lags)
    for lag in range(lags):
        apart = (t_ns[lag:] - t_ns[: len(t_ns) - lag]) / step_ns
        even = np.abs(apart - lag) < 0.5
        pairs[lag] = even.sum()
        if pairs[lag]:
            products[lag] = float((scores[lag:] * scores[: len(scores) - lag])[even].mean())
    return products, pairs


def _exponential(correlation: Floats, pairs: Floats) -> tuple[float, float | None]:
    """Share and time (in steps) of share * exp(-lag / time) through correlations at lags 1, 2, ..; (0, None): white.

    Up to where they fall below a fifth of the first: what follows is the estimate's own noise, which lasts as well.
    """
    below = correlation < 0.2 * correlation[0]
    ends = max(int(np.argmax(below)) if below.any() else len(correlation), 5)
    correlation, pairs = correlation[:ends], pairs[:ends]
    lag = np.arange(1, len(correlation) + 1)
    best, found = float((pairs * correlation**2).sum()), (0.0, None)
    white = best
    for time in np.geomspace(1.0, LONGEST_LAG, TIMES):
        shape = np.exp(-lag / time)
        share = float((pairs * shape * correlation).sum() / (pairs * shape**2).sum())
        misfit = float((pairs * (correlation - np.clip(share, 0.0, 1.0) * shape) ** 2).sum())
        if share > 0 and misfit < best:
            best, found = misfit, (min(share, 1.0), float(time))  # type: ignore[assignment]
    return found if white - best > 9.0 else (0.0, None)


def joint(decisions: Decisions, sensors: Sequence[Sensor], after_ns: int) -> tuple[Floats, Floats]:
    """(M, 3) innovations and (M, 3) variances of the sensors' applied measurements after a time, zero and one where a
    component is not there: they add nothing to a likelihood."""
    rows = (decisions.reason == Reason.ACCEPTED) & np.isin(decisions.sensor, sensors) & (decisions.t_ns > after_ns)
    value, sigma = decisions.innovation[rows], decisions.innovation_sigma[rows]
    there = np.isfinite(value) & (sigma > 0)
    return np.where(there, value, 0.0), np.where(there, sigma, 1.0) ** 2
