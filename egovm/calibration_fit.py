"""Finds a calibration: the Gaussian likelihood of a network's errors, level by level, is largest at its a and b.

Six numbers a level by their logarithms, errors and covariances in steps of the level, and the gradient in closed form:
with R = D Sigma D + diag(b / 12) and G = (R^-1 - R^-1 e e^T R^-1) / 2 it is sum_j G_ij (D Sigma D)_ij along log a_i and
G_ii b_i / 12 along log b_i.
"""

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
A_RANGE, B_RANGE = (1e-4, 1e6), (1e-4, 1e4)
"""Where a and b are sought. The least b, a hundredth of what a step's cell has for sigma, keeps a width to histograms
that have all their weight at one candidate."""


def fitted(errors: LevelErrors, lattice: LatticeConfig, noise: tuple[str, ...], seed: int) -> Calibration:
    """From errors of N frames whose initial poses were off by noise of a seed, which the calibration only keeps.

    A level is fitted to frames that it had landmarks in and whose truth lay in its window. Raises EgolocError where
    they are fewer than FEWEST.
    """
    step = steps_of(lattice)
    a, b, used, before, after = np.ones_like(step), np.zeros_like(step), [], [], []
    for level in range(lattice.levels):
        error, cov = _used(errors, level, step[level])
        theta = _best(error, cov)
        a[level], b[level] = _rounded(np.exp(theta[:3])), _rounded(np.exp(theta[3:]))
        used.append(len(error))
        before.append(_nll(np.log(np.append(np.ones(3), np.full(3, B_RANGE[0]))), error, cov)[0])
        after.append(_nll(np.log(np.append(a[level], b[level])), error, cov)[0])
    nll = (tuple(_rounded(np.array(values)).tolist()) for values in (before, after))
    return Calibration(a, b, step, Fit(len(errors.error), noise, seed, tuple(used), *nll))


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
    """(6,) log a, log b. Begun from errors that a alone explains, and from ones that b alone does."""
    mse, variance = (error**2).mean(axis=0), np.diagonal(cov, axis1=1, axis2=2).mean(axis=0)
    ratio, cell = np.clip(mse / np.maximum(variance, 1e-12), *A_RANGE), np.clip(12.0 * mse, *B_RANGE)
    bounds = [np.log(A_RANGE)] * 3 + [np.log(B_RANGE)] * 3
    low = np.array([bound[0] for bound in bounds])
    found = [
        minimize(_nll, begin, (error, cov), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 500})
        for begin in (
            np.maximum(np.log(np.append(ratio, 0.01 * cell)), low),
            np.maximum(np.log(np.append(0.1 * ratio, cell)), low),
        )
    ]
    best: Floats = min(found, key=lambda one: float(one.fun)).x
    return best


def _nll(theta: Floats, error: Floats, cov: Floats) -> tuple[float, Floats]:
    """Mean negative log likelihood, nats, and its gradient (6,). theta: log a, log b; in steps of the level."""
    scale, cell = np.exp(0.5 * theta[:3]), np.exp(theta[3:]) / 12.0
    scaled = cov * np.outer(scale, scale)
    R = scaled + np.diag(cell)
    inverse = np.linalg.inv(R)
    white = np.einsum("nij,nj->ni", inverse, error)
    value = 0.5 * (np.linalg.slogdet(2.0 * np.pi * R)[1] + (white * error).sum(axis=1)).mean()
    G = 0.5 * (inverse - white[:, :, None] * white[:, None])
    along_a = (G * scaled).sum(axis=2).mean(axis=0)
    along_b = (np.diagonal(G, axis1=1, axis2=2) * cell).mean(axis=0)
    return float(value), np.append(along_a, along_b)


def _rounded(values: Floats) -> Floats:
    """To four digits: a file is read by people, and no fit knows more."""
    return np.array([float(f"{value:.4g}") for value in values])
