"""LiDAR encoder: points into pillars with scatter_reduce, then 2-D convolutions to the BEV (PointPillars, Lang et al.).

A frame without points in range gives no NaN, and says so.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from egovm.batch import Points
from egovm.bev_grid import BevGrid
from egovm.config import BevConfig, LidarConfig
from egovm.convolutions import convolution, joint

_POINT = 8


@dataclass(frozen=True, slots=True)
class LidarBev:
    """features: (B, C, H, W) at the first BEV level; fine: (B, c, 2H, 2W) at the pillars' cells; present: (B,) bool,
    the frame has points in range.
    """

    features: Tensor
    fine: Tensor
    present: Tensor


class PillarEncoder(nn.Module):
    """Each point through an MLP, the most of each feature by pillar. Nothing is computed for an empty pillar.

    A point is known by where it lies in its pillar and from the mean of its points, its height and intensity: not by
    where the pillar is, so that the features of a thing do not depend on its place.
    """

    def __init__(self, config: LidarConfig, bev: BevConfig) -> None:
        super().__init__()
        self.grid = BevGrid(round(2.0 * bev.half_m / config.cell_m), config.cell_m)
        self.z_m = bev.z_m
        width = config.channels[0]
        self.layers = nn.Sequential(
            nn.Linear(_POINT, width), nn.ReLU(inplace=True), nn.Linear(width, width), nn.ReLU(inplace=True)
        )

    def forward(self, points: Points) -> tuple[Tensor, Tensor]:
        """Pillars (B, C, n, n), zero where there is no point, and (B,) bool of frames that have points in range."""
        n = self.grid.cells
        cells = self.grid.cells_from_m(points.xyz[:, :2])
        nearest = torch.floor(cells + 0.5).to(torch.int64)
        low, high = self.z_m
        height = points.xyz[:, 2]
        keep = ((nearest >= 0) & (nearest < n)).all(-1) & (height >= low) & (height < high)
        kept = keep.nonzero()[:, 0]
        frame, nearest = points.frame.index_select(0, kept), nearest.index_select(0, kept)
        index = (frame * n + nearest[:, 0]) * n + nearest[:, 1]
        part = cells.index_select(0, kept) - nearest
        known = self._known(points.xyz.index_select(0, kept), points.intensity[kept], part, index, points.frames)
        canvas = known.new_zeros(points.frames * n * n, known.shape[1])
        canvas = canvas.scatter_reduce_(0, index[:, None].expand_as(known), known, "amax")
        count = torch.zeros(points.frames, dtype=torch.int64, device=index.device)
        present = count.index_add(0, frame, torch.ones_like(frame)) > 0
        return canvas.reshape(points.frames, n, n, -1).permute(0, 3, 1, 2), present

    def _known(self, xyz: Tensor, intensity: Tensor, part: Tensor, index: Tensor, frames: int) -> Tensor:
        """(P, C) of points in the pillars of index (P,). part: (P, 2) where a point lies in its pillar, in cells."""
        # sum and count at once: ONNX has no mean of what is scattered
        counted = torch.cat((xyz, torch.ones_like(xyz[:, :1])), -1)
        empty = xyz.new_zeros(frames * self.grid.cells**2, 4)
        total = empty.scatter_reduce_(0, index[:, None].expand_as(counted), counted, "sum").index_select(0, index)
        mean = total[:, :3] / total[:, 3:]
        low, high = self.z_m
        height = (2.0 * xyz[:, 2:] - (low + high)) / (high - low)
        parts = (2.0 * part, (xyz - mean) / self.grid.cell_m, height, intensity[:, None])
        # a point alone in its pillar is told from one in the middle of many
        alone = (total[:, 3:] == 1.0).to(xyz.dtype)
        known: Tensor = self.layers(torch.cat((*parts, alone), -1))
        return known


class LidarEncoder(nn.Module):
    """Pillars, stages of convolutions on cells each twice as wide as before, joined at the first BEV level."""

    def __init__(self, config: LidarConfig, bev: BevConfig) -> None:
        super().__init__()
        self.pillars = PillarEncoder(config, bev)
        widths = (config.channels[0], *config.channels)
        self.stages = nn.ModuleList(
            _stage(widths[i], widths[i + 1], count, 1 if i == 0 else 2) for i, count in enumerate(config.blocks)
        )
        # stage i has cells 2^(i - 1) times as wide as the first BEV level; the first is the skip
        self.ups = nn.ModuleList(
            nn.Upsample(scale_factor=2**i, mode="bilinear") for i in range(1, len(config.blocks) - 1)
        )
        self.joins = nn.ModuleList(joint(width, bev.channels[0]) for width in config.channels[1:])

    def forward(self, points: Points) -> LidarBev:
        """Features of all frames."""
        canvas, present = self.pillars(points)
        fine = self.stages[0](canvas)
        x = self.stages[1](fine)
        joined: Tensor = self.joins[0](x)
        for stage, up, join in zip(list(self.stages)[2:], self.ups, list(self.joins)[1:], strict=True):
            x = stage(x)
            joined = joined.add_(up(join(x)))
        return LidarBev(torch.relu_(joined), fine, present)


def _stage(before: int, after: int, count: int, stride: int) -> nn.Sequential:
    first = convolution(before, after, stride)
    return nn.Sequential(first, *(convolution(after, after) for _ in range(count - 1)))
