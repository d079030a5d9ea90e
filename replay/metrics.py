"""Availability ratio and errors of localization outputs, as defined in docs/metrics.md. Pure functions over arrays.

Errors are (N, 3): longitudinal m, lateral m, yaw rad; estimate minus reference; NaN where an axis is not estimated.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.config import Limits
from sensors.clock import NS_PER_S

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Nanoseconds = NDArray[np.int64]

THRESHOLDS = {"lon": (0.1, 0.2, 0.3), "lat": (0.1, 0.2, 0.3), "yaw": (0.1, 0.3, 0.6)}
"""m, m, deg."""
COVER_PERIODS = 1.5
"""A sample covers at most this many nominal periods."""
SIGMA_SHARE = 1 / 3
"""The reference's sigma must not exceed this share of the limit."""
LARGEST_ERROR = 1e100
"""What a diverged filter is off at most: its square is still a number."""
MIN_EVALUATED_NS = 10 * NS_PER_S
"""With less evaluated time than this nothing is said."""
MIN_DISTANCE_M = 1.0
"""With less evaluated distance than this there is no distance-weighted ratio, m."""


def cover_ns(t_ns: Nanoseconds, nominal_ns: float | None = None) -> Floats:
    """(N,) ns that each sample stands for: back to the one before it, COVER_PERIODS nominal periods at most.

    nominal_ns: the period, or None for the median of the samples' own. The first sample covers nothing. Whole
    nanoseconds are exact in float64 over 100 days.
    """
    steps = np.diff(t_ns).astype(np.float64)
    nominal = nominal_ns if nominal_ns is not None else float(np.median(steps)) if len(steps) else 0.0
    result: Floats = np.minimum(np.r_[0.0, steps], COVER_PERIODS * nominal)[: len(t_ns)]
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Span:
    """The evaluated time: pieces ]end - cover, end] of it, each with how much of it (0 or all) is evaluated.

    edges: (2 N,) ns since origin_ns; time, distance: (2 N,) ns and m evaluated up to each edge.
    """

    origin_ns: int
    edges: Floats
    time: Floats
    distance: Floats

    @property
    def total_ns(self) -> float:
        return float(self.time[-1]) if len(self.time) else 0.0

    @property
    def total_m(self) -> float:
        return float(self.distance[-1]) if len(self.distance) else 0.0

    def weights(self, t_ns: Nanoseconds, cover: Floats) -> tuple[Floats, Floats]:
        """(N,) evaluated ns and (N,) evaluated m within cover (N,) ns before each time."""
        if not len(self.edges):
            return np.zeros(len(t_ns)), np.zeros(len(t_ns))
        end = (t_ns - self.origin_ns).astype(np.float64)
        upto = [
            (np.interp(end, self.edges, y), np.interp(end - cover, self.edges, y)) for y in (self.time, self.distance)
        ]
        return upto[0][0] - upto[0][1], upto[1][0] - upto[1][1]


def evaluated_span(t_ns: Nanoseconds, evaluated: Mask, speed: Floats, period_ns: float) -> Span:
    """The span of a grid of increasing epochs t_ns (N,), of which some are evaluated; speed: (N,) m/s, reference."""
    if not len(t_ns):
        return Span(0, *(np.empty(0) for _ in range(3)))
    cover = cover_ns(t_ns, period_ns)
    time = np.where(evaluated, cover, 0.0)
    distance = np.where(evaluated & np.isfinite(speed), cover * speed / NS_PER_S, 0.0)
    ends = (t_ns - t_ns[0]).astype(np.float64)
    edges = np.stack((ends - cover, ends), axis=-1).ravel()
    return Span(int(t_ns[0]), edges, *(np.repeat(np.cumsum(np.r_[0.0, y]), 2)[1:-1] for y in (time, distance)))


def well_known(sigma: Floats, limits: Limits, *, yaw: bool) -> tuple[Mask, Mask]:
    """Which epochs (N,) have a reference well below the limits, in position and in yaw.

    sigma: (N, 2) m and rad; NaN (unknown) passes.
    """
    position = ~(sigma[:, 0] > SIGMA_SHARE * min(limits.lon_m, limits.lat_m))
    return position, ~(sigma[:, 1] > SIGMA_SHARE * np.radians(limits.yaw_deg)) if yaw else np.ones(len(sigma), bool)


def axis_metrics(error: Floats, thresholds: tuple[float, ...]) -> dict[str, Any] | None:
    """MAE, RMSE, percentiles and shares below thresholds of the finite errors (N,); None if there is none."""
    size = np.sort(np.minimum(np.abs(error[np.isfinite(error)]), LARGEST_ERROR))
    if not len(size):
        return None
    p50, p95, p99 = np.percentile(size, (50, 95, 99))
    return {
        "mae": float(size.mean()),
        "rmse": float(np.sqrt(np.mean(size * size))),
        "p50": float(p50),
        "p95": float(p95),
        "p99": float(p99),
        "max": float(size[-1]),
        "below": {f"{t:g}": float(np.searchsorted(size, t, side="left") / len(size)) for t in thresholds},
    }


def within_limits(error: Floats, limits: Limits, *, yaw: bool) -> Mask:
    """(N,) all estimated axes below their limits; NaN is not."""
    inside: Mask = (np.abs(error[:, 0]) < limits.lon_m) & (np.abs(error[:, 1]) < limits.lat_m)
    return inside & (np.abs(error[:, 2]) < np.radians(limits.yaw_deg)) if yaw else inside


NOT_EVALUATED: Mapping[str, None] = dict.fromkeys(("ar", "ar_distance", "coverage", "lon", "lat", "yaw"))


def method_metrics(
    error: Floats, time: Floats, distance: Floats, total_ns: float, total_m: float, limits: Limits
) -> dict[str, Any]:
    """One method's entry of metrics.json.

    error: (N, 3) of its outputs; time, distance: (N,) evaluated ns and m that each stands for (0: not evaluated);
    total_ns, total_m: all evaluated time and distance. An axis without a finite error is not estimated: left out of AR.
    """
    if total_ns <= 0:
        return dict(NOT_EVALUATED)
    scored = (time > 0) & np.isfinite(error[:, :2]).all(axis=1)
    error, time, distance = error[scored], time[scored], distance[scored]
    yaw = axis_metrics(np.degrees(error[:, 2]), THRESHOLDS["yaw"])
    good = within_limits(error, limits, yaw=yaw is not None)
    return {
        "ar": _share(time[good].sum(), total_ns),
        "ar_distance": _share(distance[good].sum(), total_m) if total_m >= MIN_DISTANCE_M else None,
        "coverage": _share(time.sum(), total_ns),
        "lon": axis_metrics(error[:, 0], THRESHOLDS["lon"]),
        "lat": axis_metrics(error[:, 1], THRESHOLDS["lat"]),
        "yaw": yaw,
    }


def _share(part: float, whole: float) -> float:
    """A ratio whose rounding errors do not leave 0..1."""
    return float(min(part / whole, 1.0))
