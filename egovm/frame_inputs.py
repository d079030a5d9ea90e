"""Frames of a log as the network takes them: points and images in lifted axes at the frame's own time.

Lifted axes are the body's, lifted along z until the ground lies where it lay in training (``BevConfig.ground_m``): what
a thing looks like then does not depend on how high the body's origin rides. Points are brought to the frame's time by
the vehicle's motion. An image stays as it was taken: the camera's pose is that of its exposure, told from the body at
the frame's time, so that what stands is found where it appears. Images are rectified, resized (both axes by themselves;
intrinsics follow) and normalized as the backbone was trained.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovm.batch import Images, Points
from egovm.config import BevConfig, CameraConfig, NetworkConfig
from egovm.projection import ground_under
from egovm.sample import FULL_INTENSITY
from egovm.timm_models import normalization
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.images import Image
from sensors.motion import Motion, Standing, points_at, relative, span_of

Floats = NDArray[np.float64]


class FrameInputs(NamedTuple):
    """What a network takes of B frames; None where it has no encoder for it, or no frame has any.

    lifts: (B,) m, what is added to heights in body axes.
    """

    points: Points | None
    images: Images | None
    lifts: tuple[float, ...]


def frame_inputs(
    frames: Sequence[Frame],
    config: NetworkConfig,
    motions: Sequence[Motion] | None = None,
    ground_m: float | None = None,
) -> FrameInputs:
    """Frames for a network, one batch. motions: of each; None: the vehicle stood.

    ground_m: height of the ground under the vehicle in body axes, m; None: that which the points of each frame show
    (``projection.ground_under``), and where they show none the network's own, so that nothing is lifted.
    Cameras go by name, in the order in which they first appear; where a frame lacks one, its image is not valid.
    Raises EgolocError for no frames, a motion that does not cover its frame, and images that cannot be decoded.
    """
    moved = [Standing()] * len(frames) if motions is None else motions
    if not frames or len(moved) != len(frames):
        raise EgolocError(f"frames: expected one or more and a motion for each, got {len(frames)} and {len(moved)}")
    for frame, motion in zip(frames, moved, strict=True):
        first, last = span_of(frame)
        if not motion.covers(first, last):
            raise EgolocError(f"frame at {frame.t_ns}: expected a motion known from {first} to {last} ns")
    seen = [_places(frame, motion) for frame, motion in zip(frames, moved, strict=True)]
    lifts = tuple(_lift(xyz, config.bev, ground_m) for xyz in seen)
    points = images = None
    if config.lidar is not None and any(frame.sweeps for frame in frames):
        points = lidar_points(frames, seen, config.bev, lifts)
    if config.camera is not None and any(frame.images for frame in frames):
        images = camera_images(frames, config.camera, moved, lifts)
    return FrameInputs(points, images, lifts)


def _places(frame: Frame, motion: Motion) -> Floats:
    """(P, 3) m, body axes at the frame's time, of all its points."""
    parts = [points_at(sweep, frame.t_ns, motion, frame.t_ns) for sweep in frame.sweeps]
    return parts[0] if len(parts) == 1 else np.concatenate([np.empty((0, 3)), *parts])


def _lift(xyz: Floats, bev: BevConfig, ground_m: float | None) -> float:
    ground_m = ground_under(xyz) if ground_m is None else ground_m
    return 0.0 if ground_m is None else bev.ground_m - ground_m


def lidar_points(frames: Sequence[Frame], places: Sequence[Floats], bev: BevConfig, lifts: Sequence[float]) -> Points:
    """The points over the BEV plane, at the heights that are used. places: of each frame, (P, 3) m in body axes."""
    parts = [_points(*each, bev) for each in zip(frames, places, lifts, strict=True)]
    rows = torch.from_numpy(np.concatenate(parts))
    which = torch.repeat_interleave(torch.arange(len(parts)), torch.tensor([len(part) for part in parts]))
    return Points(rows[:, :3], rows[:, 3], rows[:, 4], which, len(parts))


def _points(frame: Frame, xyz: Floats, lift: float, bev: BevConfig) -> NDArray[np.float32]:
    """(P, 5) x y z m, intensity 0..1 and s from the frame's time, of one frame."""
    x, y, z = xyz.T
    low, high = bev.z_m[0] - lift, bev.z_m[1] - lift
    kept = np.flatnonzero((np.abs(x) < bev.half_m) & (np.abs(y) < bev.half_m) & (z >= low) & (z < high))
    found = np.empty((len(kept), 5), np.float32)
    found[:, :3] = xyz[kept]
    found[:, 2] += lift
    if frame.sweeps:
        intensity = np.concatenate([sweep.intensity for sweep in frame.sweeps])[kept]
        found[:, 3] = np.clip(np.nan_to_num(intensity) / FULL_INTENSITY, 0.0, 1.0)
        found[:, 4] = np.concatenate([sweep.offset_ns for sweep in frame.sweeps])[kept] * 1e-9
    return found


def camera_images(
    frames: Sequence[Frame], camera: CameraConfig, motions: Sequence[Motion], lifts: Sequence[float]
) -> Images:
    """The images of all cameras."""
    names = list(dict.fromkeys(image.name for frame in frames for image in frame.images))
    shape = len(frames), len(names)
    height, width = camera.image_hw
    rgb = torch.zeros(*shape, 3, height, width)
    K, T = torch.eye(3).repeat(*shape, 1, 1), torch.eye(4).repeat(*shape, 1, 1)
    valid = torch.zeros(shape, dtype=torch.bool)
    mean, deviation = (torch.tensor(values)[:, None, None] for values in normalization(camera.backbone))
    for b, (frame, motion, lift) in enumerate(zip(frames, motions, lifts, strict=True)):
        for image in frame.images:
            n = names.index(image.name)
            rgb[b, n] = (_pixels(image, height, width) - mean) / deviation
            K[b, n] = torch.from_numpy(_scaled(image, height, width))
            T[b, n] = torch.from_numpy(
                image.T_camera_body @ relative(motion, frame.t_ns, image.t_ns) @ lifted_axes(lift)
            )
            valid[b, n] = True
    return Images(rgb, K, T, valid)


def lifted_axes(lift: float) -> Floats:
    """(4, 4) T_body_lifted: the lifted origin lies so far below the body's, m."""
    T = np.eye(4)
    T[2, 3] = -lift
    return T


def _pixels(image: Image, height: int, width: int) -> Tensor:
    """(3, height, width) 0..1."""
    return torch.from_numpy(image.small(width, height).copy()).permute(2, 0, 1) / 255.0


def _scaled(image: Image, height: int, width: int) -> Floats:
    """(3, 3) intrinsics of the resized image; a whole number is the middle of a pixel before and after."""
    across, down = width / image.width, height / image.height
    K = image.K.copy()
    K[:2, 2] += 0.5
    K[:2] *= np.array([[across], [down]])
    K[:2, 2] -= 0.5
    return K
