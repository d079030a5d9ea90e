"""Random poses for the random-pose loss: importance samples of a posterior, drawn in rounds that learn from each other.

A round's proposal is a t distribution of 3 degrees of freedom over the translation, and over the yaw a mixture of a von
Mises distribution and a uniform one. The first is about what the solver estimates, each next one about the weighted
mean and covariance of all samples so far. All samples count with the mean of all proposals' densities. (EPro-PnP:
adaptive multiple importance sampling.) As proposals depend on samples, the integral comes out low: by 1 % with 512
samples in 4 rounds from a good start, by 4 % from 5 sigma off it. Weighing each round by its own density would be
unbiased, and six times as uncertain from there.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

UNIFORM = 0.25
"""Share of the uniform distribution in the yaw's."""
_FREEDOM = 3.0
_FLOOR = 0.02
"""Least sigma of a proposal, in halves of the window: a round that happens to hit one place does not stay there."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """One round's distribution for each of B samples.

    mean: (B, 3) x m, y m, yaw rad; root: (B, 2, 2) lower Cholesky factor of the translation's scale matrix, m; kappa:
    (B,) of the yaw's von Mises distribution; half_yaw: rad, the uniform one reaches so far to both sides of 0.
    """

    mean: Tensor
    root: Tensor
    kappa: Tensor
    half_yaw: float

    @classmethod
    def around(cls, mean: Tensor, covariance: Tensor, half: tuple[float, float]) -> "Proposal":
        """About a mean (B, 3) with a covariance (B, 3, 3); half: m and rad of the window, the floor's scale."""
        least = _FLOOR * mean.new_tensor((half[0], half[0], half[1]))
        spread = covariance + torch.diag(least**2)
        return cls(mean, torch.linalg.cholesky(spread[:, :2, :2]), 1.0 / spread[:, 2, 2], half[1])

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """(B, count, 3) samples."""
        size, kind = (len(self.mean), count), self.mean.dtype
        normal = torch.randn((*size, 2), dtype=kind, generator=generator)
        chi2 = torch.randn((*size, 3), dtype=kind, generator=generator).square().sum(-1, keepdim=True)
        xy = self.mean[:, None, :2] + (normal * torch.sqrt(_FREEDOM / chi2)) @ self.root.transpose(1, 2)
        uniform = self.half_yaw * (2.0 * torch.rand(size, dtype=kind, generator=generator) - 1.0)
        peaked = self.mean[:, None, 2] + von_mises(self.kappa[:, None].expand(size), generator)
        yaw = torch.where(torch.rand(size, dtype=kind, generator=generator) < UNIFORM, uniform, peaked)
        return torch.cat((xy, yaw[..., None]), -1)

    def log_density(self, offsets: Tensor) -> Tensor:
        """(B, M) log of the density at offsets (B, M, 3), by m^2 rad."""
        apart = offsets - self.mean[:, None]
        white = torch.linalg.solve_triangular(self.root, apart[..., :2].transpose(1, 2), upper=False)
        scale = self.root.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True) + math.log(2.0 * math.pi)
        xy = -0.5 * (_FREEDOM + 2.0) * torch.log1p(white.square().sum(1) / _FREEDOM) - scale
        kappa = self.kappa[:, None]
        peaked = kappa * (torch.cos(apart[..., 2]) - 1.0) - torch.log(2.0 * math.pi * torch.special.i0e(kappa))
        flat = torch.full_like(peaked, -math.log(2.0 * self.half_yaw))
        flat = flat.masked_fill(offsets[..., 2].abs() > self.half_yaw, -math.inf)
        return xy + torch.logaddexp(peaked + math.log(1.0 - UNIFORM), flat + math.log(UNIFORM))


def sample_poses(
    log_score: Callable[[Tensor], Tensor],
    mean: Tensor,
    covariance: Tensor,
    half: tuple[float, float],
    generator: torch.Generator,
    count: int = 512,
    rounds: int = 4,
) -> tuple[Tensor, Tensor, Tensor]:
    """Poses (B, count, 3), the log (B, count) of the density that they were drawn with, and their scores (B, count).

    log_score: of the posterior, not normalized, at offsets (B, M, 3) -> (B, M), -inf outside the window; mean (B, 3)
    and covariance (B, 3, 3): where to begin; half: m and rad of the window. Poses and densities are float64, on the
    CPU, without gradient; scores are as log_score gives them, with theirs. The same generator state gives the same
    poses. The mean of exp(score - density) estimates the posterior's integral.
    """
    proposals: list[Proposal] = []
    drawn = torch.empty((len(mean), 0, 3), dtype=torch.float64)
    log_q, scores = drawn[..., 0], []
    at, spread = (each.detach().to("cpu", torch.float64) for each in (mean, covariance))
    for number in range(rounds):
        with torch.no_grad():
            proposals.append(Proposal.around(at, spread, half))
            new = proposals[-1].draw((number + 1) * count // rounds - drawn.shape[1], generator)
            drawn = torch.cat((drawn, new), 1)
            log_q = torch.stack([each.log_density(drawn) for each in proposals])
            log_q = torch.logsumexp(log_q, 0) - math.log(len(proposals))
        scores.append(log_score(new.to(mean)))
        known = torch.cat([each.detach() for each in scores], 1).to(log_q)
        at, spread = _moments(drawn, known - log_q, at, spread)
    return drawn, log_q, torch.cat(scores, 1)


def von_mises(kappa: Tensor, generator: torch.Generator) -> Tensor:
    """Samples in [-pi, pi) of von Mises distributions about 0, of the shape of kappa. (Best and Fisher, 1979)"""
    tau = 1.0 + torch.sqrt(1.0 + 4.0 * kappa**2)
    rho = (tau - torch.sqrt(2.0 * tau)) / (2.0 * kappa)
    r = (1.0 + rho**2) / (2.0 * rho)
    found, missing = torch.zeros_like(kappa), torch.ones_like(kappa, dtype=torch.bool)
    while missing.any():
        u = torch.rand((3, *kappa.shape), dtype=kappa.dtype, generator=generator)
        z = torch.cos(math.pi * u[0])
        f = (1.0 + r * z) / (r + z)
        c = kappa * (r - f)
        accepted = missing & ((c * (2.0 - c) > u[1]) | (torch.log(c / u[1]) + 1.0 >= c))
        angle = torch.where(u[2] > 0.5, 1.0, -1.0) * torch.acos(f.clamp(-1.0, 1.0))
        found, missing = torch.where(accepted, angle, found), missing & ~accepted
    return found


def _moments(drawn: Tensor, log_weight: Tensor, mean: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted mean and covariance; as before where no sample has weight."""
    hit = torch.isfinite(log_weight).any(1)
    weight = torch.where(hit[:, None], log_weight, torch.zeros_like(log_weight)).softmax(1)
    found = (weight[..., None] * drawn).sum(1)
    apart = drawn - found[:, None]
    spread = (weight[..., None] * apart).transpose(1, 2) @ apart
    return torch.where(hit[:, None], found, mean), torch.where(hit[:, None, None], spread, covariance)
