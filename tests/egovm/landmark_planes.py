"""BEV maps whose best pose is known: the distance to the nearest landmark, seen from the true pose."""

import torch
from torch import Tensor

from egovm.config import LatticeConfig
from egovm.lattice import seen_from

CELLS_0 = 120


def layout(seed: int, count: int = 40, half_m: float = 22.0) -> Tensor:
    """(count, 2) m landmarks around the vehicle."""
    draw = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 2, generator=draw, dtype=torch.float64) - 0.5) * 2.0 * half_m


def planes(lattice: LatticeConfig, places: Tensor, truths: Tensor, sigma_m: float, sharp: float) -> list[Tensor]:
    """Of each level (1, 1, H, W): minus the squared distance to the nearest landmark, capped at 3 m, over sigma^2.

    places: (K, 2) m at the initial pose; truths: (M, 3) offsets of the true pose, of which the map agrees with each
    as well; sharp: how much evidence all elements together are worth, as so many independent ones.
    """
    seen = seen_from(truths[:, None], places[None]).flatten(0, 1)
    found = []
    for level in range(lattice.levels):
        cells = CELLS_0 << level
        middle = (torch.arange(cells, dtype=torch.float64) - (cells - 1) / 2) * lattice.step_m(level)
        grid = torch.stack(torch.meshgrid(middle, middle, indexing="ij"), -1).flatten(0, 1)
        nearest = torch.cat([torch.cdist(part, seen).amin(1) for part in grid.split(20_000)])
        scale = sharp / (2.0 * sigma_m**2)
        found.append((-scale * nearest.clamp(max=3.0) ** 2).view(1, 1, cells, cells))
    return found
