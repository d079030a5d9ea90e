"""What training minimizes: three losses of the pose (section 3.4) and the focal loss of the semantic maps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import torch
from torch import Tensor

from egovm.batch import Truth
from egovm.config import Ablation, LatticeConfig
from egovm.focal import FocalByType
from egovm.lattice import between, rotated
from egovm.pose_solver import LevelEstimate, PoseEstimate, PoseSolver
from egovm.random_poses import sample_poses
from egovm.solver_window import in_window

_DEGREES = 180.0 / math.pi
_LEAST_VARIANCE = 1e-4
"""Added to the eigenvalues of a covariance, m^2 and deg^2: 1 cm and 0.01 deg."""
_FEWEST_CELLS = 1e-3
"""A type drawn in fewer of the cells than that counts as if it were drawn in so many."""


class LossConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Weights of the losses; each is a mean over frames and levels. A switch of an ablation leaves its own out."""

    rmse: float = 1.0
    solver: float = 1.0
    random_pose: float = 1.0
    semantic: float = 0.1
    """It begins near 30, the others between 2 and 8."""
    samples: int = 512
    """Random poses of each frame and level."""
    rounds: int = 4
    """In which they are drawn, each learning from those before."""
    target: Literal["point", "spread"] = "point"
    """What the solver's loss wants: all weight on the truth as one more candidate (the paper's, as ``solver_loss``), or
    the truth shared out among the candidates around it (``spread_loss``). Where frames say more than a step of the
    finest level, the former sharpens until one candidate has all the weight: the mean then is off by up to half a step,
    0.03 m on the average, and no covariance is left."""


@dataclass(frozen=True, slots=True)
class Losses:
    """Scalars, not weighted; 0 where there is nothing to learn from, or an ablation leaves the loss out. total: their
    weighted sum."""

    rmse: Tensor
    solver: Tensor
    random_pose: Tensor
    semantic: Tensor
    total: Tensor


def network_losses(
    config: LossConfig,
    ablation: Ablation,
    truth: Truth,
    estimate: PoseEstimate | Tensor,
    solver: PoseSolver | None,
    logits: Sequence[Tensor],
    generator: torch.Generator,
) -> Losses:
    """All losses of B frames.

    estimate: with the solver that made it, or offsets (B, 3) m, m, rad without one (A6); logits: of each level
    (B, TYPES - 1, H, W), not read where ablation has no semantic supervision; generator: of the random poses, CPU.
    """
    zero = truth.offset.new_zeros(())
    with torch.autocast(truth.offset.device.type, enabled=False):
        if isinstance(estimate, PoseEstimate):
            if solver is None:
                raise ValueError("network_losses: expected the solver that made the estimate")
            parts = _pose_losses(config, ablation, solver, estimate, truth.offset, generator)
        else:
            parts = regression_loss(_precise(estimate), truth.offset), zero, zero
        semantic = semantic_loss(logits, truth.semantic) if ablation.semantic_supervision else zero
    weights = config.rmse, config.solver, config.random_pose, config.semantic
    total = sum((weight * part for weight, part in zip(weights, (*parts, semantic), strict=True)), start=zero)
    return Losses(*parts, semantic, total)


def rmse_loss(mean: Tensor, covariance: Tensor, truth: Tensor) -> Tensor:
    """(B,) |Lambda^(1/2) U^T (mean - truth)| in m, m, deg. mean, truth: (B, 3) m, m, rad; covariance: (B, 3, 3).

    Axes in which the posterior is sharp count most: Lambda is the inverse of the eigenvalues, with the sum 3. U and
    Lambda are constants: eigenvectors of equal eigenvalues have no gradient, and the loss would fall by a wider
    posterior too. An infinite covariance weighs all axes alike.
    """
    units = mean.new_tensor((1.0, 1.0, _DEGREES))
    spread = covariance.detach().to(mean.dtype) * units * units[:, None]
    known = torch.isfinite(spread).all(-1).all(-1)[:, None, None]
    identity = torch.eye(3, dtype=mean.dtype, device=mean.device)
    values, U = torch.linalg.eigh(torch.where(known, spread, identity) + _LEAST_VARIANCE * identity)
    weights = 1.0 / values
    weights = 3.0 * weights / weights.sum(-1, keepdim=True)
    turned = (U.transpose(1, 2) @ ((mean - truth) * units)[..., None])[..., 0]
    norm: Tensor = torch.linalg.vector_norm(weights.sqrt() * turned, dim=-1)
    return norm


def solver_loss(scores: Tensor, truth_score: Tensor) -> Tensor:
    """(B,) -log of the softmax at the truth, which is one more candidate, so that it is 0 or more.

    scores: (B, N) of the candidates; truth_score: (B,), of the true pose itself.
    """
    return torch.logsumexp(torch.cat((scores, truth_score[:, None]), 1), 1) - truth_score


def spread_loss(lattice: LatticeConfig, level: int, scores: Tensor, local: Tensor) -> Tensor:
    """(B,) divergence of the posterior from the truth shared out among the eight candidates around it.

    scores: (B, yaw, x, y) of the candidates; local: (B, 3) the truth from the level's centre, within the window. 0
    where the posterior is that: then its mean, in (t, yaw), is the truth, wherever between candidates that lies.
    """
    step = local.new_tensor((lattice.step_rad(level), lattice.step_m(level), lattice.step_m(level)))
    t = torch.cat((local[:, 2:], rotated(local[:, :2], -local[:, 2])), 1) / step + lattice.reach
    first = torch.floor(t).clamp(0.0, lattice.steps - 2.0)
    part = (t - first).clamp(0.0, 1.0)
    sides = torch.stack((1.0 - part, part), -1)
    target = torch.einsum("bi,bj,bk->bijk", *sides.unbind(1)).flatten(1)
    corner = torch.arange(2, device=t.device)
    yaw, x, y = (first.long()[:, :, None] + corner).unbind(1)
    n = lattice.steps
    index = (yaw[:, :, None, None] * n + x[:, None, :, None]) * n + y[:, None, None, :]
    log_p = scores.flatten(1).log_softmax(1).gather(1, index.flatten(1))
    return (torch.xlogy(target, target) - target * log_p).sum(1)


def random_pose_loss(scores: Tensor, log_density: Tensor, truth_score: Tensor) -> Tensor:
    """(B,) -log of the posterior's density at the truth, by m^2 rad; below 0 where it is sharp.

    scores: (B, N) of random poses, -inf outside the window; log_density: (B, N), that with which they were drawn;
    truth_score: (B,). Infinite where no pose lies in the window.
    """
    log_weights = scores - log_density
    hit = torch.isfinite(log_weights).any(1)
    log_weights = torch.where(hit[:, None], log_weights, torch.zeros_like(log_weights))
    loss = torch.logsumexp(log_weights, 1) - math.log(scores.shape[1]) - truth_score
    return torch.where(hit, loss, torch.full_like(loss, -torch.inf))


def regression_loss(offset: Tensor, truth: Tensor) -> Tensor:
    """Mean over B offsets (B, 3) m, m, rad of the distance to the truth in m, m, deg: L_rmse without a covariance."""
    unknown = torch.full((3, 3), torch.inf, dtype=offset.dtype, device=offset.device)
    return rmse_loss(offset, unknown.expand(len(offset), 3, 3), truth).mean()


def focal_loss(logits: Tensor, drawn: Tensor, gamma: float = 2.0) -> Tensor:
    """Sum over the types of their focal losses, each by the number of cells in which it is drawn.

    logits: (B, types, H, W); drawn: of the same shape, bool.
    """
    by_type = FocalByType.apply(logits, drawn, gamma)  # type: ignore[no-untyped-call]
    cells = drawn.sum((0, 2, 3)).clamp(min=_FEWEST_CELLS * drawn[:, 0].numel())
    loss: Tensor = (by_type / cells).sum()
    return loss


def semantic_loss(logits: Sequence[Tensor], drawn: Sequence[Tensor]) -> Tensor:
    """Mean over the levels of ``focal_loss``, in float32 or better."""
    losses = [focal_loss(_precise(a), b) for a, b in zip(logits, drawn, strict=True)]
    return torch.stack(losses).mean()


def _pose_losses(
    config: LossConfig,
    ablation: Ablation,
    solver: PoseSolver,
    estimate: PoseEstimate,
    truth: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """L_rmse, L_ps and L_rp, each a mean over the levels. truth: (B, 3) offset from the initial pose."""
    rmse, candidates, random = [], [], []
    for found in estimate.levels:
        local = between(found.centre, truth.to(found.centre))
        reached = in_window(solver.lattice, found.window.level, local) & (found.landmarks > 0)
        truth_score = solver.scores_at(found.window, local[:, None])[:, 0]
        rmse.append(_mean(rmse_loss(found.mean, found.cov, local), reached))
        candidates.append(_mean(_candidate_loss(config, solver, found, local, truth_score), reached))
        if ablation.random_pose_loss:
            loss = _random_loss(config, solver, found, truth_score, generator)
            random.append(_mean(loss, reached & torch.isfinite(loss)))
    zero = truth.new_zeros(())
    return torch.stack(rmse).mean(), torch.stack(candidates).mean(), torch.stack(random).mean() if random else zero


def _candidate_loss(
    config: LossConfig, solver: PoseSolver, found: LevelEstimate, local: Tensor, truth_score: Tensor
) -> Tensor:
    """(B,) L_ps of a level."""
    if config.target == "point":
        return solver_loss(found.scores.flatten(1), truth_score)
    return spread_loss(solver.lattice, found.window.level, found.scores, local)


def _random_loss(
    config: LossConfig, solver: PoseSolver, found: LevelEstimate, truth_score: Tensor, generator: torch.Generator
) -> Tensor:
    """(B,) L_rp of a level, over its window: poses are drawn without gradient, and scored with."""
    lattice, level = solver.lattice, found.window.level

    def scored(offsets: Tensor) -> Tensor:
        scores = solver.scores_at(found.window, offsets)
        inside = in_window(lattice, level, offsets)
        return torch.where(inside, scores, torch.full_like(scores, -torch.inf))

    step = found.mean.new_tensor((lattice.step_m(level), lattice.step_m(level), lattice.step_rad(level)))
    between_steps = torch.diag(step**2 / 12.0)  # what the lattice cannot tell apart
    spread = torch.where((found.landmarks > 0)[:, None, None], found.cov.detach(), torch.zeros_like(found.cov))
    half = lattice.reach * lattice.step_m(level), lattice.reach * lattice.step_rad(level)
    _, log_density, scores = sample_poses(
        scored, found.mean, spread + between_steps, half, generator, config.samples, config.rounds
    )
    return random_pose_loss(scores, log_density.to(scores), truth_score)


def _mean(values: Tensor, used: Tensor) -> Tensor:
    """Mean of the values (B,) that are used, 0 where none is."""
    return torch.where(used, values, torch.zeros_like(values)).sum() / used.sum().clamp(min=1)


def _precise(values: Tensor) -> Tensor:
    return values if values.dtype == torch.float64 else values.float()
