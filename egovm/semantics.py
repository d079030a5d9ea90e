"""Semantic supervision: what lies in each BEV cell, by the same embeddings that map queries carry (Eq. 5)."""

import math

import torch
from torch import Tensor, nn

from egovm.batch import SURFEL
from egovm.config import NetworkConfig

PRIOR = -math.log(99.0)
"""Bias of the logits: nearly all cells are empty, 1 % is where training begins (focal loss, RetinaNet)."""


class SemanticHead(nn.Module):
    """Embeddings of the types, brought to each level's channels by 1x1 convolutions, times BEV features."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        first, *rest = config.bev.channels
        self.projections = nn.ModuleList([nn.Identity(), *(nn.Linear(first, channels) for channels in rest)])
        self.bias = nn.Parameter(torch.full((len(config.bev.channels),), PRIOR))

    def forward(self, features: tuple[Tensor, ...], embeddings: Tensor) -> tuple[Tensor, ...]:
        """Logits (B, TYPES - 1, H, W) of each level's features (B, C, H, W). embeddings: (TYPES, C of level 0)."""
        seen = embeddings[:SURFEL]
        return tuple(
            torch.einsum("bchw,tc->bthw", level.to(seen.dtype), projection(seen)) + bias
            for level, projection, bias in zip(features, self.projections, self.bias, strict=True)
        )
