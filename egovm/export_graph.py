"""EgoVM of one frame with named tensors in and out, as other runtimes take it: what ``egovm.export`` makes ONNX of.

A mode is a graph of its own: what it has no input for is not in it. Numbers of points, images and pieces of map stay
open. Points and pieces of no use cost nothing but their place: points off the plane, pieces that are not valid.
"""

from dataclasses import fields
from typing import Literal, cast, get_args

import torch
from torch import Tensor, nn

from egovm.batch import Batch, Images, MapElements, Points
from egovm.config import NetworkConfig
from egovm.pose_solver import PoseEstimate
from sensors.errors import EgolocError

Mode = Literal["full", "visual", "lidar"]
Inputs = dict[str, Tensor]

POINTS = ("points_xyz", "points_intensity")
IMAGES = tuple(f"images_{field.name}" for field in fields(Images))
ELEMENTS = tuple(f"elements_{field.name}" for field in fields(MapElements))
OUTPUTS = ("offset", "cov", "landmarks", "modes", "weights", "log_p", "contribution")
_OPEN = {"points": 0, "images": 1, "elements": 1}
"""Which dimension of each kind of inputs stays open."""


class FrameGraph(nn.Module):
    """FrameGraph(EgoVM)(inputs) -> OUTPUTS, without the B of one frame.

    offset: (3,) m, m, rad, T_init^-1 T_est; cov: (L, 3, 3) of each level; landmarks: (L,) int64; modes: (2, 3) as
    offset, and weights: (2,), of the first level; log_p: (yaw, x, y) of the first level; contribution: (K,) of the
    last. Their meaning: ``pose_solver.PoseEstimate`` and ``LevelEstimate``.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, inputs: Inputs) -> tuple[Tensor, ...]:
        found = self.network(batch_of(inputs)).estimate
        assert isinstance(found, PoseEstimate)
        levels = found.levels
        cov, landmarks = torch.cat([each.cov for each in levels]), torch.cat([each.landmarks for each in levels])
        own = found.modes[0], found.weights[0], levels[0].log_p[0], levels[-1].contribution[0]
        return found.offset[0], cov, landmarks, *own


def modes_of(config: NetworkConfig) -> tuple[Mode, ...]:
    """Modes that a network has encoders for, the one with most first."""
    if config.lidar is None:
        return ("visual",)
    return ("lidar",) if config.camera is None else cast("tuple[Mode, ...]", get_args(Mode))


def chosen_mode(config: NetworkConfig, mode: Mode | None) -> Mode:
    """A mode that the network has; None: the one with most inputs. Raises EgolocError for another."""
    known = modes_of(config)
    if mode is not None and mode not in known:
        has = "a camera" if config.camera is not None else "a lidar"
        raise EgolocError(f"mode: expected {known[0]}, for the network {config.name!r} has {has} alone, got {mode}")
    return mode or known[0]


def names_of(mode: Mode) -> tuple[str, ...]:
    """Names of the inputs of a mode, in their order."""
    return (*(POINTS if mode != "visual" else ()), *(IMAGES if mode != "lidar" else ()), *ELEMENTS)


def kind_of(name: str) -> str:
    """points, images or elements, which also is what their open dimension is called."""
    return name.partition("_")[0]


def open_dimension(name: str) -> int:
    """Which dimension of an input stays open."""
    return _OPEN[kind_of(name)]


def inputs_of(batch: Batch, mode: Mode) -> Inputs:
    """A batch of one frame as inputs of a mode: its tensors under their names."""
    if len(batch.elements.valid) != 1:
        raise ValueError(f"inputs_of: expected one frame, got {len(batch.elements.valid)}")
    return {name: getattr(getattr(batch, kind_of(name)), name.partition("_")[2]) for name in names_of(mode)}


def batch_of(inputs: Inputs) -> Batch:
    """Inputs of any mode as a batch of one frame."""
    own = {
        kind: {name.partition("_")[2]: value for name, value in inputs.items() if kind_of(name) == kind}
        for kind in _OPEN
    }
    points = None
    if own["points"]:
        nothing = torch.zeros_like(own["points"]["intensity"])
        points = Points(own["points"]["xyz"], own["points"]["intensity"], nothing, nothing.to(torch.int64))
    images = Images(**own["images"]) if own["images"] else None
    return Batch(points, images, MapElements(**own["elements"]))
