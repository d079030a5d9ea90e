"""What rows of a sensor must be before a record holds them: finite, within what vehicles do, covariances definite."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sensors.records import positive_definite

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_RATE, MAX_FORCE, MAX_SPEED = 100.0, 1000.0, 1000.0
"""Beyond these no vehicle moves: rad/s, m/s^2 (100 g) and m/s. One such sample would throw the filter off for good."""
MAX_ALTITUDE, MAX_COORDINATE = 1e5, 2e7
"""Of a fix and of a point on a map, m."""
_MAX_VARIANCE = 1e12


def finite_rows(values: Floats) -> Mask:
    """(N,) rows of (N, k) that are all finite; column by column, for reducing short rows is slow."""
    result = np.ones(len(values), bool)
    for column in values.T:
        result &= np.isfinite(column)
    return result


def rows_within(values: Floats, largest: Sequence[float]) -> Mask:
    """(N,) rows of (N, k) whose magnitudes are finite and at most the largest of their columns."""
    result = np.ones(len(values), bool)
    for column, bound in zip(values.T, largest, strict=True):
        result &= np.abs(column) <= bound
    return result


def sane(label: str, values: Floats, largest: float, unit: str) -> dict[str, Mask]:
    """Reasons why rows of (N, k) quantities cannot be used."""
    within = rows_within(values, (largest,) * values.shape[1])
    finite = within if within.all() else finite_rows(values)
    return {f"{label} is not finite": finite, f"{label} is beyond {largest:g} {unit}": within}


def covariance_valid(label: str, cov: Floats) -> dict[str, Mask]:
    """Reasons why (N, 3, 3) covariances cannot be used."""
    finite = finite_rows(cov.reshape(-1, 9))
    small = np.abs(np.where(np.isfinite(cov), cov, 0.0)).max(axis=(1, 2), initial=0.0) <= _MAX_VARIANCE
    definite = positive_definite(np.where((finite & small)[:, None, None], cov, 0.0))
    filled_in: Mask = np.any(cov != 0.0, axis=(1, 2))
    return {
        f"{label} is not finite": finite,
        f"{label} is all zero": filled_in,
        f"{label} is not positive definite": definite,
    }
