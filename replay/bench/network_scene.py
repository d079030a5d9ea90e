"""What a vehicle with six cameras and a LiDAR sees, and a map around it, made up of noise: enough for timing."""

import math

import torch

from egovm.batch import SURFEL, TYPES, Batch, Images, MapElements, Points, Truth
from egovm.config import NetworkConfig
from sensors.maps.vector_map import Kind

CAMERAS = 6
POINTS = 60_000
"""Of a sweep; a Pandar40P gives about 72,000 at 10 Hz, some of them beyond the plane."""
_FOCAL = 0.8
"""Of an image's width: 64 deg across, so that neighbours overlap a little."""


def scene(config: NetworkConfig) -> Batch:
    """One frame of what the config has encoders for, and as many map elements as it takes at most."""
    random = torch.Generator().manual_seed(1)
    points = None if config.lidar is None else _points(config.bev.half_m, random)
    images = None if config.camera is None else _images(config.camera.image_hw, random)
    return Batch(points, images, _elements(config, random))


def truth(config: NetworkConfig) -> Truth:
    """A true pose within the lattice, and one cell of a hundred drawn in each raster."""
    random = torch.Generator().manual_seed(2)
    sides = [config.bev.cells(level) for level in range(len(config.bev.channels))]
    drawn = tuple(torch.rand(1, TYPES - 1, side, side, generator=random) < 0.01 for side in sides)
    return Truth(torch.tensor([[0.3, -0.2, 0.01]]), drawn)


def _elements(config: NetworkConfig, random: torch.Generator) -> MapElements:
    """Half of them surfels where there are any, the rest of all kinds, up to 4.5 m from the plane's edge."""
    count = config.matching.most_elements
    type_ = torch.arange(count) % SURFEL
    if config.ablation.surfels:
        type_[::2] = SURFEL
    stands = (type_ == SURFEL) | (type_ == Kind.POLE) | (type_ == Kind.SIGN)
    middle = (config.bev.half_m - 4.5) * (2.0 * torch.rand(count, 2, generator=random) - 1.0)
    angle = 2.0 * math.pi * torch.rand(count, generator=random)
    along = 0.5 * config.matching.segment_m * torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    along[stands] = 0.0
    ends = torch.stack((middle - along, middle + along), 1)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=-1)
    ratios = torch.rand(count, 2, generator=random)
    height, valid = 5.0 * torch.rand(count, generator=random), torch.ones(count, dtype=torch.bool)
    columns = type_, torch.nn.functional.pad(ends, (0, 1)), height, normal, ratios, valid
    return MapElements(*(each[None] for each in columns))


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
