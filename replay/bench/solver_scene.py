"""Inputs of the solver benchmark: BEV features and map embeddings of random numbers, at the sizes of the networks."""

from dataclasses import dataclass

import torch
from torch import Tensor

CELLS = (160, 320, 640)
SIZES = {"paper": (256, 128, 64), "small": (64, 32, 16)}
"""Channels of the three levels."""
_HALF_M = 35.0
"""Elements lie within this square, so that all are inside for all candidates: the most work."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What a solver is given: features (1, C, H, W) and embeddings (1, K, C) by level, places (1, K, 2) m, valid."""

    features: list[Tensor]
    embeddings: list[Tensor]
    places: Tensor
    valid: Tensor

    def first(self, elements: int) -> "Scene":
        """The same BEV features, and so many of the elements."""
        embeddings = [each[:, :elements] for each in self.embeddings]
        return Scene(self.features, embeddings, self.places[:, :elements], self.valid[:, :elements])

    def leaves(self) -> list[Tensor]:
        """The tensors that gradients go to."""
        return [*self.features, *self.embeddings]


def scene(
    channels: tuple[int, ...], elements: int, dtype: torch.dtype = torch.float32, last: bool = True, seed: int = 1
) -> Scene:
    """Random inputs. last: features lie channels last, as convolutions on a CPU like them."""
    draw = torch.Generator().manual_seed(seed)
    layout = torch.channels_last if last else torch.contiguous_format
    features = [
        torch.empty((1, c, n, n), dtype=dtype, memory_format=layout).normal_(generator=draw)
        for c, n in zip(channels, CELLS, strict=True)
    ]
    embeddings = [torch.randn((1, elements, c), dtype=dtype, generator=draw) for c in channels]
    places = (2.0 * torch.rand((1, elements, 2), dtype=dtype, generator=draw) - 1.0) * _HALF_M
    return Scene(features, embeddings, places, torch.ones((1, elements), dtype=torch.bool))
