"""Modes of pose fixes and the covariance of a histogram over levels: what a record may hold, and what is stated."""

import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.histogram import stated_covariance
from sensors.pieces import cut, join
from sensors.records import Log, PoseFix

N = 6
T = np.arange(N, dtype=np.int64) * 100_000_000
POSE = np.arange(3.0 * N).reshape(N, 3) / 10
COV = np.tile(np.diag([0.01, 0.02, 0.0001]), (N, 1, 1))


def fixes() -> PoseFix:
    """Row 2 with two modes, row 4 with one."""
    modes, weights = np.full((N, 2, 3), np.nan), np.zeros((N, 2))
    modes[2], weights[2] = [POSE[2], POSE[2] + [6.0, 0.0, 0.0]], [0.7, 0.2]
    modes[4, 0], weights[4, 0] = POSE[4], 0.9
    return PoseFix(T, T, POSE, COV, modes, weights)


def test_a_fix_without_modes_has_weights_of_zero() -> None:
    plain = PoseFix(T, T, POSE, COV)
    assert plain.weights.tolist() == [[0.0, 0.0]] * N
    assert np.isnan(plain.modes).all()
    assert plain.modes.shape == (N, 2, 3)


def test_modes_follow_rows_and_pieces() -> None:
    whole = fixes()
    assert whole[2:3].weights.tolist() == [[0.7, 0.2]]
    again = join(cut(Log(pose_fixes=whole), 0.2)).pose_fixes
    assert again is not None
    for name in ("t_ns", "pose", "cov", "modes", "weights"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))


@pytest.mark.parametrize("weights", [(0.2, 0.7), (0.9, 0.2), (0.5, -0.1)])
def test_weights_that_are_no_masses_are_refused(weights: tuple[float, float]) -> None:
    given = fixes()
    wrong = given.weights.copy()
    wrong[2] = weights
    with pytest.raises(EgolocError, match=r"PoseFix.weights: expected falling masses .* row 2 has \["):
        PoseFix(T, T, POSE, COV, given.modes, wrong)


def test_a_weight_without_a_mode_is_refused() -> None:
    given = fixes()
    wrong = given.weights.copy()
    wrong[4, 1] = 0.05
    with pytest.raises(EgolocError, match="row 4 has"):
        PoseFix(T, T, POSE, COV, given.modes, wrong)
    with pytest.raises(EgolocError, match=r"PoseFix.modes: expected finite numbers"):
        PoseFix(T, T, POSE, COV, np.where(np.isnan(given.modes), np.inf, given.modes), given.weights)


WINDOWS = np.array([[1.87, 1.87, 0.0326], [0.935, 0.935, 0.0163], [0.468, 0.468, 0.0082]])
SHARP = np.diag([0.05, 0.03, 0.002]) ** 2


def turned(angle: float, cov: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    result: np.ndarray = axes @ cov @ axes.T
    return result


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_a_direction_that_is_flat_at_a_coarser_level_has_that_levels_variance(level: int, angle: float) -> None:
    levels = np.tile(turned(angle, SHARP), (1, 3, 1, 1))
    flat = np.diag([0.95 * WINDOWS[level, 0], 0.1, 0.003]) ** 2
    levels[0, level] = turned(angle, flat)
    stated = turned(-angle, stated_covariance(levels, WINDOWS)[0])
    assert stated[0, 0] == pytest.approx(flat[0, 0] + SHARP[0, 0], rel=1e-9)
    assert stated[1, 1] == pytest.approx(SHARP[1, 1], rel=1e-9)
    assert stated[2, 2] == pytest.approx(SHARP[2, 2], rel=1e-9)


def test_just_below_half_of_a_flat_windows_variance_nothing_is_added() -> None:
    levels = np.tile(SHARP, (2, 3, 1, 1))
    levels[0, 0, 0, 0] = 0.49 * WINDOWS[0, 0] ** 2
    levels[1, 0, 0, 0] = 0.51 * WINDOWS[0, 0] ** 2
    stated = stated_covariance(levels, WINDOWS)
    assert (stated[0] == SHARP).all()
    assert stated[1, 0, 0] == pytest.approx(0.51 * WINDOWS[0, 0] ** 2 + SHARP[0, 0])


def test_directions_flat_at_different_levels_are_both_stated() -> None:
    levels = np.tile(SHARP, (1, 3, 1, 1))
    levels[0, 0, 0, 0], levels[0, 1, 2, 2] = WINDOWS[0, 0] ** 2, WINDOWS[1, 2] ** 2
    stated = stated_covariance(levels, WINDOWS)[0]
    expected = np.array([WINDOWS[0, 0], 0.0, WINDOWS[1, 2]]) ** 2 + np.diag(SHARP)
    np.testing.assert_allclose(np.diag(stated), expected)
