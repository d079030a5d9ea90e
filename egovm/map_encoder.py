"""Map queries: what a piece of map is, and where it lies (Eq. 1 and 2)."""

import torch
from torch import Tensor, nn

from egovm.batch import SURFEL, TYPES, MapElements
from egovm.config import NetworkConfig
from sensors.maps.vector_map import Kind

_HEIGHT_M = 5.0
"""Heights of poles and signs are given by this, for the BEV's size says nothing of them."""


class SemanticEmbeddings(nn.Module):
    """One vector for each type: learned (E^sem), or BEV-Locator's encoding of the type's number (A4)."""

    def __init__(self, channels: int, learned: bool) -> None:
        super().__init__()
        self.learned = nn.Parameter(torch.randn(TYPES, channels) * channels**-0.5) if learned else None
        self.encoder = None if learned else _mlp(TYPES, channels)
        self.register_buffer("one_hot", torch.eye(TYPES), persistent=False)

    def forward(self) -> Tensor:
        """(TYPES, C)."""
        if self.learned is not None:
            return self.learned
        assert self.encoder is not None
        encoded: Tensor = self.encoder(self.one_hot)
        return encoded


class MapEncoder(nn.Module):
    """Pieces of map into map queries: positional encoding plus the embedding of the type.

    Coordinates are in body axes at the initial pose, in units of the BEV's side (Eq. 1), heights in units of their own.
    The paper shares one encoder between all; segments, points with a height and surfels mean different things by their
    numbers, so each has its own here.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        channels = config.bev.channels[0]
        self.side_m = 2.0 * config.bev.half_m
        self.segments = _mlp(4, channels)
        self.points = _mlp(3, channels)
        self.surfels = _mlp(7, channels)

    def forward(self, elements: MapElements, embeddings: Tensor) -> Tensor:
        """Queries (B, K, C), 0 where an element is not valid. embeddings: (TYPES, C)."""
        ends = elements.ends[..., :2] / self.side_m
        place = ends.mean(2)
        raised = torch.cat((place, elements.height[..., None] / _HEIGHT_M), -1)
        patch = torch.cat((place, elements.normal, elements.ratios), -1)
        stands = (elements.type == Kind.POLE) | (elements.type == Kind.SIGN)
        position = torch.where(stands[..., None], self.points(raised), self.segments(ends.flatten(2)))
        position = torch.where((elements.type == SURFEL)[..., None], self.surfels(patch), position)
        queries = position + embeddings[elements.type]
        return torch.where(elements.valid[..., None], queries, torch.zeros_like(queries))


def _mlp(given: int, channels: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(given, channels), nn.ReLU(), nn.Linear(channels, channels))
