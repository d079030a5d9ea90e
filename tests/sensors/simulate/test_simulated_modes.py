"""The two modes that simulated pose fixes tell: at an alias the second one is the truth, at a twin the alias."""

import msgspec
import numpy as np
import pytest

from sensors.rotation import wrap
from sensors.simulate.environment import Landmarks
from tests.sensors.simulate.test_simulated_matching import PLAIN, Floats, among, fixes

ALL = msgspec.structs.replace(PLAIN, alias_modes_fraction=1.0)
RATES = {"dash": {"dash_alias_per_km": 2.0}, "lane": {"lane_alias_per_km": 2.0}}
DISTANCE = {"dash": (0, 6.0), "lane": (1, 3.5)}


def between(modes: Floats, yaw: Floats) -> Floats:
    """(N, 3) from the stronger mode to the other, along and left of yaw (N,)."""
    d = modes[:, 1] - modes[:, 0]
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack((c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], wrap(d[:, 2])), axis=-1)


@pytest.mark.parametrize("kind", ["dash", "lane"])
def test_an_alias_tells_the_truth_as_its_second_mode(kind: str) -> None:
    axis, distance = DISTANCE[kind]
    fix, error, sigma = fixes(ALL, among(Landmarks(**RATES[kind])))
    off = np.abs(error[:, axis]) > 1.0
    assert off.sum() > 300
    assert (fix.weights.any(axis=1) == off).all()
    assert (fix.modes[off, 0] == fix.pose[off]).all()
    assert np.isnan(fix.modes[~off]).all()
    away = between(fix.modes[off], fix.pose[off, 2] - error[off, 2])
    assert np.abs(away[:, axis]) == pytest.approx(np.full(off.sum(), distance))
    # the second mode is as far from the truth as any good fix
    left = error[off] + away
    assert np.abs(left).max() < 0.5
    assert np.abs(left[:, axis]).std() < 0.2
    assert fix.weights[off].sum(axis=1) == pytest.approx(np.ones(off.sum()))
    both = fix.weights[off].prod(axis=1) * distance**2
    assert sigma[off, axis] ** 2 - both == pytest.approx(np.full(off.sum(), sigma[~off, axis].mean() ** 2), abs=0.01)


def test_the_stated_share_of_aliases_tells_its_modes_and_the_fixes_are_the_same() -> None:
    course = among(Landmarks(dash_alias_per_km=5.0))
    every, error, _ = fixes(ALL, course)
    for share in (0.0, 0.4):
        some, _, _ = fixes(msgspec.structs.replace(PLAIN, alias_modes_fraction=share), course)
        assert (some.pose == every.pose).all()
        assert (some.cov == every.cov).all()
        told, off = some.weights.any(axis=1), np.abs(error[:, 0]) > 1.0
        assert (told & ~off).sum() == 0
        # of some 180 stretches
        assert told.sum() / off.sum() == pytest.approx(share, abs=0.12)


@pytest.mark.parametrize("kind", ["dash", "lane"])
def test_at_a_twin_the_fix_is_right_and_the_alias_its_second_mode(kind: str) -> None:
    axis, distance = DISTANCE[kind]
    fix, error, _ = fixes(PLAIN, among(Landmarks(**{f"{kind}_twin_per_km": 2.0})))
    plain, _, _ = fixes(PLAIN)
    assert (fix.pose == plain.pose).all()
    assert (fix.cov == plain.cov).all()
    told = fix.weights.any(axis=1)
    assert told.mean() == pytest.approx(0.03, rel=0.35)
    away = between(fix.modes[told], fix.pose[told, 2] - error[told, 2])
    assert np.abs(away[:, axis]) == pytest.approx(np.full(told.sum(), distance))
    assert np.abs(np.delete(away, axis, axis=1)).max() < 1e-9
    assert (fix.weights[told, 0] >= 0.5).all()
    assert np.abs(error[told, axis]).max() < 0.5


def test_the_covariance_of_the_stronger_mode_alone_says_nothing_of_the_other() -> None:
    course = among(Landmarks(lane_alias_per_km=2.0))
    fix, error, sigma = fixes(msgspec.structs.replace(ALL, alias_covariance="one"), course)
    both, _, _ = fixes(ALL, course)
    assert (fix.pose == both.pose).all()
    assert (fix.modes[fix.weights.any(axis=1)] == both.modes[both.weights.any(axis=1)]).all()
    assert np.abs(error[:, 1]).max() > 3.0
    np.testing.assert_allclose(sigma[:, 1], 0.03)
