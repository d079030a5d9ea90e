"""Multi-layer BEV maps: the fused one, and finer ones by upsampling, with the pillars' features let in at theirs."""

import torch
from torch import Tensor, nn

from egovm.config import NetworkConfig
from egovm.convolutions import convolution, joint


class BevPyramid(nn.Module):
    """Maps of all levels from that of the first, cells half as wide and features fewer from one to the next."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        bev, lidar = config.bev, config.lidar
        self.first = nn.Sequential(*(convolution(bev.channels[0], bev.channels[0]) for _ in range(bev.blocks[0])))
        self.levels = nn.ModuleList(
            _Finer(
                bev.channels[level - 1],
                bev.channels[level],
                bev.blocks[level],
                lidar.channels[0] if lidar is not None and level == 1 else 0,
            )
            for level in range(1, len(bev.channels))
        )

    def forward(self, fused: Tensor, fine: Tensor | None) -> tuple[Tensor, ...]:
        """(B, C_l, H_l, W_l) of each level. fine: (B, c, 2H, 2W) of pillars, zero for frames without any, or None."""
        maps = [self.first(fused)]
        for index, level in enumerate(self.levels):
            maps.append(level(maps[-1], fine if index == 0 else None))
        return tuple(maps)


class _Finer(nn.Module):
    """Four cells from each, joined by features that are as fine already, and convolutions."""

    def __init__(self, before: int, after: int, blocks: int, joined: int) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(before, after, 2, 2)
        self.join = joint(joined, after) if joined else None
        self.blocks = nn.Sequential(*(convolution(after, after) for _ in range(blocks)))

    def forward(self, x: Tensor, fine: Tensor | None) -> Tensor:
        x = self.up(x)
        if self.join is not None and fine is not None:
            x = x.add_(self.join(fine))
        found: Tensor = self.blocks(torch.relu_(x))
        return found
