"""Batches: whoever knows the truth finds the offset; noise, turns and batches are as said and of their seed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from egovm.batch import SURFEL, TYPES, Truth
from egovm.config import PRESETS, Ablation
from egovm.dataset import (
    NOISES,
    Augmentation,
    EvaluationBatches,
    InitialNoise,
    TrainingBatches,
    batched,
    planar,
    seen_from_off,
    thinned,
    turned,
)
from egovm.evaluate import InTurns
from egovm.judging import judged
from egovm.lattice import seen_from
from egovm.losses import LossConfig, network_losses
from egovm.made_samples import made_sample
from egovm.map_contents import CONTENTS, MapContent
from egovm.map_elements import Pieces, places_of
from egovm.pose_solver import PoseSolver
from egovm.sample import Sample
from sensors.maps.vector_map import NO_SURFELS, Kind
from tests.egovm.made_map import made
from tests.egovm.made_training import NETWORK, RECIPE, STILL, made_cache

__all__ = ["made_cache"]

OFFSETS = [(1.7, -0.9, 0.03), (-2.2, 2.1, -0.04), (0.4, 0.3, 0.0)]


def crossroads(yaw: float = 0.6) -> Sample:
    """Poles and lines in all directions around a vehicle far from the map's origin; no points."""
    T = planar(np.array((5000.0, 8000.0, yaw)))
    rng = np.random.default_rng(3)
    poles = [(Kind.POLE, [(x, y, 0.0), (x, y, 4.0)]) for x, y in rng.uniform(-12.0, 12.0, (30, 2))]
    lines = [(Kind.LANE_LINE, [(-12.0, y), (12.0, y)]) for y in (-4.0, 3.0)]
    across = [(Kind.STOP_LINE, [(x, -9.0), (x, 9.0)]) for x in (-6.0, 5.0)]
    elements = made(*poles, *lines, *across)
    xyz = elements.xyz @ T[:3, :3].T + T[:3, 3]
    placed = type(elements)(
        elements.kind, elements.style, elements.colour, elements.first, xyz, elements.source, elements.name
    )
    nothing = np.zeros(0, np.float32)
    return Sample(np.zeros((0, 3), np.float32), nothing, nothing, T, 0.0, placed, NO_SURFELS)


@pytest.mark.parametrize("offset", OFFSETS)
def test_with_the_true_map_as_bev_the_solver_finds_the_offset(offset: tuple[float, float, float]) -> None:
    """Sign and direction of the offset are the same in the dataset, the rasters, the solver, the losses, the figures:
    every element is drawn into the BEV at the true pose, and its embedding is its type."""
    seen = seen_from_off(crossroads(), np.array(offset), NETWORK, semantic=True)
    batch, truth = batched([seen], NETWORK)
    solver = PoseSolver(NETWORK.solver.lattice)
    with torch.no_grad():
        solver.tau += 4.0
    maps = [level.float().to(memory_format=torch.channels_last) for level in truth.semantic]
    embedding = torch.eye(TYPES)[:, : TYPES - 1][batch.elements.type]
    places = places_of(batch.elements, NETWORK.matching)
    estimate = solver(maps, [embedding] * 3, places, batch.elements.valid)
    found = judged(estimate, truth.offset)
    assert estimate.found.all()
    np.testing.assert_allclose(truth.offset[0].numpy(), offset, atol=1e-6)
    np.testing.assert_allclose(found.error[0, :2].numpy(), 0.0, atol=0.05)
    assert abs(float(found.error[0, 2])) < np.radians(0.25)

    def loss(at: torch.Tensor) -> float:
        random = torch.Generator().manual_seed(0)
        only = Ablation(semantic_supervision=False)
        return network_losses(LossConfig(), only, Truth(at, ()), estimate, solver, (), random).total.item()

    assert loss(truth.offset) < loss(-truth.offset)


@pytest.mark.parametrize("offset", OFFSETS[:2])
def test_the_map_seen_from_the_true_pose_meets_the_points(offset: tuple[float, float, float]) -> None:
    """Surfels of walls, brought from the initial pose by the offset, lie on the sweep's points."""
    sample = turned(made_sample(RECIPE, "train", 2), 0.3)
    seen = seen_from_off(sample, np.array(offset), PRESETS["small-lidar"], semantic=False)
    wall = (seen.pieces.type == SURFEL) & (np.abs(seen.pieces.ends[:, 0, :2]).max(axis=1) < 14.0)
    places = torch.from_numpy(seen.pieces.ends[wall, 0, :2].astype(np.float64))
    high = sample.xyz[sample.xyz[:, 2] > 0.5, :2]

    def apart(moved: torch.Tensor) -> float:
        return float(np.median([np.hypot(*(high - place).T).min() for place in moved.numpy()]))

    assert wall.sum() >= 4
    assert apart(seen_from(torch.tensor(offset, dtype=torch.float64), places)) < 0.15
    assert apart(places) > 0.3


def test_initial_and_true_pose_are_an_offset_apart() -> None:
    seen = seen_from_off(crossroads(), np.array(OFFSETS[0]), NETWORK, semantic=False)
    relative = np.linalg.inv(seen.T_map_init) @ seen.sample.T_map_body
    np.testing.assert_allclose(relative, planar(np.array(OFFSETS[0])), atol=1e-8)


def test_turning_body_axes_moves_nothing_in_the_map() -> None:
    sample = made_sample(RECIPE, "train", 2)
    other = turned(sample, 0.7)
    a, b = (x.xyz @ x.T_map_body[:3, :3].T + x.T_map_body[:3, 3] for x in (sample, other))
    np.testing.assert_allclose(a, b, atol=1e-4)
    assert not np.allclose(sample.xyz, other.xyz, atol=0.1)


@pytest.mark.parametrize("name", list(NOISES))
def test_noise_is_as_wide_as_said(name: str) -> None:
    rng = np.random.default_rng(0)
    noise = NOISES[name]
    drawn = np.array([noise.draw(rng) for _ in range(4000)]) * (1.0, 1.0, 180.0 / np.pi)
    size = np.array((noise.lon_m, noise.lat_m, noise.yaw_deg))
    if noise.shape == "uniform":
        assert (np.abs(drawn) <= size).all()
        np.testing.assert_allclose(np.abs(drawn).mean(axis=0), size / 2.0, rtol=0.05)
    else:
        assert (np.abs(drawn) <= (noise.limit_m, noise.limit_m, noise.limit_deg)).all()
        # two sigmas are left of the longitudinal one: 0.88 of its sigma
        np.testing.assert_allclose(drawn.std(axis=0), size * (0.88, 1.0, 0.99), rtol=0.05)
    np.testing.assert_allclose(drawn.mean(axis=0), 0.0, atol=0.1)


def training(cache: Path, seed: int = 0) -> TrainingBatches:
    return TrainingBatches(RECIPE, NETWORK, InitialNoise(), Augmentation(turn_deg=5.0), 2, seed, cache)


def test_batches_are_of_the_seed_and_the_step(made_cache: Path) -> None:
    (a, true_a), (b, true_b) = training(made_cache)[3], training(made_cache)[3]
    assert a.points is not None
    assert b.points is not None
    assert torch.equal(a.points.xyz, b.points.xyz)
    assert torch.equal(a.elements.ends, b.elements.ends)
    assert torch.equal(true_a.offset, true_b.offset)
    assert not torch.equal(true_a.offset, training(made_cache)[4][1].offset)
    assert not torch.equal(true_a.offset, training(made_cache, seed=1)[3][1].offset)


def test_every_sample_comes_once_an_epoch(made_cache: Path) -> None:
    """Two steps of two are an epoch of four: each has other points, which come again in the next one, turned."""
    sizes = [sorted(_sizes(training(made_cache), steps)) for steps in ((0, 1), (2, 3))]
    assert sizes[0] == sizes[1]
    assert len(set(sizes[0])) == RECIPE.samples


def test_some_maps_lack_surfels_or_a_kind_but_never_all() -> None:
    types = np.repeat(np.arange(TYPES), 2)
    rows = len(types)
    zeros = np.zeros((rows, 2, 3), np.float32), np.zeros(rows, np.float32), np.zeros((rows, 3), np.float32)
    pieces = Pieces(types, *zeros, np.zeros((rows, 2), np.float32))
    rng = np.random.default_rng(2)
    found = [set(thinned(pieces, Augmentation(drop_surfels=0.5, drop_kinds=0.2), rng).type) for _ in range(400)]
    share = [np.mean([kind not in one for one in found]) for kind in range(TYPES)]
    assert share[SURFEL] == pytest.approx(0.5, abs=0.1)
    assert share[:SURFEL] == pytest.approx([0.2] * SURFEL, abs=0.08)
    assert len(thinned(pieces, Augmentation(drop_surfels=1.0, drop_kinds=1.0), rng)) == rows
    assert len(thinned(pieces, STILL, rng)) == rows


def _sizes(batches: TrainingBatches, steps: tuple[int, ...]) -> list[int]:
    """Numbers of points of all frames."""
    found = []
    for step in steps:
        points = batches[step][0].points
        assert points is not None
        found += torch.bincount(points.frame, minlength=2).tolist()
    return found


def test_frames_of_evaluation_are_neither_turned_nor_those_of_training(made_cache: Path) -> None:
    batches = EvaluationBatches(RECIPE, NETWORK, NOISES["gauss"], 3, cache=made_cache)
    batch, truth = batches[1]
    assert len(batches) == 3
    assert truth.semantic == ()
    assert batch.points is not None
    expected = made_sample(RECIPE, "held-out", 1).xyz
    np.testing.assert_allclose(batch.points.xyz.numpy(), expected, atol=0.0011)
    with pytest.raises(IndexError):
        batches[3]


@pytest.mark.parametrize("content", CONTENTS)
def test_a_poorer_map_leaves_the_initial_pose_and_the_points(content: MapContent, made_cache: Path) -> None:
    full = EvaluationBatches(RECIPE, NETWORK, NOISES["gauss"], 3, cache=made_cache)
    batch, truth = replace(full, content=content)[1]
    again, _ = replace(full, content=content)[1]
    expected, offset = full[1]
    assert torch.equal(truth.offset, offset.offset)
    assert batch.points is not None
    assert expected.points is not None
    assert torch.equal(batch.points.xyz, expected.points.xyz)
    assert torch.equal(batch.elements.ends, again.elements.ends)
    fewer = int(batch.elements.valid.sum()) < int(expected.elements.valid.sum())
    assert fewer == (content != "full")


def test_calibrations_take_turns_in_every_world(made_cache: Path) -> None:
    """Noise and map change from frame to frame, and each pair of them meets every world."""
    base = EvaluationBatches(RECIPE, NETWORK, NOISES["uniform"], 30, "calibration", cache=made_cache)
    several = tuple(replace(base, noise=InitialNoise(lon_m=lon, lat_m=0.0, yaw_deg=0.0)) for lon in (0.5, 1.0, 2.0))
    turns = InTurns(several)
    assert len(turns) == 30

    met = {(number % RECIPE.worlds, turns.turn(number)) for number in range(30)}
    assert met == {(world, turn) for world in range(RECIPE.worlds) for turn in range(3)}
    for number in (0, 1, 2):
        assert torch.equal(turns[number][1].offset, several[turns.turn(number)][number][1].offset)
