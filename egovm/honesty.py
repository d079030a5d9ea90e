"""Whether errors are as large as the covariances beside them say.

NEES: squared errors by their variance, of 3 axes together: by 3 its mean is 1 and its median 0.79 where covariances are
true. ENCE (expected normalized calibration error; Levi et al., "Evaluating and Calibrating Uncertainty Prediction in
Regression Tasks", 2022): frames go into bins by the sigma that they state, and in each the root mean square of the
errors is set against that of the sigmas. It tells sigmas that follow the errors from ones that are right on the average
alone. Of few frames it is not 0 even for true ones: ``ence_of_true``.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Report = dict[str, Any]

AXES = ("lon", "lat", "yaw")
TAIL = 11.345
"""A NEES of three axes is beyond that in 1 % where covariances are true (chi-square)."""
BINS, BIN_FRAMES = 10, 20
"""Bins of ENCE, and fewer where they would have fewer frames than that."""
NO_WIDTH = 1e-6
"""Share of the variance along some direction, of what independent axes would leave there, below which a covariance has
no width: float32 tells no less."""


def nees(error: Floats, cov: Floats) -> tuple[Floats, Floats]:
    """(N, 3) of each axis alone, and (N,) of all together: errors (N, 3) against covariances (N, 3, 3).

    NaN where a covariance is infinite, for it states nothing; infinite where it has no width.
    """
    variance = np.diagonal(cov, axis1=1, axis2=2)
    known: Mask = np.isfinite(np.abs(cov).max(axis=(1, 2)))
    wide: Mask = known & (variance.min(axis=1) > 0.0)
    sigma = np.sqrt(np.where(wide[:, None], variance, 1.0))
    alike = np.where(wide[:, None, None], cov, np.eye(3)) / (sigma[:, :, None] * sigma[:, None])
    values, axes = np.linalg.eigh(alike)
    wide &= values[:, 0] > NO_WIDTH
    along = np.einsum("nji,nj->ni", axes, error / sigma)
    total = (along**2 / np.where(wide[:, None], values, 1.0)).sum(axis=1)
    each = np.divide(error**2, variance, out=np.full_like(error, np.inf), where=known[:, None] & (variance > 0.0))
    unknown = np.where(known, 0.0, np.nan)
    return each + unknown[:, None], np.where(wide, total, np.inf) + unknown


def ence(error: Floats, sigma: Floats) -> float:
    """Of one axis: errors (N,) beside sigmas (N,) above 0."""
    parts = []
    for rows in np.array_split(np.argsort(sigma, kind="stable"), _bins(len(sigma))):
        stated, found = (math.sqrt(np.mean(values[rows] ** 2)) for values in (sigma, error))
        parts.append(abs(stated - found) / stated)
    return float(np.mean(parts))


def ence_of_true(count: int) -> float:
    """What it is on the average for normal errors of true covariances, of so many frames."""
    return 1.0 / math.sqrt(math.pi * count / _bins(count))


def honesty(error: Floats, cov: Floats) -> Report | None:
    """Figures of errors (N, 3) beside covariances (N, 3, 3) in (m, m, rad), of the frames that state one with a width,
    and how many state one without; None where no frame does."""
    each, total = nees(error, cov)
    stated = np.isfinite(total)
    if not stated.any():
        return None
    sigma = np.sqrt(np.diagonal(cov[stated], axis1=1, axis2=2))
    return {
        "frames": int(stated.sum()),
        "without_width": int(np.isinf(total).sum()),
        "mean_by_3": float(total[stated].mean() / 3.0),
        "median_by_3": float(np.median(total[stated]) / 3.0),
        "beyond_99": float((total[stated] > TAIL).mean()),
        "nees": _by_axis(each[stated].mean(axis=0)),
        "ence": _by_axis([ence(error[stated, i], sigma[:, i]) for i in range(3)]),
        "ence_of_true": ence_of_true(len(sigma)),
        "nll": float(0.5 * (total[stated] + np.linalg.slogdet(2.0 * np.pi * cov[stated])[1]).mean()),
    }


def _by_axis(values: Iterable[float]) -> dict[str, float]:
    return {axis: float(value) for axis, value in zip(AXES, values, strict=True)}


def _bins(count: int) -> int:
    return max(1, min(BINS, count // BIN_FRAMES))
