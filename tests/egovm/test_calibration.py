"""Calibration: what widened or narrowed the covariances of made-up errors is found, and files are read strictly."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import check_grad

from egovm.calibration import (
    Calibration,
    calibration_path,
    read_calibration,
    stated,
    steps_of,
    uncalibrated,
    write_calibration,
)
from egovm.calibration_fit import _nll, fitted
from egovm.config import LatticeConfig
from egovm.honesty import honesty, nees
from egovm.judging import LevelErrors
from sensors.errors import EgolocError

Floats = NDArray[np.float64]
LATTICE = LatticeConfig()
STEP = steps_of(LATTICE)
A = np.array(((0.3, 2.0, 0.05), (1.0, 1.0, 1.0), (0.1, 9.0, 0.4)))
B = np.array(((0.5, 1.0, 2.0), (1.0, 0.2, 1.0), (0.3, 3.0, 0.6)))
POWER = np.array(((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), (2.0, 1.5, 1.0)))
TRUE = Calibration(A, B, POWER, LATTICE)


def histograms(count: int, seed: int) -> Floats:
    """Covariances (N, L, 3, 3), correlated, of sigmas of a tenth of a step to three steps."""
    rng = np.random.default_rng(seed)
    root = np.tril(rng.uniform(-0.6, 0.6, (count, 3, 3, 3)), -1) + np.eye(3)
    root *= np.exp(rng.uniform(math.log(0.1), math.log(3.0), (count, 3, 1, 1)))
    root *= STEP[:, :, None]
    return root @ root.swapaxes(-1, -2)


def off_by(cov: Floats, true: Floats, seed: int) -> LevelErrors:
    """Errors drawn from the true covariances, beside those that are stated."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(true)
    error = np.einsum("nlij,nlj->nli", root, rng.normal(size=cov.shape[:3]))
    return LevelErrors(error, cov, np.ones(cov.shape[:2], bool), np.zeros(cov.shape[:2]))


@pytest.fixture(scope="module")
def found() -> Calibration:
    cov = histograms(1500, 0)
    return fitted(off_by(cov, TRUE.of_levels(cov), 1), LATTICE, ("uniform",), ("full",), 7)


def test_a_scale_that_is_known_is_found(found: Calibration) -> None:
    """Sigmas within a tenth of the true ones over all widths; what a, b and power have of them, less surely."""
    cov = histograms(500, 13)
    sigma, true = (np.sqrt(np.diagonal(each, axis1=2, axis2=3)) for each in (found.of_levels(cov), TRUE.of_levels(cov)))
    np.testing.assert_allclose(sigma, true, rtol=0.1)
    np.testing.assert_allclose(found.a, A, rtol=0.3)
    np.testing.assert_allclose(found.power, POWER, atol=0.2)
    assert abs(np.log(found.b / B)).max() < 0.7
    assert found.fit is not None
    assert found.fit.used == (1500, 1500, 1500)
    assert (found.fit.frames, found.fit.seed, found.fit.noise, found.fit.maps) == (1500, 7, ("uniform",), ("full",))
    assert all(after < before for before, after in zip(found.fit.nll_before, found.fit.nll_after, strict=True))


def test_others_drawn_alike_are_then_honest(found: Calibration) -> None:
    """NEES of other errors, within four standard deviations of chi-square's mean and median, and what the fit adds."""
    cov = histograms(1000, 2)
    errors = off_by(cov, TRUE.of_levels(cov), 3)
    for level in range(3):
        raw = honesty(errors.error[:, level], cov[:, level])
        told = honesty(errors.error[:, level], found.calibrated(cov[:, level], level))
        assert raw is not None
        assert told is not None
        assert told["mean_by_3"] == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 3.0 / 1000) + 0.02)
        assert told["median_by_3"] == pytest.approx(0.79, abs=4.0 * 0.028 + 0.02)
        assert abs(math.log(told["mean_by_3"])) < abs(math.log(raw["mean_by_3"]))
        assert told["nll"] < raw["nll"]


def test_true_covariances_stay_as_they_are() -> None:
    cov = histograms(1000, 4)
    found = fitted(off_by(cov, cov, 5), LATTICE)
    sigma = np.sqrt(np.diagonal(cov, axis1=2, axis2=3))
    changed = np.sqrt(np.diagonal(found.of_levels(cov), axis1=2, axis2=3)) / sigma
    np.testing.assert_allclose(np.percentile(changed, (1, 50, 99)), 1.0, atol=0.1)


def test_the_gradient_is_that_of_the_likelihood() -> None:
    cov = histograms(20, 6)[:, 0] / np.outer(STEP[0], STEP[0])
    error = np.random.default_rng(7).normal(size=(20, 3))
    at = np.array((-0.3, 0.4, 0.1, -1.0, 0.5, 0.2, 1.2, 1.0, 1.7))
    assert check_grad(lambda x: _nll(x, error, cov)[0], lambda x: _nll(x, error, cov)[1], at) < 1e-5


def test_frames_that_say_nothing_of_a_level_are_left_out(found: Calibration) -> None:
    """A truth beyond the window, or no landmarks: the fit is that of the others."""
    cov = histograms(1500, 0)
    errors = off_by(cov, TRUE.of_levels(cov), 1)
    more, unknown = np.full((5, 3, 3), 99.0), np.broadcast_to(np.diag(np.full(3, np.inf)), (5, 3, 3, 3))
    more_inside = np.array([[True, False, False]] * 5)
    more[:, 0] = 0.0
    spoiled = LevelErrors(
        np.concatenate((errors.error, more, more)),
        np.concatenate((errors.cov, errors.cov[:5], unknown)),
        np.concatenate((errors.inside, more_inside, np.ones((5, 3), bool))),
        np.zeros((1510, 3)),
    )
    again = fitted(spoiled, LATTICE)
    assert again.fit is not None
    assert again.fit.frames == 1510
    assert again.fit.used == (1505, 1500, 1500)
    np.testing.assert_allclose(again.a[1:], found.a[1:], rtol=1e-3)
    np.testing.assert_allclose(again.b[1:], found.b[1:], rtol=1e-2)


def test_too_few_frames_are_told() -> None:
    cov = histograms(25, 8)
    errors = off_by(cov, cov, 9)
    errors.inside[:6, 2] = False
    with pytest.raises(EgolocError, match=r"level 2: expected 20 frames or more .* in its window, got 19"):
        fitted(errors, LATTICE)


def test_histograms_without_width_get_one() -> None:
    """All weight at one candidate, as networks trained for points give: errors of a cell are all that there is."""
    errors = np.random.default_rng(10).uniform(-0.5, 0.5, (500, 3, 3)) * STEP
    found = fitted(LevelErrors(errors, np.zeros((500, 3, 3, 3)), np.ones((500, 3), bool), np.zeros((500, 3))), LATTICE)
    np.testing.assert_allclose(found.b, 1.0, rtol=0.15)
    cov = found.calibrated(np.zeros((3, 3)), 1)
    np.testing.assert_allclose(np.diagonal(cov), found.b[1] * STEP[1] ** 2 / 12.0)
    assert np.isfinite(nees(np.zeros((1, 3)), cov[None])[1]).all()


def test_infinite_covariances_stay_infinite_and_nothing_else_changes() -> None:
    unknown = np.diag(np.full(3, np.inf))
    for calibration in (TRUE, uncalibrated(LATTICE)):
        for level in range(3):
            assert np.array_equal(calibration.calibrated(unknown, level), unknown)


def test_each_level_has_its_own() -> None:
    cov = histograms(4, 11)
    of_levels = TRUE.of_levels(cov)
    for level in range(3):
        assert np.array_equal(of_levels[:, level], TRUE.calibrated(cov[:, level], level))
    sigma, told = (np.sqrt(np.diagonal(each[0, 0])) for each in (cov, of_levels))
    np.testing.assert_allclose(told**2, A[0] * sigma**2 + B[0] * STEP[0] ** 2 / 12.0)
    np.testing.assert_allclose(
        np.diagonal(of_levels[0, 2]), (A * (cov[0, 2].diagonal() / STEP**2) ** POWER + B / 12.0)[2] * STEP[2] ** 2
    )


def test_a_fix_states_the_last_level_and_what_an_earlier_one_left_open() -> None:
    """The first level is flat along its x, which lies along the last one's y: its centre heads 90 deg to the right."""
    cov = np.tile(np.eye(3) * 1e-2 * STEP[:, None] ** 2, (3, 1, 1, 1))
    cov[1, 0, 0, 0] = open_m2 = (STEP[0, 0] ** 2) * (LATTICE.steps**2 - 1) / 12.0
    cov[2] = np.diag(np.full(3, np.inf))
    yaw = np.array(((0.0, 0.0, 0.0), (-np.pi / 2, 0.0, 0.0), (0.0, 0.0, 0.0)))
    found = stated(TRUE, cov, yaw)
    last = TRUE.calibrated(cov[0, 2], 2)
    np.testing.assert_allclose(found[0], last)
    np.testing.assert_allclose(found[1], last + np.diag((0.0, open_m2, 0.0)), atol=1e-12)
    assert np.isinf(np.diagonal(found[2])).all()


def test_without_a_file_covariances_stay_as_they_are(tmp_path: Path) -> None:
    calibration = read_calibration(tmp_path / "a.safetensors", LATTICE)
    assert calibration.fit is None
    cov = histograms(4, 12)
    assert np.array_equal(calibration.of_levels(cov), cov)
    with pytest.raises(EgolocError, match="expected a calibration that was fitted"):
        write_calibration(calibration, tmp_path / "a.safetensors")


def test_a_calibration_comes_back(tmp_path: Path, found: Calibration) -> None:
    weights = tmp_path / "a.safetensors"
    weights.write_bytes(b"weights")
    path = write_calibration(found, weights)
    assert path == calibration_path(weights) == tmp_path / "a-calibration.toml"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a-calibration.toml", "a.safetensors"]
    read = read_calibration(weights, LATTICE)
    for name in ("a", "b", "power"):
        assert np.array_equal(getattr(read, name), getattr(found, name))
    assert read.fit == found.fit


def test_a_calibration_of_other_weights_is_told(tmp_path: Path, found: Calibration) -> None:
    weights = tmp_path / "a.safetensors"
    weights.write_bytes(b"weights")
    write_calibration(found, weights)
    weights.write_bytes(b"trained again")
    with pytest.raises(EgolocError, match=r"weights_sha256: expected that of a\.safetensors.*--calibrate fits anew"):
        read_calibration(weights, LATTICE)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("a = [[", "a = [[-", r"Expected `float` > 0\.0 - at `\$\.a\[0\]\[0\]`"),
        ("b = [[", "b = [[-", r"Expected `float` >= 0\.0 - at `\$\.b\[0\]\[0\]`"),
        ("a = [[", "a = [[inf, ", r"a-calibration\.toml: "),
        ("a = [[", "a = [[nan, 1, 1], [", r"a-calibration\.toml: "),
        ("b = [[", "b = [[1.0, 1.0, 1.0], [", "b: expected 3 rows, the network's levels, got 4"),
        ("power = [[", "power = [[0.5, 1.0, 1.0], [", r"Expected `float` >= 1\.0 - at `\$\.power\[0\]\[0\]`"),
        ("[fit]", "scale = 3\n[fit]", "unknown field `scale`"),
        ("[fit]", "[fits]", r"missing required field `fit`|unknown field `fits`"),
        ("a = [[", "a = ", r"a-calibration\.toml: "),
    ],
)
def test_bad_files_are_told(tmp_path: Path, found: Calibration, old: str, new: str, message: str) -> None:
    weights = tmp_path / "a.safetensors"
    weights.write_bytes(b"weights")
    path = write_calibration(found, weights)
    text = path.read_text()
    path.write_text(text.replace("\n" + old, "\n" + new, 1))
    assert path.read_text() != text
    with pytest.raises(EgolocError, match=message) as told:
        read_calibration(weights, LATTICE)
    assert "\n" not in str(told.value)
    assert "a-calibration.toml" in str(told.value)


def test_a_folder_that_is_not_there_is_told(tmp_path: Path, found: Calibration) -> None:
    with pytest.raises(EgolocError, match=r"a\.safetensors: expected weights of a network"):
        write_calibration(found, tmp_path / "nowhere" / "a.safetensors")
