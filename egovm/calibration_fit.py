"""Finds a calibration: the Gaussian likelihood of a network's errors, level by level, is largest at its numbers.

Nine a level: log a, log b and the power of each axis. Errors and covariances are in steps of the level, and the
gradient in closed form: with S = D Sigma D, R = S + diag(b / 12) and G = (R^-1 - R^-1 e e^T R^-1) / 2 it is
s_i = sum_j G_ij S_ij along log a_i, s_i log v_i along the power, and G_ii b_i / 12 along log b_i.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from egovm.calibration import Calibration, Fit, steps_of
from egovm.config import LatticeConfig
from egovm.judging import LevelErrors
from sensors.errors import EgolocError

Floats = NDArray[np.float64]

FEWEST = 20
"""Frames that a level needs."""
A_RANGE, B_RANGE, POWER_RANGE = (1e-4, 1e4), (1e-4, 1e4), (1.0, 3.0)
"""Where they are sought. The least b, of which sigma is a hundredth of that of a step's cell, keeps a width to
histograms that have all their weight at one candidate. From power 1 on, a variance counts the more the larger it is."""
LEAST_VARIANCE = 1e-12
"""Of step^2; less is 0."""
_AS_IT_IS = np.array((0.0, 0.0, 0.0, *np.log(np.full(3, B_RANGE[0])), 1.0, 1.0, 1.0))


def fitted(
    errors: LevelErrors, lattice: LatticeConfig, noise: Sequence[str] = (), maps: Sequence[str] = (), seed: int = 0
) -> Calibration:
    """From errors of N frames. noise, maps, seed: what they come from, which the calibration only keeps.

    A level is fitted to frames that it had landmarks in and whose truth lay in its window. Raises EgolocError where
    they are fewer than FEWEST.
    """
    step = steps_of(lattice)
    found, used, before, after = np.empty((lattice.levels, 9)), [], [], []
    for level in range(lattice.levels):
        error, cov = _used(errors, level, step[level])
        best = _best(error, cov)
        found[level] = _rounded(np.concatenate((np.exp(best[:6]), best[6:])))
        used.append(len(error))
        before.append(_nll(_AS_IT_IS, error, cov)[0])
        after.append(_nll(best, error, cov)[0])
    nll = (tuple(_rounded(np.array(values)).tolist()) for values in (before, after))
    fit = Fit(len(errors.error), tuple(noise), tuple(maps), seed, tuple(used), *nll)
    return Calibration(found[:, :3], found[:, 3:6], found[:, 6:], lattice, fit)


def _used(errors: LevelErrors, level: int, step: Floats) -> tuple[Floats, Floats]:
    """(n, 3) and (n, 3, 3), in steps. What float32 left of negative variance along a direction becomes 0."""
    cov = errors.cov[:, level]
    rows = errors.inside[:, level] & np.isfinite(cov).all(axis=(1, 2))
    if rows.sum() < FEWEST:
        raise EgolocError(
            f"calibration: level {level}: expected {FEWEST} frames or more with landmarks and the truth in its window,"
            f" got {rows.sum()}"
        )
    values, axes = np.linalg.eigh(cov[rows] / np.outer(step, step))
    return errors.error[rows, level] / step, np.einsum("nik,nk,njk->nij", axes, values.clip(min=0.0), axes)


def _best(error: Floats, cov: Floats) -> Floats:
    """(9,) log a, log b, power: the best of searches that begin with different powers, a and b sharing the errors."""
    mse, variance = (error**2).mean(axis=0), np.diagonal(cov, axis1=1, axis2=2)
    bounds = [tuple(np.log(A_RANGE))] * 3 + [tuple(np.log(B_RANGE))] * 3 + [POWER_RANGE] * 3
    found = []
    for power in (1.0, 1.5, 2.0):
        a = np.clip(0.5 * mse / np.maximum((variance**power).mean(axis=0), LEAST_VARIANCE), *A_RANGE)
        begin = np.concatenate((np.log(a), np.log(np.clip(6.0 * mse, *B_RANGE)), np.full(3, power)))
        found.append(
            minimize(_nll, begin, (error, cov), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 500})
        )
    best: Floats = min(found, key=lambda one: float(one.fun)).x
    return best


def _nll(theta: Floats, error: Floats, cov: Floats) -> tuple[float, Floats]:
    """Mean negative log likelihood, nats, and its gradient (9,). theta: log a, log b, power; in steps of the level."""
    log_v = np.log(np.maximum(np.diagonal(cov, axis1=1, axis2=2), LEAST_VARIANCE))
    scale, cell = np.exp(0.5 * (theta[:3] + (theta[6:] - 1.0) * log_v)), np.exp(theta[3:6]) / 12.0
    scaled = cov * scale[:, :, None] * scale[:, None]
    R = scaled + np.diag(cell)
    inverse = np.linalg.inv(R)
    white = np.einsum("nij,nj->ni", inverse, error)
    value = 0.5 * (np.linalg.slogdet(2.0 * np.pi * R)[1] + (white * error).sum(axis=1)).mean()
    G = 0.5 * (inverse - white[:, :, None] * white[:, None])
    along_a = (G * scaled).sum(axis=2)
    along_b = np.diagonal(G, axis1=1, axis2=2) * cell
    return float(value), np.concatenate([each.mean(axis=0) for each in (along_a, along_b, along_a * log_v)])


def _rounded(values: Floats) -> Floats:
    """To four digits: a file is read by people, and no fit knows more."""
    return np.array([float(f"{value:.4g}") for value in values])
