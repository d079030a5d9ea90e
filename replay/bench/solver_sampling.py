"""The peer of the solver benchmark: features are sampled at every candidate, as the paper's Algorithm 1 reads.

A competent user's form of it: ``grid_sample`` of PyTorch, so many elements at a time that the samples stay small, all
candidates of them at once. The same lattice, validity and composition as ``egovm.pose_solver``, one sample.
"""

import torch
from torch import Tensor
from torch.nn import functional

from egovm.lattice import PAPER, candidates, compose, seen_from
from replay.bench.solver_scene import Scene

_CHUNK = 50


def sampled_estimate(scene: Scene) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """Composed offset (3,), and of each level the mean (3,) and the covariance (3, 3)."""
    offset = scene.places.new_zeros(3)
    means, covs = [], []
    for level, (plane, embedding) in enumerate(zip(scene.features, scene.embeddings, strict=True)):
        around = seen_from(offset.detach(), scene.places[0])
        mean, cov = _level(level, plane, embedding[0], around, scene.valid[0])
        offset = compose(offset, mean)
        means.append(mean)
        covs.append(cov)
    return offset, means, covs


def multiply_adds(used: int, channels: int) -> int:
    """Of one level: four weighted features and the dot product, at every candidate of every element."""
    return 5 * PAPER.steps**3 * channels * used


def _level(level: int, plane: Tensor, embedding: Tensor, places: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    offsets = candidates(PAPER, level, places).flatten(0, 2)
    cells = plane.shape[-1]
    seen = seen_from(offsets, places[:, None]) / PAPER.step_m(level)
    used = valid & (seen.abs() <= (cells - 1) / 2).flatten(1).all(1)
    total = seen.new_zeros(len(offsets))
    for start in range(0, len(places), _CHUNK):
        part = slice(start, start + _CHUNK)
        grid = seen[part].flip(-1) * (2.0 / cells)
        sampled = functional.grid_sample(plane, grid[None], align_corners=False)[0]
        dots = torch.einsum("ckm,kc->km", sampled, embedding[part])
        total = total + torch.where(used[part, None], dots, 0.0).sum(0)
    p = (total / used.sum().clamp(min=1)).softmax(0)
    mean = p @ offsets
    apart = offsets - mean
    return mean, (p[:, None] * apart).T @ apart
