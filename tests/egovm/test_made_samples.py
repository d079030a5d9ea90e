"""Made samples: of their seed, true to the map, and never the same places in training and evaluation."""

from itertools import combinations, pairwise
from pathlib import Path
from typing import get_args

import msgspec
import numpy as np
import pytest

from egovm.made_samples import FIRST_SEED, Motion, Recipe, Split, made_sample, recipe_name, sample_of
from egovm.sample import Sample
from sensors.maps.vector_map import Kind
from tests.egovm.made_training import RECIPE

COLUMNS = ("xyz", "intensity", "offset_s", "T_map_body")


@pytest.fixture(scope="module")
def sample() -> Sample:
    return made_sample(RECIPE, "train", 2)


def same(a: Sample, b: Sample) -> bool:
    """Equal in points, pose and map."""
    columns = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in COLUMNS)
    return columns and np.array_equal(a.elements.xyz, b.elements.xyz) and np.array_equal(a.surfels.p, b.surfels.p)


def test_a_sample_depends_on_its_recipe_split_and_number_alone(sample: Sample) -> None:
    made_sample(RECIPE, "train", 1)
    assert same(sample, made_sample(RECIPE, "train", 2))
    assert not same(sample, made_sample(RECIPE, "train", 4))
    assert not np.allclose(sample.T_map_body, made_sample(RECIPE, "held-out", 2).T_map_body)


def test_worlds_of_the_splits_never_meet() -> None:
    """Seeds of as many worlds as a recipe may have."""
    most = msgspec.inspect.type_info(Recipe).fields[1].type.le  # type: ignore[attr-defined]
    assert most == 100_000
    assert set(FIRST_SEED) == set(get_args(Split)) == {"train", "held-out", "calibration"}
    first = sorted(FIRST_SEED.values())
    assert all(b - a >= most for a, b in pairwise(first))
    places = [made_sample(RECIPE, split, 2).T_map_body[:2, 3] for split in get_args(Split)]
    assert min(np.linalg.norm(a - b) for a, b in combinations(places, 2)) > 1.0


def test_points_stand_where_the_map_says(sample: Sample) -> None:
    """Poles nearby have points within a hand's breadth of their axis, above the ground."""
    elements, T = sample.elements, sample.T_map_body
    feet = elements.xyz[elements.first[:-1][elements.kind == Kind.POLE]]
    in_body = (feet - T[:3, 3]) @ T[:3, :3]
    near = in_body[np.hypot(*in_body[:, :2].T) < 15.0]
    high = sample.xyz[(sample.xyz[:, 2] > sample.ground_m + 0.5) & (sample.xyz[:, 2] < 1.5)]
    assert len(near) >= 1
    apart = np.linalg.norm(high[:, None, :2] - near[None, :, :2], axis=2)
    assert np.median((apart < 0.2).sum(axis=0)) >= 3


def test_the_ground_lies_where_it_is_said(sample: Sample) -> None:
    close = np.hypot(*sample.xyz[:, :2].T) < 5.0
    assert np.median(sample.xyz[close, 2]) == pytest.approx(sample.ground_m, abs=0.05)


def test_surfels_lie_on_walls(sample: Sample) -> None:
    """Upright ones, near points of the sweep where that saw the wall."""
    assert len(sample.surfels) > 20
    assert np.abs(sample.surfels.normal[:, 2]).max() < 0.1
    T = sample.T_map_body
    p = np.column_stack((sample.surfels.p, sample.surfels.z))
    in_body = (p - T[:3, 3]) @ T[:3, :3]
    near = np.abs(in_body[:, :2]).max(axis=1) < RECIPE.reach_m - 1.0
    apart = [np.linalg.norm(sample.xyz - place, axis=1).min() for place in in_body[near]]
    assert len(apart) > 5
    assert np.median(apart) < 0.3


def test_motion_is_made_up_for() -> None:
    """A vehicle that stands and one that drives fast see the same walls in the same places."""
    fast = msgspec.structs.replace(RECIPE, speed_max=50.0, turn_max_deg=90.0)
    still = msgspec.structs.replace(RECIPE, speed_max=0.0, turn_max_deg=0.0)
    a, b = made_sample(fast, "train", 2), made_sample(still, "train", 2)
    assert np.array_equal(a.T_map_body, b.T_map_body)
    high = [x.xyz[(x.xyz[:, 2] > 1.0) & (np.abs(x.xyz[:, :2]).max(axis=1) < 15.0)][::7] for x in (a, b)]
    apart = np.array([np.linalg.norm(high[1] - place, axis=1).min() for place in high[0][:300]])
    assert np.median(apart) < 0.25


def test_a_turn_ends_where_its_rates_lead() -> None:
    p, R = Motion(np.eye(4), 10.0, np.pi).at(np.array([0.0, 0.5]))
    np.testing.assert_allclose(p[1], (10.0 / np.pi, 10.0 / np.pi, 0.0), atol=1e-9)
    np.testing.assert_allclose(R[1] @ (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), atol=1e-9)


def test_kept_samples_are_read_again(tmp_path: Path, sample: Sample) -> None:
    first = sample_of(RECIPE, "train", 2, tmp_path)
    kept = list((tmp_path / recipe_name(RECIPE) / "train").iterdir())
    assert [path.name for path in kept] == ["000002.npz"]
    assert same(first, sample_of(RECIPE, "train", 2, tmp_path))
    np.testing.assert_allclose(first.xyz, sample.xyz, atol=0.0011)
    np.testing.assert_allclose(first.intensity, sample.intensity, atol=0.002)
    np.testing.assert_allclose(first.offset_s, sample.offset_s, atol=5.1e-5)
    assert np.array_equal(first.elements.xyz, sample.elements.xyz)


def test_another_recipe_is_kept_elsewhere() -> None:
    assert recipe_name(RECIPE) == recipe_name(msgspec.structs.replace(RECIPE, samples=9))
    assert recipe_name(RECIPE) != recipe_name(msgspec.structs.replace(RECIPE, worlds=3))
