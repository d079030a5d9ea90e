"""The BEV side of the network: points and images of B frames into BEV maps of all levels.

Axes of the maps: ``egovm.bev_grid``. One set of weights serves every mode: a frame without points in range starts from
learned queries, a frame without a valid image is not fused; in training either is left out now and then.
"""

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import torch
from torch import Tensor, nn

from egovm.batch import Images, Points
from egovm.bev_fusion import BevFusion, GridEmbedding
from egovm.bev_pyramid import BevPyramid
from egovm.camera_encoder import CameraEncoder
from egovm.config import NetworkConfig
from egovm.lidar_encoder import LidarEncoder
from sensors.errors import EgolocError


class BevNetwork(nn.Module):
    """BevNetwork(config)(points, images) -> (B, C_l, H_l, W_l) of each level l."""

    def __init__(self, config: NetworkConfig, backbone_weights: Path | None = None) -> None:
        """backbone_weights: a local file with weights of the image backbone; without it they are random."""
        super().__init__()
        self.config = config
        self.drops = (config.fusion.drop_cameras, config.fusion.drop_lidar) if config.camera is not None else (0.0, 0.0)
        """Parts of the training steps without images, and without points."""
        self.camera = None if config.camera is None else CameraEncoder(config.camera, backbone_weights)
        self.fusion = None if config.camera is None else BevFusion(config)
        self.lidar = None if config.lidar is None else LidarEncoder(config.lidar, config.bev)
        self.queries = GridEmbedding(config.bev.cells(0), config.bev.channels[0])
        self.pyramid = BevPyramid(config)
        self.precision: torch.dtype | None = None
        """Of convolutions and matrix products where it is not the weights' own; maps are then given as they come."""

    def forward(self, points: Points | None, images: Images | None) -> tuple[Tensor, ...]:
        """Maps of all levels. What the network has no encoder for is not looked at.

        Raises EgolocError where neither is left, or both tell different numbers of frames.
        """
        points = points if self.lidar is not None else None
        images = images if self.camera is not None else None
        frames = _frames(points, images)
        if self.training:
            points, images = self._some(points, images)
        with self._precise():
            bev, fine = self._started(points, frames)
            if images is not None and self.camera is not None and self.fusion is not None:
                bev = self.fusion(bev, self.camera(images.rgb), images)
            maps: tuple[Tensor, ...] = self.pyramid(bev, fine)
        return maps

    def _precise(self) -> AbstractContextManager[object]:
        if self.precision is None:
            return nullcontext()
        return torch.autocast(self.queries.rows.device.type, self.precision)

    def _started(self, points: Points | None, frames: int) -> tuple[Tensor, Tensor | None]:
        """BEV queries (B, C, H, W): LiDAR features, or learned ones of frames without points; and the pillars'."""
        cells = self.config.bev.cells(0)
        learned = self.queries().T.reshape(1, -1, cells, cells)
        if points is None or self.lidar is None:
            return learned.expand(frames, -1, -1, -1), None
        seen = self.lidar(points)
        if not (self.training or torch.compiler.is_exporting()) and seen.present.all():
            return seen.features, seen.fine
        present = seen.present[:, None, None, None]
        return torch.where(present, seen.features, learned), seen.fine * present

    def _some(self, points: Points | None, images: Images | None) -> tuple[Points | None, Images | None]:
        """Both, or one of them, at random; one that came alone stays."""
        if points is None or images is None:
            return points, images
        drawn, (cameras, lidar) = torch.rand(()).item(), self.drops
        if drawn < cameras:
            return points, None
        if drawn < cameras + lidar:
            return None, images
        return points, images


def _frames(points: Points | None, images: Images | None) -> int:
    """How many frames there are."""
    counts = {len(images.rgb)} if images is not None else set()
    counts |= {points.frames} if points is not None else set()
    if not counts:
        raise EgolocError("network: expected points, images or both, got nothing that it has an encoder for")
    if len(counts) > 1:
        raise EgolocError(f"network: expected as many frames with points as with images, got {sorted(counts)}")
    return counts.pop()
