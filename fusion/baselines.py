"""Velocity from positions a short time apart, and steps of a few metres on the ellipsoid."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from fusion.state import Floats
from sensors.geodesy import meridian_radius, transverse_radius

_LONGEST_BASELINE_S = 2.0
"""Positions further apart give no velocity, s."""


@dataclass(frozen=True)
class Fix:
    """Latest measurement of a kind: t_ns, value, covariance."""

    t_ns: int
    value: Floats
    cov: Floats


def over_best_baseline(fixes: deque[Fix]) -> Fix | None:
    """Velocity from an older fix to the last one.

    A short baseline shows the fixes' noise, a long one the acceleration in between (1 m/s^2): the smaller sum wins.
    """
    best, least = None, math.inf
    for older in fixes:
        dt = (fixes[-1].t_ns - older.t_ns) * 1e-9
        if 0.0 < dt <= _LONGEST_BASELINE_S:
            variance = (fixes[-1].cov[0, 0] + older.cov[0, 0]) / dt**2 + (0.5 * dt) ** 2
            if variance < least:
                best, least = older, variance
    return None if best is None else _velocity_between(best, fixes[-1])


def _velocity_between(older: Fix, last: Fix) -> Fix:
    dt = (last.t_ns - older.t_ns) * 1e-9
    cov = (last.cov + older.cov) / dt**2 + np.eye(3) * (0.5 * dt) ** 2
    return Fix(last.t_ns, enu_between(older.value, last.value) / dt, cov)


def enu_between(a: Floats, b: Floats) -> Floats:
    """ENU metres from a to b, two llh nearby."""
    return np.array(
        [
            (b[1] - a[1]) * (float(transverse_radius(a[0])) + a[2]) * math.cos(a[0]),
            (b[0] - a[0]) * (float(meridian_radius(a[0])) + a[2]),
            b[2] - a[2],
        ]
    )


def moved(llh: Floats, enu: Floats) -> Floats:
    """llh moved by a few ENU metres."""
    lat, lon, h = llh
    return np.array(
        [
            lat + enu[1] / (float(meridian_radius(lat)) + h),
            lon + enu[0] / ((float(transverse_radius(lat)) + h) * math.cos(lat)),
            h + enu[2],
        ]
    )
