"""Small networks, cameras around a vehicle, and points."""

import math

import torch
from torch import Tensor

from egovm.batch import Images, Points
from egovm.config import PAPER, SMALL, BevConfig, CameraConfig, FusionConfig, LidarConfig, NetworkConfig

TINY = NetworkConfig(
    name="tiny",
    bev=BevConfig(half_m=8.0, channels=(16, 8, 4), blocks=(0, 1, 0)),
    camera=CameraConfig(backbone="mobilenetv3_small_050", image_hw=(64, 96), channels=16),
    lidar=LidarConfig(channels=(8, 8, 16), blocks=(1, 1, 1)),
    fusion=FusionConfig(layers=1, heads=2, cross_points=4, hidden=16),
)
"""32, 64 and 128 cells, two images of 64 x 96 pixels."""
PRESETS = (PAPER, SMALL)
FOCAL = 60.0


def camera_axes(yaw: float) -> Tensor:
    """(3, 3) R_camera_body of a camera that looks along a yaw: its z ahead, its x to the right, its y down."""
    c, s = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[s, -c, 0.0], [0.0, 0.0, -1.0], [c, s, 0.0]])


def images(yaws: tuple[float, ...] = (0.0, math.pi), hw: tuple[int, int] = (64, 96), frames: int = 1) -> Images:
    """Noise seen by level cameras 1.5 m above the body's origin."""
    count = len(yaws)
    T = torch.eye(4).repeat(frames, count, 1, 1)
    K = torch.tensor([[FOCAL, 0.0, (hw[1] - 1) / 2], [0.0, FOCAL, (hw[0] - 1) / 2], [0.0, 0.0, 1.0]])
    for n, yaw in enumerate(yaws):
        T[:, n, :3, :3] = camera_axes(yaw)
        T[:, n, :3, 3] = camera_axes(yaw) @ torch.tensor([0.0, 0.0, -1.5])
    rgb = torch.randn(frames, count, 3, *hw, generator=torch.Generator().manual_seed(1))
    return Images(rgb, K.expand(frames, count, 3, 3), T, torch.ones(frames, count, dtype=torch.bool))


def points(count: int = 500, frames: int = 1, half_m: float = 8.0) -> Points:
    """Points anywhere on the plane, shared out among the frames, some of them beyond its edge."""
    random = torch.Generator().manual_seed(2)
    xyz = (torch.rand(count, 3, generator=random) - 0.5) * torch.tensor((2.2 * half_m, 2.2 * half_m, 3.0))
    return Points(
        xyz,
        torch.rand(count, generator=random),
        torch.zeros(count),
        torch.arange(count) % frames,
        frames,
    )


def no_points(frames: int = 1) -> Points:
    """A LiDAR that saw nothing."""
    return Points(torch.zeros(0, 3), torch.zeros(0), torch.zeros(0), torch.zeros(0, dtype=torch.int64), frames)
