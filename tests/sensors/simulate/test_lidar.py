"""The simulated LiDAR: its pattern, its truth, its noise, and that of its seed."""

from itertools import islice

import msgspec
import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.simulate.drive import DriveConfig, plan
from sensors.simulate.lidar import AZIMUTH_DEG, ELEVATION_DEG, beams, column_times, poses, sweep
from sensors.simulate.lidar_config import LidarSimulation
from sensors.simulate.network import NetworkPlan
from sensors.simulate.scene import CELL_M, Scene, Solids
from sensors.simulate.surroundings import drive_frames, drive_map, drive_world

CONFIG = DriveConfig(network=NetworkPlan(length_km=20.0))
SLOW = msgspec.structs.replace(CONFIG, lidar=LidarSimulation(rate_hz=1.0))
"""A turn takes a second, in which the vehicle moves by metres."""
MOVING_S = 25


def same(a: Frame, b: Frame) -> bool:
    columns = zip(a.sweeps, b.sweeps, strict=True)
    return a.t_ns == b.t_ns and all(
        np.array_equal(getattr(x, name), getattr(y, name))
        for x, y in columns
        for name in ("xyz", "offset_ns", "intensity", "ring")
    )


def walled(distance: float, reflectivity: float) -> Scene:
    """Walls on four sides and no ground in reach."""
    d = distance
    sides = [(d, -d, 0, 2 * d), (-d, -d, 2 * d, 0), (-d, d, 0, -2 * d), (d, d, -2 * d, 0)]
    plates = np.array([(x, y, -200.0, u, v, 0.0, 0.0, 0.0, 400.0, reflectivity) for x, y, u, v in sides])
    none = Solids(plates, np.empty((0, 6)), np.empty((0, 5)), np.empty((0, 10)))
    half = int(distance / CELL_M) + 2
    return Scene.of(np.full(2, -half * CELL_M), np.full((2 * half + 1,) * 2, -500.0), none)


def standing(scene: Scene, config: LidarSimulation, seed: int = 0) -> Sweep:
    count = config.columns
    at, level = np.zeros((count, 3)), np.broadcast_to(np.eye(3), (count, 3, 3))
    return sweep(scene, at, level, config, np.random.default_rng(seed))


def test_its_pattern_is_the_manuals() -> None:
    assert len(ELEVATION_DEG) == len(AZIMUTH_DEG) == 40
    assert (np.diff(ELEVATION_DEG) < 0).all()
    np.testing.assert_array_equal(ELEVATION_DEG[[0, 5, 6, 11, 29, 30, 39]], (15.0, 2.0, 1.67, 0.0, -6.0, -7.0, -25.0))
    np.testing.assert_array_equal(
        AZIMUTH_DEG[[0, 6, 7, 8, 28, 29, 39]], (-1.042, 3.125, -5.208, -1.042, -5.208, -1.042, -1.042)
    )
    rays = beams(1800)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, rtol=1e-14)
    turned = np.degrees(np.unwrap(np.arctan2(rays[:, 11, 1], rays[:, 11, 0])))
    np.testing.assert_allclose(np.diff(turned), -0.2, atol=1e-9)


def test_ranges_have_their_noise_and_no_other_error() -> None:
    config = LidarSimulation(dropped_fraction=0.0, place=(0.0, 0.0, 0.0))
    seen = standing(walled(20.0, 0.5), config)
    assert len(seen) == 1800 * 40
    along = seen.xyz / np.linalg.norm(seen.xyz, axis=1, keepdims=True)
    error = np.linalg.norm(seen.xyz, axis=1) - 20.0 / np.abs(along[:, :2]).max(axis=1)
    assert np.mean(error) == pytest.approx(0.0, abs=4 * 0.02 / np.sqrt(len(seen)))
    assert np.mean(error**2) / 0.02**2 == pytest.approx(1.0, abs=5 * np.sqrt(2 / len(seen)))


@pytest.mark.parametrize(
    ("reflectivity", "distance", "heard"),
    [(0.1, 45.0, True), (0.4, 55.0, False), (0.025, 22.0, True), (0.025, 28.0, False)],
)
def test_ten_percent_are_heard_as_far_as_it_says(reflectivity: float, distance: float, heard: bool) -> None:
    """A quarter of them half as far; nothing beyond the farthest range, however bright."""
    config = LidarSimulation(range_max_m=50.0, dropped_fraction=0.0, echo_sigma=0.0, place=(0.0, 0.0, 0.0))
    seen = standing(walled(distance, reflectivity), config)
    ahead = (np.abs(seen.xyz[:, 1]) < 0.5) & (seen.xyz[:, 0] > 0.0) & (seen.ring == 11)
    assert ahead.any() == heard


def test_a_share_of_the_returns_is_lost() -> None:
    config = LidarSimulation(dropped_fraction=0.1)
    lost = 1.0 - len(standing(walled(20.0, 0.5), config)) / 72_000
    assert lost == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / 72_000))


def test_intensity_is_that_of_the_surface() -> None:
    config = LidarSimulation(place=(0.0, 0.0, 0.0))
    dark, bright = (standing(walled(20.0, value), config) for value in (0.2, 0.8))
    for seen, percent in ((dark, 20.0), (bright, 80.0)):
        head_on = (np.abs(seen.xyz[:, 1]) < 1.0) & (seen.ring == 11)
        assert seen.intensity[head_on].mean() == pytest.approx(percent, rel=0.05)


def test_frames_of_a_moving_vehicle_lie_on_the_world() -> None:
    """By the truth at the time of each point, every range is the world's but for the noise (chi-square)."""
    planned = plan(60.0, 0, CONFIG)
    frame = next(islice(drive_frames(60.0, 0, SLOW), MOVING_S, None))
    seen = frame.sweeps[0]
    world = drive_world(planned, CONFIG)
    t_ns = frame.t_ns + seen.offset_ns.astype(np.int64)
    p_map, R = poses(planned.truth, world.frame, t_ns)
    assert np.linalg.norm(p_map[-1] - p_map[0]) > 3.0, "the vehicle stands"
    origins = p_map + R @ np.array(CONFIG.lidar.place)
    points = np.einsum("nij,nj->ni", R, seen.in_body()) + p_map
    distance = np.linalg.norm(points - origins, axis=1)
    rays = (points - origins) / distance[:, None]
    scene = world.scene(origins[0, :2], 300.0)
    turned = np.broadcast_to(np.eye(3), R.shape)
    true = scene.cast(origins, turned, np.ascontiguousarray(rays[:, None]), 250.0).distance[:, 0]
    error = (distance - true) / CONFIG.lidar.range_sigma_m
    # a ray along an edge may pass on its other side after rounding to float32
    off = np.abs(error) > 6.0
    assert off.mean() < 2e-4
    count = int((~off).sum())
    assert count > 40_000
    assert np.mean(error[~off] ** 2) == pytest.approx(1.0, abs=5 * np.sqrt(2 / count))
    ground = np.abs(points[:, 2] - world.height(points[:, :2])) < 0.05
    assert 0.2 < ground.mean() < 0.7


def test_frames_are_those_of_the_seed() -> None:
    first, again, other = (list(islice(drive_frames(20.0, seed, CONFIG), 3)) for seed in (4, 4, 5))
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    assert not any(same(a, b) for a, b in zip(first, other, strict=True))
    stamps = np.array([frame.t_ns for frame in first])
    np.testing.assert_array_equal(np.diff(stamps), 100_000_000)
    assert all(frame.arrival_ns == frame.t_ns + 110_000_000 for frame in first)
    offsets = first[0].sweeps[0].offset_ns
    assert offsets.min() == 0
    assert set(offsets.tolist()) <= set(column_times(CONFIG.lidar).tolist())
    assert len(list(drive_frames(1.0, 4, CONFIG))) == 10


def test_a_drive_without_streets_has_no_frames() -> None:
    with pytest.raises(EgolocError, match=r"^network: expected a \[network\]"):
        drive_frames(10.0, 0, DriveConfig())
    with pytest.raises(EgolocError, match=r"^network: expected a \[network\]"):
        drive_map(10.0, 0, DriveConfig())
