"""Frames: what the sensors that look around saw at one moment: LiDAR sweeps and images, each with the sensor's pose.

A log holds thousands of them, some MB each: they are read and written one at a time, never all at once.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors._motion_kernels import transform
from sensors.errors import EgolocError
from sensors.images import Image
from sensors.rotation import check_rigid

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Points of one turn of a LiDAR.

    xyz: (N, 3) float32 m, in the LiDAR's axes; offset_ns: (N,) int32, when each point was measured, from the frame's
    t_ns; intensity: (N,) float32 in the sensor's own scale, NaN where there is none; ring: (N,) int16 number of the
    laser, -1 where not known; T_body_lidar: (4, 4); compensated: the recorder has brought the points to the frame's
    t_ns already, as if the vehicle had stood still, so that offset_ns only tells when they were measured.
    """

    xyz: NDArray[np.float32]
    T_body_lidar: Floats = field(default_factory=lambda: np.eye(4))
    offset_ns: NDArray[np.int32] = None  # type: ignore[assignment]
    intensity: NDArray[np.float32] = None  # type: ignore[assignment]
    ring: NDArray[np.int16] = None  # type: ignore[assignment]
    compensated: bool = False

    def __post_init__(self) -> None:
        count = len(self.xyz)
        xyz = self._column("xyz", (count, 3), np.float32, 0.0)
        if not np.isfinite(xyz).all():
            raise EgolocError("Sweep.xyz: expected finite numbers, got NaN or Inf")
        self._column("offset_ns", (count,), np.int32, 0)
        self._column("intensity", (count,), np.float32, np.nan)
        self._column("ring", (count,), np.int16, -1)
        T = self._column("T_body_lidar", (4, 4), np.float64, np.nan)
        check_rigid("Sweep.T_body_lidar", T)

    def __len__(self) -> int:
        return len(self.xyz)

    def in_body(self) -> Floats:
        """(N, 3) m, points in body axes, each at the moment at which it was measured (or was brought to)."""
        out = np.empty(self.xyz.shape)
        transform(self.xyz, self.T_body_lidar, out)
        return out

    def _column(self, name: str, shape: tuple[int, ...], dtype: Any, default: float) -> NDArray[Any]:
        given = getattr(self, name)
        array = np.full(shape, default, dtype) if given is None else np.ascontiguousarray(given, dtype=dtype)
        if array.shape != shape:
            raise EgolocError(f"Sweep.{name}: expected shape {shape}, got {array.shape}")
        array.flags.writeable = False
        object.__setattr__(self, name, array)
        return array


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What was seen at t_ns, and came in at arrival_ns (Unix UTC, ns).

    images: at most one of each camera, each taken at its own t_ns, which is near the frame's.
    """

    t_ns: int
    arrival_ns: int
    sweeps: tuple[Sweep, ...] = ()
    images: tuple[Image, ...] = ()

    def __post_init__(self) -> None:
        names = [image.name for image in self.images]
        if len(set(names)) < len(names):
            raise EgolocError(f"Frame.images: expected one of each camera, got {', '.join(names)}")
