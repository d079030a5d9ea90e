"""What goes through the network at once: B frames as tensors, in body axes at the initial pose.

``sensors`` gives frames and map elements in float64 map coordinates; ``egovm.dataset`` subtracts the initial pose in
float64 and makes these records, so that nothing here is larger than the BEV plane and float32 is enough.
"""

from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

SURFEL = 7
"""Type of a surfel; below it are ``sensors.maps.vector_map.Kind``."""
TYPES = 8


@dataclass(frozen=True, slots=True)
class Moved:
    """Tensors that go to a device together."""

    def to(self, device: torch.device | str) -> Self:
        """The same on a device."""
        moved = {
            each.name: value.to(device) if isinstance(value := getattr(self, each.name), Tensor | Moved) else value
            for each in fields(self)
        }
        return type(self)(**moved)


@dataclass(frozen=True, slots=True)
class Points(Moved):
    """LiDAR points of B frames, one after the other.

    xyz: (P, 3) m; intensity: (P,) 0..1; offset_s: (P,) s from the frame's time; frame: (P,) int64 which of the B;
    frames: B, since a frame may have no points.
    """

    xyz: Tensor
    intensity: Tensor
    offset_s: Tensor
    frame: Tensor
    frames: int = 1


@dataclass(frozen=True, slots=True)
class Images(Moved):
    """N images of each frame.

    rgb: (B, N, 3, h, w) float32, normalized as the backbone wants; K: (B, N, 3, 3) intrinsics of these pixels;
    T_camera_body: (B, N, 4, 4), camera z ahead, x right, y down; valid: (B, N) bool.
    """

    rgb: Tensor
    K: Tensor
    T_camera_body: Tensor
    valid: Tensor


@dataclass(frozen=True, slots=True)
class MapElements(Moved):
    """K pieces of map of each frame, in body axes at the initial pose.

    type: (B, K) int64 Kind or SURFEL; ends: (B, K, 2, 3) m, both ends of a segment on the BEV plane (Eq. S1-S4), twice
    the same place for points and surfels, z as far above the plane (0 for segments); height: (B, K) m of poles and
    signs, 0 else; normal: (B, K, 3) and ratios: (B, K, 2) of surfels, 0 else; valid: (B, K) bool.
    """

    type: Tensor
    ends: Tensor
    height: Tensor
    normal: Tensor
    ratios: Tensor
    valid: Tensor


@dataclass(frozen=True, slots=True)
class Batch(Moved):
    """Inputs of B frames. points or images is None where the mode has none."""

    points: Points | None
    images: Images | None
    elements: MapElements


@dataclass(frozen=True, slots=True)
class Truth(Moved):
    """What training compares with.

    offset: (B, 3) x m, y m, yaw rad of the true pose in the initial one (T_init^-1 T_true); semantic: of each level
    (B, TYPES - 1, H, W) bool, what is painted or stands there; surfels have no raster.
    """

    offset: Tensor
    semantic: tuple[Tensor, ...]
