"""Inputs to export a network with, and to compare it on: made-up streets, and images of noise all around.

The simulation draws no images; noise tells as well whether two runtimes compute the same.
"""

import math
from collections.abc import Iterator
from dataclasses import fields

import msgspec
import torch
from torch import Tensor

from egovm.batch import Batch, Images, MapElements, Points
from egovm.config import CameraConfig, NetworkConfig
from egovm.dataset import NOISES, EvaluationBatches
from egovm.export_graph import Inputs, Mode, inputs_of
from egovm.made_samples import Recipe

CAMERAS = (3, 2)
"""Of the first frame and of the next."""
_FOCAL = 0.6
"""Of an image's width: 80 deg across."""
_HEIGHT_M = 1.6


def sample_frames(config: NetworkConfig, mode: Mode) -> Iterator[tuple[str, Inputs]]:
    """Frames by what they are: two of other places, with other numbers of everything, and one with nothing in it."""
    # the LiDAR is needed for the sample, whether or not the network has one
    with_lidar = config if config.lidar is not None else msgspec.structs.replace(config, lidar=NetworkConfig().lidar)
    batches = EvaluationBatches(Recipe(), with_lidar, NOISES["uniform"], len(CAMERAS))
    for number, cameras in enumerate(CAMERAS):
        seen = batches[number][0]
        images = None if config.camera is None else noise_images(config.camera, cameras, number)
        elements = _some_more(seen.elements) if number == 0 else _nearer_half(seen.elements)
        yield f"frame {number + 1}", inputs_of(Batch(seen.points, images, elements), mode)
    yield "an empty frame", inputs_of(empty_frame(config), mode)


def noise_images(camera: CameraConfig, count: int, seed: int) -> Images:
    """Of level cameras that look all around."""
    height, width = camera.image_hw
    K = torch.tensor([[_FOCAL * width, 0, (width - 1) / 2], [0, _FOCAL * width, (height - 1) / 2], [0, 0, 1]])
    T = torch.stack([_camera(2.0 * math.pi * each / count) for each in range(count)])[None]
    rgb = torch.randn(1, count, 3, height, width, generator=torch.Generator().manual_seed(seed))
    return Images(rgb, K.repeat(1, count, 1, 1), T, torch.ones(1, count, dtype=torch.bool))


def empty_frame(config: NetworkConfig) -> Batch:
    """No point, a black image that is not valid, no piece of map but padding."""
    points = Points(torch.zeros(0, 3), torch.zeros(0), torch.zeros(0), torch.zeros(0, dtype=torch.int64), 1)
    images = None
    if config.camera is not None:
        seen = noise_images(config.camera, 1, 0)
        images = Images(torch.zeros_like(seen.rgb), seen.K, seen.T_camera_body, torch.zeros_like(seen.valid))
    type_ = torch.zeros(1, 1, dtype=torch.int64)
    ends, height, normal, ratios = (torch.zeros(1, 1, *shape) for shape in ((2, 3), (), (3,), (2,)))
    return Batch(points, images, MapElements(type_, ends, height, normal, ratios, type_ > 0))


def _some_more(elements: MapElements) -> MapElements:
    """With two rows of padding: where a map has fewer, numbers are as many as an export needs."""
    padded = {}
    for field in fields(elements):
        value = getattr(elements, field.name)
        padded[field.name] = torch.cat((value, value.new_zeros(1, 2, *value.shape[2:])), 1)
    return MapElements(**padded)


def _nearer_half(elements: MapElements) -> MapElements:
    """Networks with few places have as many elements in all frames."""
    half = (elements.valid.shape[1] + 1) // 2
    return MapElements(**{field.name: getattr(elements, field.name)[:, :half] for field in fields(elements)})


def _camera(yaw: float) -> Tensor:
    """(4, 4) T_camera_body of a camera that looks along a yaw."""
    c, s = math.cos(yaw), math.sin(yaw)
    R = torch.tensor([[s, -c, 0.0], [0.0, 0.0, -1.0], [c, s, 0.0]])
    T = torch.eye(4)
    T[:3, :3], T[:3, 3] = R, R @ torch.tensor([0.0, 0.0, -_HEIGHT_M])
    return T
