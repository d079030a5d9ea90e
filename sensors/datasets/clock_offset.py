"""How long before its stamp a GNSS value was true on the IMU's clock, from the data alone.

Every window of the drive is fitted by strapdown integration of the IMU (``inertial_fit``); the delay is where the
summed squared residuals are smallest. Unlike the lag between gyro and course it needs no vehicle model: the course of
a point ahead of the rear axle leads the heading by distance / speed, a tenth of a second in town.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sensors.datasets.inertial_fit import Kind, Strapdown, Window, fit_window
from sensors.errors import EgolocError

Floats = NDArray[np.float64]

COARSE_S = 0.05
"""Step of the first scan, s."""
FINE_S = 0.01
"""Half-width of the parabola that refines it, s."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """delay_s: the values are true this long before their stamp, on the IMU's clock; sigma_s from the scatter of the
    windows (jackknife); windows: how many were fitted; rms: of the residuals at the minimum, m or m/s."""

    delay_s: float
    sigma_s: float
    windows: int
    rms: float


def estimate_clock_offset(
    path: Strapdown,
    t_ns: NDArray[np.int64],
    values: Floats,
    sigma: Floats,
    windows: list[NDArray[np.int64]],
    kind: Kind,
    search_s: float = 0.6,
) -> ClockOffset:
    """Delay of values (N, 3) ENU m or m/s with sigma (N, 3), within +-search_s.

    windows: row groups, e.g. of ``inertial_fit.moving_windows``.
    """

    def fits(delay: float) -> list[Window | None]:
        return [fit_window(path, t_ns, values, sigma, rows, delay, kind) for rows in windows]

    grid = np.arange(-search_s, search_s + COARSE_S / 2, COARSE_S)
    costs = _costs([fits(d) for d in grid])
    if costs.shape[1] < 3:
        raise EgolocError(f"clock offset: {costs.shape[1]} usable windows of moving {kind}, at least 3 are needed")
    best = float(grid[np.argmin(costs.sum(axis=1))])
    near = best + np.array([-2, -1, 0, 1, 2]) * FINE_S
    for _ in range(8):
        final = [fits(d) for d in near]
        curves = _costs(final)
        delay = _minimum(near, curves.sum(axis=1))
        if near[0] <= delay <= near[-1]:
            break
        near = near + np.sign(delay - near[2]) * 2 * FINE_S
    leave_one_out = np.array([_minimum(near, curves.sum(axis=1) - curve) for curve in curves.T])
    n = len(leave_one_out)
    jackknife = float(np.sqrt((n - 1) / n * np.sum((leave_one_out - leave_one_out.mean()) ** 2)))
    residuals = np.concatenate([w.residual for w in final[2] if w is not None])
    return ClockOffset(delay, jackknife, n, float(np.sqrt(np.mean(residuals**2))))


def velocity_lag(t_ns: NDArray[np.int64], position: Floats, velocity: Floats, search_s: float = 0.5) -> float:
    """How long a receiver's velocity lags behind its own positions (same stamps, (N, 3) ENU), s; 0 if too short."""
    t = (t_ns - t_ns[0]) * 1e-9
    slope = CubicSpline(t, position).derivative()
    inner = (t > t[0] + search_s + 1) & (t < t[-1] - search_s - 1)
    if inner.sum() < 20:
        return 0.0
    lags = np.arange(-search_s, search_s + 0.005, 0.01)
    costs = np.array([np.mean((velocity[inner] - slope(t[inner] - lag))[:, :2] ** 2) for lag in lags])
    middle = int(np.clip(np.argmin(costs), 1, len(lags) - 2))
    return _minimum(lags[middle - 1 : middle + 2], costs[middle - 1 : middle + 2])


def _costs(scan: list[list[Window | None]]) -> Floats:
    """(delays, windows) costs of the windows that could be fitted at every delay."""
    usable = [i for i in range(len(scan[0])) if all(fits[i] is not None for fits in scan)]
    return np.array([[fit.cost for i in usable if (fit := fits[i]) is not None] for fits in scan])


def _minimum(x: Floats, y: Floats) -> float:
    """Vertex of the parabola through the points (least squares); the lowest point where it opens downwards."""
    a, b, _ = np.polyfit(x - x.mean(), y, 2)
    return float(x.mean() - b / (2 * a)) if a > 0 else float(x[np.argmin(y)])
