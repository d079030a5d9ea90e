"""Cross-modality matching: map queries look at each other and at the BEV, and become map embeddings (Eq. 3 and 4)."""

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from egovm.batch import MapElements
from egovm.bev_grid import BevGrid
from egovm.config import NetworkConfig
from egovm.deformable_attention import DeformableAttention
from egovm.map_encoder import MapEncoder, SemanticEmbeddings
from sensors.errors import EgolocError


class ElementAttention(nn.Module):
    """Self attention between the pieces of map of a frame."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.given = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, queries: Tensor, valid: Tensor) -> Tensor:
        """(B, K, C) of queries (B, K, C); valid: (B, K) bool, what may be looked at."""
        asked, keys, values = self.given(queries).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        # a frame without elements looks at its padding, for a softmax over nothing is NaN
        seen = valid | ~valid.any(1, keepdim=True)
        found = scaled_dot_product_attention(asked, keys, values, attn_mask=seen[:, None, None])
        result: Tensor = self.out(found.transpose(1, 2).flatten(2))
        return result


class DecoderLayer(nn.Module):
    """Elements look at each other, then each at the BEV around its place, then think."""

    def __init__(self, channels: int, heads: int, points: int, hidden: int, references: int) -> None:
        super().__init__()
        self.before_elements, self.before_bev, self.before_hidden = (nn.LayerNorm(channels) for _ in range(3))
        self.elements = ElementAttention(channels, heads)
        self.bev = DeformableAttention(channels, heads, points, references)
        self.hidden = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, channels))

    def forward(self, queries: Tensor, valid: Tensor, cells: Tensor, bev: Tensor, position: Tensor) -> Tensor:
        """(B, K, C) of queries (B, K, C). cells: (B, K, R, 2) rows and columns in bev (B, H, W, C); position:
        (H, W, C + 1) added to it, and a 1."""
        queries = queries + self.elements(self.before_elements(queries), valid)
        queries = queries + self.bev.read_first(self.before_bev(queries), cells, bev, position)
        result: Tensor = queries + self.hidden(self.before_hidden(queries))
        return result


class Matching(nn.Module):
    """Map embeddings of each level: queries, decoder, and MLP^l (Algorithm 1); without the decoder in A2."""

    position: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        first, given = config.bev.channels[0], config.matching
        self.grid, self.at_middle = BevGrid.of(config.bev, 0), given.sampled == "middle"
        self.semantic = SemanticEmbeddings(first, config.ablation.semantic_embedding)
        self.encoder = MapEncoder(config)
        references = 1 if self.at_middle else 2
        self.layers = nn.ModuleList(
            DecoderLayer(first, given.heads, given.points, given.hidden, references)
            for _ in range(given.layers if config.ablation.decoder else 0)
        )
        self.last = nn.LayerNorm(first) if config.ablation.decoder else nn.Identity()
        self.levels = nn.ModuleList(
            nn.Sequential(nn.Linear(first, first), nn.ReLU(), nn.Linear(first, channels))
            for channels in config.bev.channels
        )
        position = sine_positions(self.grid.cells, first).permute(1, 2, 0)
        # the 1 behind it: see DeformableAttention.read_first
        known = torch.cat((position, torch.ones_like(position[..., :1])), -1)
        self.register_buffer("position", known, persistent=False)

    def forward(self, elements: MapElements, bev: Tensor) -> tuple[Tensor, ...]:
        """Map embeddings (B, K, C) of each level, 0 where an element is not valid. bev: (B, C, H, W) of level 0."""
        queries = self.encoder(elements, self.semantic())
        looked_at = elements.ends[..., :2]
        looked_at = looked_at.mean(2, keepdim=True) if self.at_middle else looked_at
        cells = self.grid.cells_from_m(looked_at).to(queries.dtype)
        seen = bev.permute(0, 2, 3, 1).to(queries.dtype)
        for layer in self.layers:
            queries = layer(queries, elements.valid, cells, seen, self.position)
        matched = self.last(queries)
        kept = elements.valid[..., None]
        return tuple(torch.where(kept, level(matched), torch.zeros_like(matched[..., :1])) for level in self.levels)


def sine_positions(cells: int, channels: int) -> Tensor:
    """(C, H, W) B^pos: sines and cosines of the row in the first half of the channels, of the column in the second.

    Wave lengths from two cells to four maps, geometrically. (Vaswani et al., in two dimensions)
    """
    if channels % 4:
        raise EgolocError(f"network: bev: channels: expected the first to be divisible by 4, got {channels}")
    waves = channels // 4
    length = 2.0 * (2.0 * cells) ** (torch.arange(waves) / max(waves - 1, 1))
    phase = 2.0 * math.pi * torch.arange(cells) / length[:, None]
    along = torch.cat((torch.sin(phase), torch.cos(phase)))
    rows, columns = along[:, :, None].expand(-1, -1, cells), along[:, None].expand(-1, cells, -1)
    return torch.cat((rows, columns))
