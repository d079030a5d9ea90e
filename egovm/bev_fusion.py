"""BEV fusion: queries on the BEV plane look at themselves and at the images (after BEVFormer, Li et al.).

Queries start as LiDAR features, or as learned ones in visual mode. Layers add to them, so that a cell that no camera
sees goes on as it is. Each query's pillar has anchors at some heights; where they appear in an image the query looks
around them, and what it finds is averaged over the cameras that see it.
"""

import torch
from torch import Tensor, nn

from egovm.batch import Images
from egovm.bev_grid import BevGrid
from egovm.camera_encoder import STRIDE
from egovm.camera_projection import feature_cells, project
from egovm.config import NetworkConfig
from egovm.deformable_attention import DeformableAttention, deformable_sum


class GridEmbedding(nn.Module):
    """A learned vector for each cell: that of its row and that of its column added."""

    def __init__(self, cells: int, channels: int) -> None:
        super().__init__()
        self.rows = nn.Parameter(0.02 * torch.randn(cells, channels))
        self.columns = nn.Parameter(0.02 * torch.randn(cells, channels))

    def forward(self) -> Tensor:
        """(H W, C), row by row."""
        return (self.rows[:, None] + self.columns).flatten(0, 1)


class ImageAttention(nn.Module):
    """Deformable attention of BEV queries into the images that see them.

    Only pairs of a query and a camera that sees one of its anchors are computed: about one of N. dense computes all
    pairs, for the same result: shapes then do not depend on the cameras.
    """

    def __init__(self, channels: int, heads: int, points: int, anchors: int) -> None:
        super().__init__()
        self.attention = DeformableAttention(channels, heads, points, anchors)
        self.dense = False

    def forward(self, queries: Tensor, features: Tensor, cells: Tensor, seen: Tensor) -> Tensor:
        """(B, Q, C) what is found, 0 for queries that no camera sees.

        queries: (B, Q, C); features: (B, N, C, h, w); cells: (B, N, Q, A, 2) where their anchors appear in the
        features, and seen: (B, N, Q, A) whether they do.
        """
        samples, count, channels = queries.shape
        hit = seen.any(-1)
        pairs = torch.ones_like(hit) if self.dense else hit
        frame, camera, query = pairs.nonzero(as_tuple=True)
        offsets, weights = self.attention.looks(queries)
        weights = weights[frame, query] * self._share(seen[frame, camera, query])
        places = self.attention.at(cells[frame, camera, query], offsets[frame, query])
        read = self._read(features, frame * features.shape[1] + camera, places, weights)
        flat = read.new_zeros(samples * count, channels).index_add(0, frame * count + query, read)
        times = hit.sum(1)[..., None]
        found: Tensor = self.attention.out(flat.reshape(samples, count, channels) / times.clamp(min=1))
        return found * (times > 0)

    def _share(self, seen: Tensor) -> Tensor:
        """(M, 1, P) 1 for the points of anchors that are seen, else 0; seen: (M, A)."""
        return seen.repeat_interleave(self.attention.points // seen.shape[-1], dim=-1)[:, None]

    def _read(self, features: Tensor, image: Tensor, places: Tensor, weights: Tensor) -> Tensor:
        """(M, C) sums for each pair. image: (M,) which of B N; places: (M, heads, P, 2); weights: (M, heads, P).

        All images lie below one another in one map, a row of zeros after each, so that one call reads them all.
        """
        height, width = features.shape[-2:]
        row, column = places.unbind(-1)
        inside = (row > -1.0) & (row < height) & (column > -1.0) & (column < width)
        below = torch.stack((row + (image * (height + 1))[:, None, None], column), -1)
        values = self.attention.valued(features.flatten(0, 1).permute(0, 2, 3, 1))
        apart = nn.functional.pad(values, (0, 0, 0, 0, 0, 0, 0, 1)).flatten(0, 1)
        return deformable_sum(apart[None], below[None], (weights * inside)[None])[0].flatten(1)


class FusionLayer(nn.Module):
    """Self attention on the BEV, cross attention into the images, and a feed-forward network, each added."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        fusion, channels = config.fusion, config.bev.channels[0]
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.around = DeformableAttention(channels, fusion.heads, fusion.self_points)
        self.images = ImageAttention(channels, fusion.heads, fusion.cross_points, len(fusion.heights_m))
        self.feed = nn.Sequential(
            nn.Linear(channels, fusion.hidden), nn.ReLU(inplace=True), nn.Linear(fusion.hidden, channels)
        )

    def forward(
        self, x: Tensor, position: Tensor, own: Tensor, features: Tensor, cells: Tensor, seen: Tensor
    ) -> Tensor:
        """(B, Q, C) queries after the layer. own: (1, Q, 1, 2) their cells; cells and seen: as ImageAttention's."""
        side = round(x.shape[1] ** 0.5)
        normed = self.norms[0](x)
        plane = torch.unflatten(normed, 1, (side, side))
        x = x + self.around(normed + position, own.expand(len(x), -1, -1, -1), plane)
        x = x + self.images(self.norms[1](x) + position, features, cells, seen)
        found: Tensor = x + self.feed(self.norms[2](x))
        return found


class BevFusion(nn.Module):
    """Adds to a BEV map (B, C, H, W) what its queries find in the images."""

    anchors: Tensor
    own: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        fusion, channels = config.fusion, config.bev.channels[0]
        self.times = round(fusion.cell_m / config.bev.cell_m[0])
        grid = BevGrid(config.bev.cells(0) // self.times, fusion.cell_m)
        like = torch.zeros(())
        self.register_buffer("anchors", pillar_anchors(grid, fusion.heights_m), persistent=False)
        self.register_buffer("own", grid.indices(like).reshape(1, -1, 1, 2), persistent=False)
        self.position = GridEmbedding(grid.cells, channels)
        self.layers = nn.ModuleList(FusionLayer(config) for _ in range(fusion.layers))
        self.finer = (
            nn.Identity()
            if self.times == 1
            else nn.Sequential(nn.Conv2d(channels, channels * self.times**2, 1), nn.PixelShuffle(self.times))
        )

    def forward(self, bev: Tensor, features: Tensor, images: Images) -> Tensor:
        """features: (B, N, C, h, w) of the images. Frames without a valid image come back as they are."""
        pixels, seen = project(self.anchors.flatten(0, 1), images)
        shape = (*seen.shape[:2], *self.anchors.shape[:2])
        cells, seen = feature_cells(pixels, STRIDE).reshape(*shape, 2), seen.reshape(shape)
        before = nn.functional.avg_pool2d(bev, self.times) if self.times > 1 else bev
        start = x = before.flatten(2).transpose(1, 2)
        position = self.position()
        for layer in self.layers:
            x = layer(x, position, self.own, features, cells, seen)
        added = self.finer((x - start).transpose(1, 2).reshape(before.shape))
        any_image = images.valid.any(1)[:, None, None, None]
        return torch.addcmul(bev, added, any_image.to(added.dtype))


def pillar_anchors(grid: BevGrid, heights_m: tuple[float, ...]) -> Tensor:
    """(H W, A, 3) m in body axes, places above the middles of the cells, row by row."""
    middles = grid.middles(torch.zeros(())).reshape(-1, 1, 2).expand(-1, len(heights_m), -1)
    heights = torch.tensor(heights_m)[:, None].expand(len(middles), -1, -1)
    return torch.cat((middles, heights), -1)
