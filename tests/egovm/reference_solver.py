"""The pose solver as the paper writes it: features are sampled at every candidate. Slow and plain; the oracle of tests.

It shares with ``egovm`` only the lattice's definition, p' = R(-yaw) p - t, written here with matrices.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class Reference:
    """Of one level and one sample: scores, log_p (yaw, x, y), mean (3,), cov (3, 3), used (K,) bool."""

    scores: Tensor
    log_p: Tensor
    mean: Tensor
    cov: Tensor
    used: Tensor


def matrix(x: Tensor, y: Tensor, yaw: Tensor) -> Tensor:
    """(3, 3) pose in the plane."""
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    rows = [[yaw.cos(), -yaw.sin(), x], [yaw.sin(), yaw.cos(), y], [zero, zero, one]]
    return torch.stack([torch.stack(row) for row in rows])


def vector(pose: Tensor) -> Tensor:
    """(3,) x, y, yaw of a pose in the plane."""
    return torch.stack((pose[0, 2], pose[1, 2], torch.atan2(pose[1, 0], pose[0, 0])))


def lattice_poses(level: int, half_m: float = 3.0, half_deg: float = 3.0, steps: int = 13) -> list[Tensor]:
    """(3, 3) poses of the candidates; yaw runs slowest, then t_x, then t_y."""
    t = torch.linspace(-half_m, half_m, steps, dtype=torch.float64) / 2**level
    yaws = torch.linspace(-half_deg, half_deg, steps, dtype=torch.float64) / 2**level * np.pi / 180.0
    zero = torch.zeros((), dtype=torch.float64)
    turned = [matrix(zero, zero, yaw) for yaw in yaws]
    return [R @ matrix(x, y, zero) for R in turned for x in t for y in t]


def sampled(features: Tensor, seen: Tensor, cell_m: float) -> Tensor:
    """(N, C) features (C, H, W) at places (N, 2) m: rows along x, columns along y, the vehicle in the middle."""
    height, width = features.shape[1:]
    grid = torch.stack((2.0 * seen[:, 1] / (width * cell_m), 2.0 * seen[:, 0] / (height * cell_m)), -1)
    return functional.grid_sample(features[None], grid[None, None], align_corners=False)[0, :, 0].T


def on_map(seen: Tensor, cells: tuple[int, int], cell_m: float) -> Tensor:
    """(N,) bool: between the middles of the outermost cells, so that four cells surround the place."""
    half = cell_m * (torch.tensor(cells, dtype=torch.float64) - 1) / 2
    return (seen.abs() <= half).all(-1)


def solve_level(
    features: Tensor,
    embeddings: Tensor,
    places: Tensor,
    valid: Tensor,
    cell_m: float,
    poses: list[Tensor],
    factor: float = 1.0,
    alpha: float = 1.0,
) -> Reference:
    """features: (C, H, W); embeddings: (K, C); places: (K, P, 2) m about the centre; valid: (K,) bool."""
    elements, points = places.shape[:2]
    flat = torch.cat((places.reshape(-1, 2), torch.ones(elements * points, 1, dtype=places.dtype)), 1)
    seen = [(flat @ torch.linalg.inv(pose).T)[:, :2] for pose in poses]
    cells = (features.shape[1], features.shape[2])
    inside = torch.stack([on_map(each, cells, cell_m) for each in seen]).all(0).view(elements, points).all(1)
    used = valid & inside
    dots = [
        (sampled(features, each, cell_m).view(elements, points, -1).mean(1) * embeddings).sum(1)[used].sum()
        for each in seen
    ]
    scores = factor * torch.stack(dots) / max(int(used.sum()), 1) ** alpha
    log_p = scores - torch.logsumexp(scores, 0)
    offsets = torch.stack([vector(pose) for pose in poses])
    mean = (log_p.exp()[:, None] * offsets).sum(0)
    apart = offsets - mean
    cov = sum(p * torch.outer(d, d) for p, d in zip(log_p.exp(), apart, strict=True))
    side = round(len(poses) ** (1 / 3))
    return Reference(scores.view(side, side, side), log_p.view(side, side, side), mean, cov, used)


def solve(
    features: list[Tensor],
    embeddings: list[Tensor],
    places: Tensor,
    valid: Tensor,
    cell_m: tuple[float, ...],
    half_m: float = 3.0,
    half_deg: float = 3.0,
    steps: int = 13,
) -> tuple[Tensor, list[Reference]]:
    """All levels of one sample: the composed offset (3,) and what each level said."""
    pose, found = torch.eye(3, dtype=torch.float64), []
    flat = torch.cat((places, torch.ones(*places.shape[:2], 1, dtype=places.dtype)), -1)
    for level, (plane, embedding, cell) in enumerate(zip(features, embeddings, cell_m, strict=True)):
        around = (flat @ torch.linalg.inv(pose).T)[..., :2]
        one = solve_level(plane, embedding, around, valid, cell, lattice_poses(level, half_m, half_deg, steps))
        pose = pose @ matrix(*one.mean)
        found.append(one)
    return vector(pose), found
