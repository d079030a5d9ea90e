"""Random inputs of the pose solver's tests."""

import torch
from torch import Tensor

from egovm.config import LatticeConfig

Inputs = tuple[list[Tensor], list[Tensor], Tensor, Tensor]


def inputs(
    lattice: LatticeConfig, samples: int, elements: int, points: int = 1, cells: int = 40, half_m: float = 10.0
) -> Inputs:
    """Random features (6 and fewer channels), embeddings, places (a few of them outside) and a mask with a hole."""
    draw = torch.Generator().manual_seed(7)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    levels = range(lattice.levels)
    features = [normal(samples, 6 - 2 * (level % 2), cells << level, cells << level) for level in levels]
    embeddings = [2.0 * normal(samples, elements, plane.shape[1]) for plane in features]
    places = (torch.rand(samples, elements, points, 2, generator=draw, dtype=torch.float64) - 0.5) * 2.0 * half_m
    valid = torch.rand(samples, elements, generator=draw) < 0.8
    return features, embeddings, places, valid
