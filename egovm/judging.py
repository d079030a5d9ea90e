"""How far estimates are off: along and across the true heading, in yaw; and level by level, beside the covariances."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovm.config import LatticeConfig
from egovm.lattice import between
from egovm.pose_solver import PoseEstimate
from egovm.regression_solver import RegressedPose
from egovm.solver_window import in_window

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Judged:
    """Of B frames: error: (B, 3) estimate minus truth, m along and left of the true heading, rad; found: (B,) bool."""

    error: Tensor
    found: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class LevelErrors:
    """What the L levels of N frames are off, in (m, m, rad) along body axes at each level's centre.

    error: (N, L, 3) truth minus the estimate composed up to the level; cov: (N, L, 3, 3) as the level's histogram has
    it, infinite on its diagonal without landmarks; inside: (N, L) bool, the truth lies within the level's window; yaw:
    (N, L) of the centres in the initial pose's axes, rad.
    """

    error: Floats
    cov: Floats
    inside: NDArray[np.bool_]
    yaw: Floats


@torch.no_grad()
def judged(estimate: PoseEstimate | RegressedPose, truth: Tensor) -> Judged:
    """truth: (B, 3) T_init^-1 T_true."""
    return Judged(between(truth.to(estimate.offset), estimate.offset), estimate.found)


@torch.no_grad()
def level_errors(estimate: PoseEstimate, truth: Tensor, lattice: LatticeConfig) -> LevelErrors:
    """truth: (B, 3) T_init^-1 T_true. A truth beyond a window's outermost candidates is none that its mean can reach,
    and what the level is off says nothing of its covariance."""
    errors, covs, inside, yaws = [], [], [], []
    for number, level in enumerate(estimate.levels):
        there = between(level.centre.double(), truth.double())
        errors.append(there - level.mean.double())
        covs.append(level.cov.double())
        inside.append(in_window(lattice, number, there))
        yaws.append(level.centre[:, 2].double())
    return LevelErrors(*(torch.stack(each, 1).cpu().numpy() for each in (errors, covs, inside, yaws)))


def joined(several: list[LevelErrors]) -> LevelErrors:
    """One after the other."""
    names = ("error", "cov", "inside", "yaw")
    return LevelErrors(*(np.concatenate([getattr(each, name) for each in several]) for name in names))
