"""How far estimates are off: along and across the true heading, in yaw, and against the covariance they state."""

from dataclasses import dataclass

import torch
from torch import Tensor

from egovm.lattice import between, rotated
from egovm.pose_solver import PoseEstimate
from egovm.regression_solver import RegressedPose


@dataclass(frozen=True, slots=True)
class Judged:
    """Of B frames: error: (B, 3) estimate minus truth, m along and left of the true heading, rad; nees: (B, 3) squared
    error by variance, of the same axes, and total: (B,) of all three; NaN without a covariance, infinite where one has
    no width. found: (B,) bool."""

    error: Tensor
    nees: Tensor
    total: Tensor
    found: Tensor


@torch.no_grad()
def judged(estimate: PoseEstimate | RegressedPose, truth: Tensor) -> Judged:
    """truth: (B, 3) T_init^-1 T_true. The covariance is the last level's, turned from its centre's axes to the truth's.

    A frame without landmarks has an infinite covariance, so that its NEES is NaN: it states nothing.
    """
    truth = truth.to(estimate.offset)
    error = between(truth, estimate.offset)
    unknown = torch.full_like(error, torch.nan)
    if isinstance(estimate, RegressedPose):
        return Judged(error, unknown, unknown[:, 0], estimate.found)
    last = estimate.levels[-1]
    cov = _turned(last.cov, last.centre[:, 2] - truth[:, 2])
    known = torch.isfinite(cov).flatten(1).all(1)
    safe = torch.where(known[:, None, None], cov, torch.eye(3).to(cov))
    nees = error.square() / safe.diagonal(dim1=1, dim2=2)
    root, failed = torch.linalg.cholesky_ex(safe.double())
    root = torch.where((failed == 0)[:, None, None], root, torch.eye(3, dtype=torch.float64))
    white = torch.linalg.solve_triangular(root, error.double()[..., None], upper=False)
    total = torch.where(failed == 0, white.square().sum((1, 2)).to(error), torch.full_like(error[:, 0], torch.inf))
    return Judged(
        error,
        torch.where(known[:, None], nees, unknown),
        torch.where(known, total, unknown[:, 0]),
        estimate.found,
    )


def _turned(cov: Tensor, angle: Tensor) -> Tensor:
    """Covariances (B, 3, 3) seen from axes in which theirs are turned to the left by an angle (B,), rad."""
    columns = torch.eye(2).to(cov).expand(len(cov), 2, 2)
    R = torch.eye(3).to(cov).repeat(len(cov), 1, 1)
    R[:, :2, :2] = rotated(columns, angle[:, None]).transpose(1, 2)
    return R @ cov @ R.transpose(1, 2)
