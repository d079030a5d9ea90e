"""The histogram pose solver: scores of all candidates, their softmax, its mean and covariance, level by level (Eq. 6-8,
Algorithm 1).

The score is exp(tau) / K^alpha * sum_i h(f_i . e_i) over the K elements that lie on the map for all candidates of the
level: one set for all, or the set itself would prefer some poses. Levels compose, T_est = T_init * dT_0 * dT_1 * dT_2;
each one's window lies around the detached estimate of those before.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from egovm.config import LatticeConfig
from egovm.lattice import PAPER, candidates, compose, seen_from
from egovm.solver_dots import chunks
from egovm.solver_modes import two_modes
from egovm.solver_window import Window, dot_window, dots_at, lattice_dots, summed_lattice_dots


@dataclass(frozen=True, slots=True)
class LevelEstimate:
    """What one level says, about its centre.

    scores: (B, yaw, x, y) of the candidates, as ``lattice.candidates`` orders them; log_p: the same normalized, -inf
    where a prior excludes; mean: (B, 3) x m, y m, yaw rad; cov: (B, 3, 3) in (m, m, rad); landmarks: (B,) int64,
    elements used. Without one the histogram is flat, the mean 0 and the covariance infinite on its diagonal.
    centre: (B, 3) detached offset of the level's centre from the initial pose. contribution: (B, K) detached, what the
    score at the mean would lose without the element, the factor exp(tau) / K^alpha left as it is; they add up to it.
    """

    scores: Tensor
    log_p: Tensor
    mean: Tensor
    cov: Tensor
    landmarks: Tensor
    centre: Tensor
    contribution: Tensor
    window: Window


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """offset: (B, 3) T_init^-1 T_est, x m, y m, yaw rad; found: (B,) bool, every level had landmarks.

    modes: (B, 2, 3) offsets of the two strongest modes of the first level, the heavier first; weights: (B, 2) their
    masses, 0 with the mode 0 where there is none. Covariances of the levels are in body axes at their centres.
    """

    levels: tuple[LevelEstimate, ...]
    offset: Tensor
    modes: Tensor
    weights: Tensor
    found: Tensor


class Similarity(nn.Module):
    """h: what dots of G groups of channels say together. One group is taken as it is: tau absorbs any affine h."""

    def __init__(self, groups: int = 1, hidden: int = 16) -> None:
        super().__init__()
        self.groups = groups
        self.layers = nn.Sequential(nn.Linear(groups, hidden), nn.ReLU(), nn.Linear(hidden, 1)) if groups > 1 else None

    def forward(self, dots: Tensor) -> Tensor:
        """Similarities (...) of dots (..., G)."""
        if self.layers is None:
            return dots[..., 0]
        found: Tensor = self.layers(dots)[..., 0]
        return found


class PoseSolver(nn.Module):
    """Estimates a pose offset from BEV features and map embeddings of each level."""

    def __init__(self, lattice: LatticeConfig = PAPER, alpha: float = 1.0, groups: int = 1, hidden: int = 16) -> None:
        """alpha: the score is the sum over K elements by K^alpha, the paper's mean is 1.

        groups: of channels, by which those of every level are divisible; hidden: width of h where there are several.
        """
        super().__init__()
        self.lattice, self.alpha, self.groups = lattice, alpha, groups
        self.tau = nn.Parameter(torch.zeros(lattice.levels))
        self.similarity = nn.ModuleList(Similarity(groups, hidden) for _ in range(lattice.levels))

    def forward(
        self,
        features: Sequence[Tensor],
        embeddings: Sequence[Tensor],
        places: Tensor,
        valid: Tensor,
        search: Tensor | None = None,
    ) -> PoseEstimate:
        """Estimate over all levels.

        features: of each level (B, C, H, W), rows along x, columns along y, both rising, the vehicle in the middle,
        cells as wide as the level's step, best in channels_last; embeddings: of each level (B, K, C); places: (B, K, 2)
        or (B, K, P, 2) m in vehicle axes at the initial pose, P points of an element whose features are averaged;
        valid: (B, K) bool; search: (B, 3) m, m, rad, half of what a prior leaves to be searched about the initial pose.
        """
        places = places[:, :, None] if places.dim() == 3 else places
        centre = places.new_zeros((len(places), 3), dtype=_precise(features[0]))
        offset, levels = centre, []
        for level, (plane, embedding) in enumerate(zip(features, embeddings, strict=True)):
            found = self.level(level, plane, embedding, places, valid, centre, search)
            offset = compose(offset, found.mean)
            centre = offset.detach()
            levels.append(found)
        landmarks = torch.stack([each.landmarks for each in levels], 1)
        modes, weights = two_modes(levels[0].log_p, candidates(self.lattice, 0, centre))
        seen = landmarks[:, :1] > 0
        return PoseEstimate(tuple(levels), offset, modes * seen[..., None], weights * seen, (landmarks > 0).all(1))

    def level(
        self,
        level: int,
        features: Tensor,
        embeddings: Tensor,
        places: Tensor,
        valid: Tensor,
        centre: Tensor,
        search: Tensor | None = None,
    ) -> LevelEstimate:
        """One level about a centre (B, 3), an offset from the initial pose, as places (B, K, P, 2) and search are."""
        kind = _precise(features)
        with torch.autocast(features.device.type, enabled=False):
            around = seen_from(centre.to(kind)[:, None, None], places.to(kind))
            window = dot_window(
                self.lattice, level, _by_kernel_type(features, kind), embeddings.to(kind), around, valid, self.groups
            )
            offsets = candidates(self.lattice, level, around)
            scores = self.lattice_scores(window)
            log_p = _log_softmax(scores, _searched(self.lattice, level, offsets, centre, search))
            landmarks = window.valid.sum(1)
            mean, cov = _moments(log_p, offsets, landmarks)
            with torch.no_grad():
                contribution = self.element_scores(window, mean[:, None])[:, 0]
        return LevelEstimate(scores, log_p, mean, cov, landmarks, centre, contribution, window)

    def lattice_scores(self, window: Window) -> Tensor:
        """Scores (B, yaw, x, y) of the candidates."""
        if self.groups == 1:
            return self._factor(window)[:, None, None, None] * summed_lattice_dots(window)
        total = torch.zeros((), dtype=window.dots.dtype, device=window.dots.device)
        for chosen in chunks(window.valid.shape[1]):
            part = _elements(window, chosen)
            alike = self.similarity[window.level](lattice_dots(part).movedim(2, -1))
            total = total + torch.where(part.valid[:, :, None, None, None], alike, torch.zeros_like(alike)).sum(1)
        return self._factor(window)[:, None, None, None] * total

    def element_scores(self, window: Window, offsets: Tensor) -> Tensor:
        """What each element adds to the scores of any poses of the window: (B, M, K) for offsets (B, M, 3)."""
        alike = self.similarity[window.level](dots_at(window, offsets))
        alike = torch.where(window.valid[:, None], alike, torch.zeros_like(alike))
        return self._factor(window)[:, None, None] * alike

    def scores_at(self, window: Window, offsets: Tensor) -> Tensor:
        """Scores (B, M) of any poses of the window, offsets (B, M, 3) from the level's centre, as losses need them.

        Beyond the window (``solver_window.in_window``) they are not those of the pose.
        """
        return self.element_scores(window, offsets).sum(-1)

    def _factor(self, window: Window) -> Tensor:
        """exp(tau) / K^alpha of each sample, (B,)."""
        count = window.valid.sum(1).clamp(min=1).to(window.dots.dtype)
        return self.tau[window.level].to(window.dots.dtype).exp() / count**self.alpha


def _precise(features: Tensor) -> torch.dtype:
    """Scores, softmax and covariances are never in less than float32."""
    return torch.float64 if features.dtype == torch.float64 else torch.float32


def _by_kernel_type(features: Tensor, kind: torch.dtype) -> Tensor:
    """On the CPU in a type of the kernels; elsewhere patches are converted as they are gathered.

    bfloat16 is read as it is unless gradients are wanted.
    """
    if features.device.type != "cpu" or (features.dtype == torch.bfloat16 and not features.requires_grad):
        return features
    return features.to(kind)


def _elements(window: Window, part: slice) -> Window:
    """The window of some elements."""
    chosen: dict[str, Any] = {name: getattr(window, name)[:, part] for name in ("dots", "places", "corners", "valid")}
    return Window(window.lattice, window.level, window.cells, **chosen)


def _searched(
    lattice: LatticeConfig, level: int, offsets: Tensor, centre: Tensor, search: Tensor | None
) -> Tensor | None:
    """Candidates (B, yaw, x, y) within half a step of what the prior leaves; the middle one always."""
    if search is None:
        return None
    from_start = compose(centre.to(offsets.dtype)[:, None, None, None], offsets[None])
    step = offsets.new_tensor((lattice.step_m(level), lattice.step_m(level), lattice.step_rad(level)))
    allowed = (from_start.abs() <= search.to(offsets.dtype)[:, None, None, None] + 0.5 * step).all(-1)
    return allowed | (offsets == 0.0).all(-1)


def _log_softmax(scores: Tensor, searched: Tensor | None) -> Tensor:
    if searched is not None:
        scores = torch.where(searched, scores, torch.full_like(scores, -torch.inf))
    return scores.flatten(1).log_softmax(1).view_as(scores)


def _moments(log_p: Tensor, offsets: Tensor, landmarks: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (B, 3) and covariance (B, 3, 3) of Eq. 7-8; 0 and infinity where there are no landmarks."""
    p, bins = log_p.exp().flatten(1), offsets.flatten(0, 2)
    seen = landmarks[:, None] > 0
    mean = torch.where(seen, p @ bins, torch.zeros((), dtype=p.dtype, device=p.device))
    apart = bins - mean[:, None]
    cov = (p[..., None] * apart).transpose(1, 2) @ apart
    unknown = torch.diag(torch.full((3,), torch.inf, dtype=p.dtype, device=p.device))
    return mean, torch.where(seen[..., None], cov, unknown)
