"""What a vehicle with six cameras and a LiDAR sees, made up of noise: enough to time a network on."""

import math

import torch

from egovm.batch import Images, Points
from egovm.config import NetworkConfig

CAMERAS = 6
POINTS = 60_000
"""Of a sweep; a Pandar40P gives about 72,000 at 10 Hz, some of them beyond the plane."""
_FOCAL = 0.8
"""Of an image's width: 64 deg across, so that neighbours overlap a little."""


def scene(config: NetworkConfig) -> tuple[Points | None, Images | None]:
    """One frame of what the config has encoders for."""
    random = torch.Generator().manual_seed(1)
    points = None if config.lidar is None else _points(config.bev.half_m, random)
    images = None if config.camera is None else _images(config.camera.image_hw, random)
    return points, images


def _points(half_m: float, random: torch.Generator) -> Points:
    """Ever fewer with the distance, within 2 m of the ground."""
    away = 2.0 + (half_m - 2.0) * torch.rand(POINTS, generator=random) ** 2
    angle = 2.0 * math.pi * torch.rand(POINTS, generator=random)
    height = 2.0 * torch.rand(POINTS, generator=random) - 1.0
    xyz = torch.stack((away * torch.cos(angle), away * torch.sin(angle), height), -1)
    nothing = torch.zeros(POINTS)
    return Points(xyz, torch.rand(POINTS, generator=random), nothing, nothing.long(), 1)


def _images(hw: tuple[int, int], random: torch.Generator) -> Images:
    """Of level cameras all around, 1.6 m up."""
    height, width = hw
    K = torch.tensor([[_FOCAL * width, 0, (width - 1) / 2], [0, _FOCAL * width, (height - 1) / 2], [0, 0, 1]])
    T = torch.eye(4).repeat(1, CAMERAS, 1, 1)
    for camera in range(CAMERAS):
        c, s = math.cos(2.0 * math.pi * camera / CAMERAS), math.sin(2.0 * math.pi * camera / CAMERAS)
        R = torch.tensor([[s, -c, 0.0], [0.0, 0.0, -1.0], [c, s, 0.0]])
        T[0, camera, :3, :3], T[0, camera, :3, 3] = R, R @ torch.tensor([0.0, 0.0, -1.6])
    rgb = torch.randn(1, CAMERAS, 3, height, width, generator=random)
    return Images(rgb, K.expand(1, CAMERAS, 3, 3), T, torch.ones(1, CAMERAS, dtype=torch.bool))
