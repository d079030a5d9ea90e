"""Deformable attention in pure PyTorch: a query looks at a few places around its reference, where it learns to look.

Places are rows and columns in cells of the map that is read, a whole number being the middle of a cell. What lies
outside the map reads zero and its weight is not shared out among the others. ``grid_sample`` does the reading, so that
it exports to ONNX. (Zhu et al., Deformable DETR, Eq. 2; at one level)
"""

import math

import torch
from torch import Tensor, nn

from sensors.errors import EgolocError


def deformable_sum(values: Tensor, cells: Tensor, weights: Tensor) -> Tensor:
    """(G, M, C) weighted sums of what is read bilinearly from maps.

    values: (G, C, H, W), G maps (samples by heads); cells: (G, M, P, 2) rows and columns; weights: (G, M, P).
    """
    height, width = values.shape[-2:]
    # grid_sample: column before row, -1 and 1 at the map's edges
    size = torch.tensor((width, height), dtype=cells.dtype, device=cells.device)
    grid = (2.0 * cells.flip(-1) + 1.0) / size - 1.0
    read = nn.functional.grid_sample(values, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return (read * weights[:, None]).sum(-1).transpose(1, 2)


def split_heads(values: Tensor, heads: int) -> Tensor:
    """(B heads, C / heads, H, W) of (B, C, H, W)."""
    samples, channels, height, width = values.shape
    return values.reshape(samples * heads, channels // heads, height, width)


class DeformableAttention(nn.Module):
    """Queries (B, Q, C) look at a map (B, C, H, W), each at ``points`` places by head, around its references."""

    def __init__(self, channels: int, heads: int, points: int, references: int = 1) -> None:
        """references: places of a query around which it looks; the points are shared out among them."""
        super().__init__()
        if channels % heads:
            raise EgolocError(f"deformable attention: expected channels in {heads} equal heads, got {channels}")
        if points % references:
            raise EgolocError(f"deformable attention: expected as many points at each of {references}, got {points}")
        self.heads, self.points = heads, points
        self.offsets = nn.Linear(channels, heads * points * 2)
        self.weights = nn.Linear(channels, heads * points)
        self.values = nn.Linear(channels, channels)
        self.out = nn.Linear(channels, channels)
        self._start(references)

    def _start(self, references: int) -> None:
        """Each head begins looking its own way, each next point of a reference a cell farther, all weights equal."""
        angle = torch.arange(self.heads) * (2.0 * math.pi / self.heads)
        way = torch.stack((torch.sin(angle), torch.cos(angle)), -1)
        far = 1 + torch.arange(self.points) % (self.points // references)
        with torch.no_grad():
            self.offsets.weight.zero_()
            self.offsets.bias.copy_((way[:, None] * far[:, None]).flatten())
            self.weights.weight.zero_()
            self.weights.bias.zero_()
        for layer in (self.values, self.out):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def looks(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Where queries (B, Q, C) look: offsets (B, Q, heads, P, 2) in cells, and weights (B, Q, heads, P)."""
        shape = (*queries.shape[:2], self.heads, self.points)
        offsets = self.offsets(queries).reshape(*shape, 2)
        weights = self.weights(queries).reshape(shape).softmax(-1)
        return offsets, weights

    def valued(self, seen: Tensor) -> Tensor:
        """(B, C, H, W) what is read of a map (B, C, H, W)."""
        found: Tensor = self.values(seen.permute(0, 2, 3, 1))
        return found.permute(0, 3, 1, 2)

    def at(self, references: Tensor, offsets: Tensor) -> Tensor:
        """(..., heads, P, 2) places: references (..., R, 2), each for P / R of the points, and offsets around them."""
        each = references.repeat_interleave(self.points // references.shape[-2], dim=-2)
        return each.unsqueeze(-3) + offsets

    def forward(self, queries: Tensor, references: Tensor, seen: Tensor) -> Tensor:
        """(B, Q, C) what queries (B, Q, C) find around references (B, Q, R, 2) in a map (B, C, H, W)."""
        offsets, weights = self.looks(queries)
        cells = self.at(references, offsets).transpose(1, 2).flatten(0, 1)
        values = split_heads(self.valued(seen), self.heads)
        read = deformable_sum(values, cells, weights.transpose(1, 2).flatten(0, 1))
        found: Tensor = self.out(read.reshape(len(queries), self.heads, *read.shape[1:]).transpose(1, 2).flatten(2))
        return found
