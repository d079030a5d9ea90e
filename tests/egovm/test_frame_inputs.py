"""Frames of logs as inputs of the network: places, motion, pixels, batches, and both data sets run through it."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from egovm.bev_network import BevNetwork
from egovm.camera_projection import project
from egovm.config import SMALL, BevConfig, CameraConfig, NetworkConfig
from egovm.frame_inputs import camera_images, frame_inputs
from egovm.timm_models import normalization
from sensors.datasets import frames, load
from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.images import Image
from sensors.motion import ConstantVelocity, Standing, along
from tests.egovm.scenes import TINY
from tests.sensors.pictures import AHEAD, image

T0 = 1_700_000_000_000_000_000
LIDAR_ONLY = msgspec.structs.replace(TINY, camera=None)
LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def sweep(xyz: list[list[float]], **columns: object) -> Sweep:
    T = np.eye(4)
    T[2, 3] = 1.0
    return Sweep(np.array(xyz, np.float32), T, **columns)  # type: ignore[arg-type]


def test_points_are_in_body_axes_within_the_plane() -> None:
    edge = TINY.bev.half_m
    seen = sweep(
        [[1, 2, 0], [edge - 0.1, 0, 0], [edge + 0.1, 0, 0], [0, 0, 3.9], [0, 0, 4.1]],
        intensity=[0.0, 51.0, 1.0, np.nan, 1.0],
        offset_ns=[0, 1_000_000, 0, 0, 0],
    )
    points, images, _ = frame_inputs([Frame(T0, T0, (seen,))], LIDAR_ONLY)
    assert images is None
    assert points is not None
    np.testing.assert_allclose(points.xyz, [[1, 2, 1], [edge - 0.1, 0, 1], [0, 0, 4.9]], rtol=1e-6)
    np.testing.assert_allclose(points.intensity, [0.0, 0.2, 0.0], rtol=1e-6)
    np.testing.assert_allclose(points.offset_s, [0.0, 1e-3, 0.0])
    assert (points.frames, points.frame.tolist(), points.xyz.dtype) == (1, [0, 0, 0], torch.float32)


def test_points_are_brought_to_the_frames_time() -> None:
    """At 10 m/s a thing that stands was 0.5 m nearer 50 ms later; compensated points stay."""
    seen = sweep([[3, 0, 0], [2.5, 0, 0]], offset_ns=[0, 50_000_000])
    moved = ConstantVelocity((10.0, 0.0, 0.0))
    points, _, _ = frame_inputs([Frame(T0, T0, (seen,))], LIDAR_ONLY, [moved])
    assert points is not None
    np.testing.assert_allclose(points.xyz, [[3, 0, 1], [3, 0, 1]], atol=1e-6)
    points, _, _ = frame_inputs([Frame(T0, T0, (replace(seen, compensated=True),))], LIDAR_ONLY, [moved])
    assert points is not None
    np.testing.assert_allclose(points.xyz[:, 0], [3.0, 2.5], atol=1e-6)


def test_frames_make_a_batch() -> None:
    """Frames without points or images keep their place; a camera that one lacks is not valid there."""
    first = Frame(T0, T0, (sweep([[1, 0, 0]]), sweep([[2, 0, 0]])), (image(T0, "a"), image(T0, "b")))
    second = Frame(T0, T0, (), (image(T0, "c"),))
    third = Frame(T0, T0, (sweep([[3, 0, 0]]),))
    points, images, _ = frame_inputs([first, second, third], TINY)
    assert points is not None
    assert images is not None
    assert (points.frames, points.frame.tolist(), points.xyz[:, 0].tolist()) == (3, [0, 0, 2], [1.0, 2.0, 3.0])
    assert images.valid.tolist() == [[True, True, False], [False, False, True], [False, False, False]]
    maps = BevNetwork(TINY).eval()(points, images)
    assert all(len(found) == 3 and found.isfinite().all() for found in maps)


def test_a_place_is_where_the_recorded_image_has_it() -> None:
    """Through resizing, the lens and the motion: the network's projection onto its small image against ``Image.seen``
    at the exposure, of a vehicle that moved on between exposure and frame."""
    K = np.array([[300.0, 0.0, 310.0], [0.0, 320.0, 190.0], [0.0, 0.0, 1.0]])
    taken = Image(bytes(640 * 400 * 3), "rgb8", 640, 400, K, AHEAD, T0 - 40_000_000, "front")
    moved = ConstantVelocity((12.0, 0.0, 0.0), (0.0, 0.0, 0.4))
    camera = CameraConfig(image_hw=(96, 224))
    found = camera_images([Frame(T0, T0, (), (taken,))], camera, [moved], [0.0])
    places = np.array([[12.0, 3.0, 0.4], [25.0, -6.0, 2.0], [8.0, 0.0, 0.0]])
    pixels, inside = project(torch.tensor(places, dtype=torch.float32), found)
    seen = taken.seen(moved.carried(places, T0, taken.t_ns))
    assert inside.all()
    assert seen.inside.all()
    expected = (seen.pixels + 0.5) * (224 / 640, 96 / 400) - 0.5
    np.testing.assert_allclose(pixels[0, 0].numpy(), expected[:, ::-1], atol=1e-3)


def test_colours_are_normalized_means_of_the_pixels() -> None:
    """A white image with a black left half, to a third of its size: the same halves, as the backbone wants them."""
    rgb = np.full((96, 192, 3), 255, np.uint8)
    rgb[:, :96] = 0
    taken = image(T0, kind="rgb8", data=rgb.tobytes(), width=192, height=96)
    config = CameraConfig(backbone="mobilenetv3_small_100", image_hw=(32, 64))
    found = camera_images([Frame(T0, T0, (), (taken,))], config, [Standing()], [0.0]).rgb[0, 0]
    mean, deviation = map(np.array, normalization(config.backbone))
    np.testing.assert_allclose(found[:, 16, 5], -mean / deviation, rtol=1e-5)
    np.testing.assert_allclose(found[:, 16, 60], (1.0 - mean) / deviation, rtol=1e-5)
    assert normalization("mobilenetv3_small_100") == ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    with pytest.raises(EgolocError, match="backbone: expected a model of timm"):
        normalization("no_such_model")


def test_a_lens_is_taken_out() -> None:
    """The network's projection knows no lens: a bright spot that a lens moved is where the pinhole has it."""
    d = np.array([-0.3, 0.08, 0.0, 0.0])
    K = np.array([[120.0, 0.0, 95.5], [0.0, 120.0, 63.5], [0.0, 0.0, 1.0]])
    place = np.array([[10.0, 3.5, 2.5]])
    blank = Image(bytes(192 * 128 * 3), "rgb8", 192, 128, K, AHEAD, T0, "front", "plumb_bob", d)
    column, row = np.rint(blank.seen(place).pixels[0]).astype(int)
    rgb = np.zeros((128, 192, 3), np.uint8)
    rgb[row - 1 : row + 2, column - 1 : column + 2] = 255
    found = camera_images(
        [Frame(T0, T0, (), (replace(blank, data=rgb.tobytes()),))],
        CameraConfig(image_hw=(128, 192)),
        [Standing()],
        [0.0],
    )
    brightest = np.array(np.unravel_index(int(found.rgb[0, 0].sum(0).argmax()), (128, 192)))
    pixels, _ = project(torch.tensor(place, dtype=torch.float32), found)
    assert np.abs(brightest - pixels[0, 0, 0].numpy()).max() <= 2.0
    assert np.abs(np.array([row, column]) - pixels[0, 0, 0].numpy()).max() > 2.5  # the lens had moved it


def test_what_makes_no_batch(data: Path) -> None:
    frame = Frame(T0, T0, (sweep([[1, 0, 0]]),))
    with pytest.raises(EgolocError, match="frames: expected one or more and a motion for each, got 0 and 0"):
        frame_inputs([], TINY)
    with pytest.raises(EgolocError, match="got 1 and 2"):
        frame_inputs([frame], TINY, [Standing()] * 2)
    reference = load("nuscenes-frame", data / "nuscenes_frame").reference
    assert reference is not None
    with pytest.raises(EgolocError, match=f"frame at {T0}: expected a motion known from {T0} to {T0} ns"):
        frame_inputs([frame], TINY, [along(reference)])


SMALL_PLANE = msgspec.structs.replace(SMALL, bev=BevConfig(half_m=20.0, channels=(64, 32, 16), blocks=(0, 1, 0)))


def bev(config: NetworkConfig, found: list[Frame], *motions: object) -> tuple[torch.Tensor, ...]:
    torch.manual_seed(0)
    network = BevNetwork(config).eval()
    with torch.no_grad():
        maps: tuple[torch.Tensor, ...] = network(*frame_inputs(found, config, list(motions) or None)[:2])  # type: ignore[arg-type]
    return maps


def test_the_nuscenes_frame_runs_through_the_network(data: Path) -> None:
    """Six images and a sweep; what the cameras saw counts, as does what the LiDAR saw."""
    folder = data / "nuscenes_frame"
    reference = load("nuscenes-frame", folder).reference
    assert reference is not None
    (frame,) = frames("nuscenes-frame", folder)
    motion = along(reference)
    whole = bev(SMALL_PLANE, [frame], motion)
    assert [tuple(level.shape) for level in whole] == [(1, 64, 80, 80), (1, 32, 160, 160), (1, 16, 320, 320)]
    assert all(level.isfinite().all() for level in whole)
    blind = bev(SMALL_PLANE, [replace(frame, images=())], motion)
    deaf = bev(SMALL_PLANE, [replace(frame, sweeps=())], motion)
    assert (whole[0] - blind[0]).abs().max() > 1e-3
    assert (whole[0] - deaf[0]).abs().max() > 1e-3


def test_an_argoverse_sweep_runs_through_the_network(data: Path) -> None:
    found = list(frames("argoverse2", data / "av2" / LOG))
    log = load("argoverse2", data / "av2" / LOG)
    assert log.reference is not None
    lidar = msgspec.structs.replace(SMALL_PLANE, camera=None)
    maps = bev(lidar, found, *[along(log.reference)] * 2)
    assert [len(level) for level in maps] == [2, 2, 2]
    assert all(level.isfinite().all() for level in maps)
    assert (maps[0][0] - maps[0][1]).abs().max() > 1e-3


def test_bodies_that_ride_higher_are_lifted_to_the_ground_of_the_network() -> None:
    """Told, or seen in the points; images see the lifted axes from as much higher."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(-11.0, 11.0, (4000, 2))
    seen = Frame(T0, T0, (sweep(np.column_stack((xy, rng.normal(-2.7, 0.02, len(xy))))),), (image(T0, "a"),))
    told, looked = frame_inputs([seen], TINY, ground_m=-1.7), frame_inputs([seen], TINY)
    ground = TINY.bev.ground_m
    assert told.lifts == (ground + 1.7,)
    assert looked.lifts == pytest.approx((ground + 1.7,), abs=2e-3)
    assert told.points is not None
    assert told.images is not None
    assert float(told.points.xyz[:, 2].mean()) == pytest.approx(ground, abs=1e-3)
    body = np.array(((6.0, 1.0, -0.4, 1.0),)).T
    lifted = body + np.array(((0.0,), (0.0,), (ground + 1.7,), (0.0,)))
    assert np.allclose(told.images.T_camera_body[0, 0].numpy() @ lifted, seen.images[0].T_camera_body @ body, atol=1e-5)
