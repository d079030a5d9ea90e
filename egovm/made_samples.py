"""Samples from made-up worlds: a vehicle on a street, one turn of its LiDAR, and what a map knows of the place.

Worlds of training, of calibration and of evaluation have streets of different seeds, and never meet. A sample depends
on its recipe, split and number alone.
"""

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from egovm.sample import FULL_INTENSITY, Sample, load_sample, save_sample
from sensors.geodesy import utm_frame
from sensors.simulate.environment import Environment
from sensors.simulate.lidar import column_times, sweep
from sensors.simulate.lidar_config import LidarSimulation
from sensors.simulate.network import NetworkPlan, build_network
from sensors.simulate.scene import Scene
from sensors.simulate.street_lines import streets
from sensors.simulate.walls import wall_surfels
from sensors.simulate.world import BODY_M, World

Floats = NDArray[np.float64]
Rng = np.random.Generator
Split = Literal["train", "held-out", "calibration"]

START_LLH = (0.6945, 2.0333, 40.0)
"""Where all made-up worlds lie, rad, rad, m."""
FIRST_SEED: dict[Split, int] = {"train": 0, "held-out": 1_000_000, "calibration": 2_000_000}
"""Seed of the streets of a split's first world."""
FORMAT = 1
"""Rises whenever the same recipe would give other samples."""
_AXLE_M, _TRACK_M = 2.8, 1.6
"""Over which the ground tilts the vehicle, m."""


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which samples there are."""

    samples: Annotated[int, msgspec.Meta(ge=1)] = 2000
    """Of training; they come again each epoch, from other initial poses."""
    worlds: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 16
    """Made-up cities of training, and as many of each other split."""
    road_km: Annotated[float, msgspec.Meta(ge=20.0, le=1000.0)] = 20.0
    """Streets of each, km."""
    reach_m: Annotated[float, msgspec.Meta(ge=10.0, le=64.0)] = 44.0
    """Half of the square around the vehicle within which points are kept, m; half of the BEV's and a bit more."""
    map_m: Annotated[float, msgspec.Meta(ge=10.0, le=200.0)] = 64.0
    """Half of the square within which the map is kept, m: the BEV's, turned, and the error of the initial pose."""
    aside_m: Annotated[float, msgspec.Meta(ge=0.0, le=3.5)] = 3.0
    """The vehicle drives at most so far from the middle of the street, m."""
    across: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.15
    """Share of the vehicles that stand at any angle to the street, as in turns."""
    heading_sigma_deg: Annotated[float, msgspec.Meta(ge=0.0, le=45.0)] = 3.0
    """Of the others, to the street, deg."""
    tilt_sigma_deg: Annotated[float, msgspec.Meta(ge=0.0, le=10.0)] = 0.4
    """Of roll and pitch to the ground, deg."""
    speed_max: Annotated[float, msgspec.Meta(ge=0.0, le=50.0)] = 15.0
    """m/s."""
    turn_max_deg: Annotated[float, msgspec.Meta(ge=0.0, le=90.0)] = 20.0
    """Yaw rate, deg/s."""
    surveyed: bool = True
    """The map has a survey's noise, 1 cm."""
    lidar: LidarSimulation = LidarSimulation(range_max_m=70.0)


@dataclass(frozen=True, slots=True)
class Motion:
    """T_map_body: (4, 4) at the frame's time; speed: m/s ahead; yaw_rate: rad/s; both last for a turn."""

    T_map_body: Floats
    speed: float
    yaw_rate: float

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        """p_map (N, 3) m and R_map_body (N, 3, 3) at t (N,) s."""
        turned = self.yaw_rate * t
        rate = self.yaw_rate if abs(self.yaw_rate) > 1e-6 else 1e-6
        zero = np.zeros_like(t)
        arc = self.speed / rate * np.stack((np.sin(rate * t), 1.0 - np.cos(rate * t), zero), axis=-1)
        R = self.T_map_body[:3, :3]
        return self.T_map_body[:3, 3] + arc @ R.T, R @ _about_z(turned)


def sample_of(recipe: Recipe, split: Split, number: int, cache: Path | None = None) -> Sample:
    """A sample; from the folder where it has been kept before, and kept there else."""
    if cache is None:
        return made_sample(recipe, split, number)
    path = cache / recipe_name(recipe) / split / f"{number:06d}.npz"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        save_sample(made_sample(recipe, split, number), path)
    return load_sample(path)


def recipe_name(recipe: Recipe) -> str:
    """Of all that samples depend on; how many there are is not of it."""
    told = msgspec.json.encode((FORMAT, msgspec.structs.replace(recipe, samples=1)))
    return hashlib.sha256(told).hexdigest()[:12]


def made_sample(recipe: Recipe, split: Split, number: int) -> Sample:
    """Simulate a sample."""
    seed = FIRST_SEED[split] + number % recipe.worlds
    world = _world(seed, recipe.road_km)
    rng = np.random.default_rng([seed, *b"sample", number])
    motion = _motion(recipe, world, rng)
    xy = motion.T_map_body[:2, 3]
    scene = world.scene(xy, max(recipe.lidar.range_max_m, recipe.map_m) + 20.0)
    xyz, intensity, offset_s = _compensated(recipe, motion, scene, rng)
    near = (np.abs(xyz[:, :2]) < recipe.reach_m).all(axis=1)
    low, high = xy - recipe.map_m, xy + recipe.map_m
    vector_map = world.vector_map(world.near(low, high), surveyed=recipe.surveyed)
    surfels = wall_surfels(world, scene, xy, recipe.map_m, rng)
    elements = vector_map.elements
    first, last = elements.first[:-1], elements.first[1:]
    inside = np.concatenate(([0], np.cumsum(((elements.xyz[:, :2] > low) & (elements.xyz[:, :2] < high)).all(axis=1))))
    kept = elements.chosen(inside[last] > inside[first])
    return Sample(xyz[near], intensity[near], offset_s[near], motion.T_map_body, -BODY_M, kept, surfels)


@lru_cache(maxsize=64)
def _world(seed: int, road_km: float) -> World:
    network = build_network(NetworkPlan(length_km=road_km), {"city": Environment()}, seed)
    return World(network, START_LLH, utm_frame(np.array(START_LLH)), seed)


def _motion(recipe: Recipe, world: World, rng: Rng) -> Motion:
    """Somewhere on a street, either way along it, tilted as the ground is and a little more."""
    lengths = world.network.graph.lengths()
    edge = int(rng.choice(len(lengths), p=lengths / lengths.sum()))
    there = streets([world.middle(edge).xy], world.height)
    s = rng.uniform(0.0, there.line[-1], 1)
    foot = there.points(s, rng.uniform(-recipe.aside_m, recipe.aside_m))[0]
    cos, sin = there.course(s)
    ahead = rng.uniform(-np.pi, np.pi) if rng.random() < recipe.across else rng.choice((0.0, np.pi))
    yaw = np.arctan2(sin[0], cos[0]) + ahead + np.radians(recipe.heading_sigma_deg) * rng.standard_normal()
    T = np.eye(4)
    T[:3, :3] = _upright(world, foot[:2], yaw) @ _tilt(np.radians(recipe.tilt_sigma_deg) * rng.standard_normal(2))
    T[:3, 3] = foot + BODY_M * T[:3, 2]
    speed = rng.uniform(0.0, recipe.speed_max)
    return Motion(T, speed, np.radians(rng.uniform(-recipe.turn_max_deg, recipe.turn_max_deg)))


def _upright(world: World, xy: Floats, yaw: float) -> Floats:
    """R_map_body of a vehicle on the ground with a yaw."""
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    half, wide = _AXLE_M / 2.0, _TRACK_M / 2.0
    front, back, port, right = world.height(xy + np.stack((half * ahead, -half * ahead, wide * left, -wide * left)))
    x = np.append(ahead, (front - back) / _AXLE_M)
    y = np.append(left, (port - right) / _TRACK_M)
    z = np.cross(x, y)
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    R: Floats = np.stack((x, np.cross(z, x), z), axis=-1)
    return R


def _tilt(angles: Floats) -> Floats:
    """(3, 3) of a roll and a pitch (2,), rad."""
    (cr, cp), (sr, sp) = np.cos(angles), np.sin(angles)
    pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    R: Floats = pitch @ roll
    return R


def _about_z(angle: Floats) -> Floats:
    """(N, 3, 3)."""
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rows = np.stack((c, -s, zero, s, c, zero, zero, zero, zero + 1.0), axis=-1)
    R: Floats = rows.reshape(*angle.shape, 3, 3)
    return R


def _compensated(
    recipe: Recipe, motion: Motion, scene: Scene, rng: Rng
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Points of one turn in body axes at its begin, brought there by the true motion; intensities and times."""
    columns_s = np.asarray(column_times(recipe.lidar) * 1e-9, np.float64)
    p, R = motion.at(columns_s)
    turn = sweep(scene, p, R, recipe.lidar, rng)
    offset_s = turn.offset_ns * 1e-9
    column = np.searchsorted(columns_s, offset_s - 0.5 * columns_s[1])
    in_map = np.einsum("nij,nj->ni", R[column], turn.in_body()) + p[column]
    xyz = (in_map - motion.T_map_body[:3, 3]) @ motion.T_map_body[:3, :3]
    return xyz.astype(np.float32), turn.intensity / np.float32(FULL_INTENSITY), offset_s.astype(np.float32)
