"""Deformable attention in pure PyTorch: a query looks at a few places around its reference, where it learns to look.

Places are rows and columns in cells of the map that is read, a whole number being the middle of a cell. What lies
outside the map reads zero and its weight is not shared out among the others. Reading is linear, and so is the layer
that gives the values: many queries read a map of values (``DeformableAttention``), a few read the map itself and then
only what they have read goes through that layer (``read_first``). (Zhu et al., Deformable DETR, Eq. 2; at one level)
"""

import math

import torch
from torch import Tensor, nn

from sensors.errors import EgolocError

_CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))


def deformable_sum(values: Tensor, cells: Tensor, weights: Tensor) -> Tensor:
    """(B, M, G, C) weighted sums, never in less than float32, of what is read bilinearly from maps.

    values: (B, H, W, G, C), G maps of each sample, best contiguous so; cells: (B, M, G, P, 2) rows and columns;
    weights: (B, M, G, P).
    """
    precise = values.float() if values.dtype in (torch.bfloat16, torch.float16) else values
    cells, weights = cells.to(precise.dtype), weights.to(precise.dtype)
    if torch.compiler.is_exporting() or torch.onnx.is_in_onnx_export():
        return sampled_sum(precise, cells, weights)
    samples, height, width, groups, channels = precise.shape
    base = torch.floor(cells)
    row, column = (cells - base).unbind(-1)
    rows, columns = _sides(row, base[..., 0], height), _sides(column, base[..., 1], width)
    sample = torch.arange(samples, dtype=torch.int32, device=cells.device)[:, None, None, None] * height
    group = torch.arange(groups, dtype=torch.int32, device=cells.device)[:, None]
    # what a row and what a column adds to the index, so that a corner costs one sum and one product
    rows = [(weights * weight, (sample + at) * (width * groups) + group) for weight, at in rows]
    columns = [(weight, at * groups) for weight, at in columns]
    table, bags = precise.reshape(-1, channels), (-1, weights.shape[-1])
    total = table.new_zeros(())
    for i, j in _CORNERS:
        total = total + nn.functional.embedding_bag(
            (rows[i][1] + columns[j][1]).reshape(bags),
            table,
            per_sample_weights=(rows[i][0] * columns[j][0]).reshape(bags),
            mode="sum",
        )
    return total.reshape(*weights.shape[:-1], channels)


def sampled_sum(values: Tensor, cells: Tensor, weights: Tensor) -> Tensor:
    """``deformable_sum`` by ``grid_sample``, which exports to ONNX; four times slower on a CPU."""
    samples, height, width, groups, _ = values.shape
    # grid_sample: column before row, -1 and 1 at the map's edges
    size = torch.tensor((width, height), dtype=cells.dtype, device=cells.device)
    grid = ((2.0 * cells.flip(-1) + 1.0) / size - 1.0).transpose(1, 2).flatten(0, 1)
    maps = values.permute(0, 3, 4, 1, 2).flatten(0, 1)
    read = nn.functional.grid_sample(maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    summed = (read * weights.transpose(1, 2).flatten(0, 1)[:, None]).sum(-1)
    return torch.unflatten(summed, 0, (samples, groups)).permute(0, 3, 1, 2)


def _sides(part: Tensor, base: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
    """Bilinear weights, 0 outside, and indices of both neighbours along an axis of so many cells."""
    found = []
    for side, weight in enumerate((1.0 - part, part)):
        at = base + side
        inside = (at >= 0) & (at < count)
        found.append((weight * inside, at.clamp(0, count - 1).to(torch.int32)))
    return found


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
        # points first: a softmax over the last axis is slow where it has only a few entries
        weights = self.weights(queries).reshape(shape).permute(3, 0, 1, 2).softmax(0)
        return offsets, weights.permute(1, 2, 3, 0).contiguous()

    def valued(self, seen: Tensor) -> Tensor:
        """(B, H, W, heads, C / heads) what is read of a map (B, H, W, C)."""
        found: Tensor = self.values(seen)
        return torch.unflatten(found, -1, (self.heads, -1))

    def at(self, references: Tensor, offsets: Tensor) -> Tensor:
        """(..., heads, P, 2) places: references (..., R, 2), each for P / R of the points, and offsets around them."""
        each = references.repeat_interleave(self.points // references.shape[-2], dim=-2)
        return each.unsqueeze(-3) + offsets

    def forward(self, queries: Tensor, references: Tensor, seen: Tensor) -> Tensor:
        """(B, Q, C) what queries (B, Q, C) find around references (B, Q, R, 2) in a map (B, H, W, C)."""
        offsets, weights = self.looks(queries)
        read = deformable_sum(self.valued(seen), self.at(references, offsets), weights)
        found: Tensor = self.out(read.flatten(2))
        return found

    def read_first(self, queries: Tensor, references: Tensor, seen: Tensor, position: Tensor) -> Tensor:
        """``forward`` of seen (B, H, W, C) + position, up to rounding: faster where queries are fewer than cells.

        position: (H, W, C + 1), a 1 behind the encoding of each cell, by which is known how much of the weight, and so
        of the bias, lies on the map.
        """
        offsets, weights = self.looks(queries)
        cells = self.at(references, offsets).flatten(1, 2)[:, :, None]
        weights = weights.flatten(1, 2)[:, :, None]
        of_seen = deformable_sum(seen[:, :, :, None], cells, weights)
        encoded = deformable_sum(position[None, :, :, None], cells.flatten(0, 1)[None], weights.flatten(0, 1)[None])
        encoded = encoded.reshape(*of_seen.shape[:-1], -1)
        read = torch.unflatten(of_seen + encoded[..., :-1], 1, (-1, self.heads))[..., 0, :]
        share = torch.unflatten(encoded[..., -1:], 1, (-1, self.heads))[..., 0, :]
        weight, bias = (torch.unflatten(each, 0, (self.heads, -1)) for each in (self.values.weight, self.values.bias))
        projected = torch.einsum("bqhc,hdc->bqhd", read, weight) + share * bias
        found: Tensor = self.out(projected.flatten(2))
        return found
