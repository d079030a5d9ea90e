"""NEES, ENCE and the tail against answers by hand, and against what chi-square says of true covariances."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from egovm.honesty import BIN_FRAMES, BINS, TAIL, ence, ence_of_true, honesty, nees

Floats = NDArray[np.float64]


def drawn(count: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Errors (N, 3) and the covariances (N, 3, 3) that they were drawn from, of sizes that differ tenfold."""
    rng = np.random.default_rng(seed)
    root = np.tril(rng.uniform(-1.0, 1.0, (count, 3, 3)), -1) + np.eye(3)
    root *= rng.uniform(0.1, 1.0, (count, 1, 1)) * np.array((0.1, 0.2, 0.01))[:, None]
    return np.einsum("nij,nj->ni", root, rng.normal(size=(count, 3))), root @ root.transpose(0, 2, 1)


def test_nees_is_the_squared_error_by_the_stated_variance() -> None:
    each, total = nees(np.array([[0.2, 0.3, 0.01]]), np.diag((0.1**2, 0.3**2, 0.02**2))[None])
    np.testing.assert_allclose(each, [(4.0, 1.0, 0.25)])
    np.testing.assert_allclose(total, [5.25])


def test_correlations_count() -> None:
    error, cov = drawn(50)
    by_hand = [e @ np.linalg.inv(R) @ e for e, R in zip(error, cov, strict=True)]
    np.testing.assert_allclose(nees(error, cov)[1], by_hand, rtol=1e-6)


def test_an_infinite_covariance_states_nothing_and_one_without_width_everything() -> None:
    cov = np.stack(
        (np.diag(np.full(3, np.inf)), np.zeros((3, 3)), np.ones((3, 3)), np.diag((1.0, 1.0, 0.0)), np.eye(3))
    )
    each, total = nees(np.ones((5, 3)), cov)
    assert np.isnan(total[0])
    assert np.isnan(each[0]).all()
    assert total[1:].tolist() == [math.inf, math.inf, math.inf, pytest.approx(3.0)]
    assert each[3].tolist() == [1.0, 1.0, math.inf]
    found = honesty(np.ones((5, 3)), cov)
    assert found is not None
    assert (found["frames"], found["without_width"]) == (1, 3)
    assert found["mean_by_3"] == pytest.approx(1.0)


def test_no_covariance_at_all_is_no_figure() -> None:
    assert honesty(np.ones((2, 3)), np.full((2, 3, 3), np.inf)) is None


def test_figures_of_true_covariances_are_those_of_chi_square() -> None:
    """Within four standard deviations of their own."""
    count = 4000
    error, cov = drawn(count)
    found = honesty(error, cov)
    assert found is not None
    assert found["frames"] == count
    assert found["mean_by_3"] == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 3.0 / count))
    assert found["median_by_3"] == pytest.approx(chi2.median(3) / 3.0, abs=0.04)
    assert found["beyond_99"] == pytest.approx(0.01, abs=4.0 * math.sqrt(0.01 / count))
    for axis in ("lon", "lat", "yaw"):
        assert found["nees"][axis] == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / count))
        assert found["ence"][axis] == pytest.approx(found["ence_of_true"], rel=1.0)
    assert pytest.approx(chi2.ppf(0.99, 3), abs=1e-3) == TAIL


def test_ence_of_true_sigmas_is_what_is_said() -> None:
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.1, 1.0, (300, 200))
    found = np.mean([ence(row * rng.normal(size=200), row) for row in sigma])
    assert found == pytest.approx(ence_of_true(200), rel=0.05)


def test_ence_tells_sigmas_that_are_right_on_the_average_alone() -> None:
    """Half of the frames state a sigma of 1 and are off by 2, half state 3 and are off by 1: 1 and 2/3 off, by bin."""
    sigma, error = np.repeat((1.0, 3.0), 100), np.repeat((2.0, -1.0), 100)
    assert ence(error, sigma) == pytest.approx((1.0 + 2.0 / 3.0) / 2.0)


def test_few_frames_are_one_bin() -> None:
    assert ence(np.array((0.0, 2.0)), np.array((1.0, 1.0))) == pytest.approx(math.sqrt(2.0) - 1.0)
    assert ence_of_true(BIN_FRAMES * BINS) == ence_of_true(BIN_FRAMES)


def test_nll_is_that_of_a_normal_distribution() -> None:
    found = honesty(np.zeros((1, 3)), np.eye(3)[None])
    assert found is not None
    assert found["nll"] == pytest.approx(1.5 * math.log(2.0 * math.pi))
