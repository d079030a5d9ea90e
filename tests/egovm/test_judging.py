"""Errors against answers by hand: axes of the true heading, of the levels' centres, yaw, and figures of them all."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch
from torch import Tensor

from egovm.calibration import Fit, uncalibrated
from egovm.config import ABLATIONS, LatticeConfig
from egovm.dataset import NOISES, EvaluationBatches
from egovm.evaluate import Errors, calibrate, summary
from egovm.honesty import nees
from egovm.judging import LevelErrors, judged, level_errors
from egovm.lattice import between, compose
from egovm.network import EgoVM
from egovm.pose_solver import PoseEstimate, PoseSolver
from egovm.regression_solver import RegressedPose
from sensors.errors import EgolocError
from tests.egovm.made_training import NETWORK, RECIPE

LATTICE = LatticeConfig(half_m=1.0, half_deg=2.0, steps=5, levels=1)


def estimate(offset: Tensor, cov: Tensor, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PoseEstimate:
    """An estimate of one level, whose centre lies at an offset from the initial pose."""
    count = len(offset)
    solver = PoseSolver(LATTICE)
    maps, embeddings = torch.zeros(count, 1, 24, 24), torch.zeros(count, 1, 1)
    made = solver([maps], [embeddings], torch.zeros(count, 1, 2), torch.ones(count, 1, dtype=torch.bool))
    at = torch.tensor([centre]).repeat(count, 1)
    level = replace(made.levels[0], cov=cov, centre=at, mean=between(at, offset))
    return replace(made, offset=offset, levels=(level,))


def test_errors_are_along_and_left_of_the_true_heading() -> None:
    """The vehicle heads 90 deg to the left of the initial pose: what is ahead of that is to its right."""
    truth = torch.tensor([[1.0, 2.0, math.pi / 2]])
    found = judged(RegressedPose(torch.tensor([[1.3, 2.1, math.pi / 2 + 0.01]]), torch.tensor([True])), truth)
    np.testing.assert_allclose(found.error[0].numpy(), (0.1, -0.3, 0.01), atol=1e-6)
    assert found.found.tolist() == [True]


def test_levels_err_along_the_axes_of_their_centre() -> None:
    """The centre heads 90 deg to the left of the initial pose: a truth that lies further along x there is to its right
    (y below 0), where the covariance of its y is."""
    cov = torch.diag(torch.tensor((0.1**2, 0.3**2, 0.02**2)))[None]
    offset, truth = torch.tensor([[1.0, 2.0, math.pi / 2]]), torch.tensor([[1.6, 2.1, math.pi / 2 + 0.01]])
    found = level_errors(estimate(offset, cov, (1.0, 1.9, math.pi / 2)), truth, LATTICE)
    np.testing.assert_allclose(found.error[0, 0], (0.1, -0.6, 0.01), atol=1e-6)
    np.testing.assert_allclose(found.cov[0, 0], cov[0])
    np.testing.assert_allclose(nees(found.error[:, 0], found.cov[:, 0])[0][0], (1.0, 4.0, 0.25), rtol=1e-4)


def test_the_error_is_of_the_estimate_composed_up_to_the_level() -> None:
    """As it is of the offset itself, in the truth's axes: as far away, and NEES is the same along any axes."""
    generator = torch.Generator().manual_seed(0)
    solver = PoseSolver(LatticeConfig())
    maps = [torch.rand(4, 2, side, side, generator=generator) for side in (40, 80, 160)]
    embeddings = [torch.rand(4, 3, 2, generator=generator) for _ in range(3)]
    places = 4.0 * torch.rand(4, 3, 2, generator=generator) - 2.0
    with torch.no_grad():
        made = solver(maps, embeddings, places, torch.ones(4, 3, dtype=torch.bool))
    truth = 0.1 * torch.rand(4, 3, generator=generator)
    found, whole = level_errors(made, truth, LatticeConfig()), judged(made, truth)
    assert found.error.shape == (4, 3, 3)
    distance = np.hypot(*whole.error[:, :2].numpy().T)
    np.testing.assert_allclose(np.hypot(*found.error[:, -1, :2].T), distance, atol=1e-6)
    np.testing.assert_allclose(found.error[:, -1, 2], -whole.error[:, 2].numpy(), atol=1e-6)
    composed = compose(made.levels[0].centre, made.levels[0].mean)
    np.testing.assert_allclose(found.error[:, 0], (truth - composed).numpy(), atol=1e-6)


def test_truths_beyond_the_candidates_are_told() -> None:
    """The window is 1 m and 2 deg either way of its centre."""
    truth = torch.tensor([[0.99, 0.0, 0.0], [1.01, 0.0, 0.0], [0.0, 0.0, 0.034], [0.0, 0.0, 0.036], [-0.6, 0.0, 0.0]])
    made = estimate(torch.zeros(5, 3), torch.eye(3).repeat(5, 1, 1))
    assert level_errors(made, truth, LATTICE).inside[:, 0].tolist() == [True, False, True, False, True]
    made = estimate(torch.zeros(5, 3), torch.eye(3).repeat(5, 1, 1), (0.5, 0.0, 0.0))
    assert level_errors(made, truth, LATTICE).inside[:, 0].tolist() == [True, True, True, False, False]


CALIBRATED = replace(
    uncalibrated(LATTICE),
    a=np.full((1, 3), 2.0),
    fit=Fit(frames=9, noise=(), maps=(), seed=0, used=(9,), nll_before=(0.0,), nll_after=(0.0,)),
)


def errors(count: int = 4, **columns: object) -> Errors:
    """Of four frames, beside covariances of 1 along each axis."""
    given = {
        "initial": np.ones((count, 3)),
        "estimate": np.array([[0.05, -0.15, 0.0], [0.15, 0.05, 0.2], [-0.25, 0.05, 0.4], [0.35, 0.05, 0.8]]),
        "levels": off([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [2.0, 1.0, 1.0], [2.0, 2.0, 4.0]]),
        "found": np.ones(count, bool),
        "seconds": np.full(count, 0.04),
    }
    return Errors(**(given | columns))  # type: ignore[arg-type]


def off(error: list[list[float]]) -> LevelErrors:
    """One level, off by errors of N frames, beside covariances of 1 along each axis."""
    count = len(error)
    inside = np.arange(count)[:, None] != 3
    return LevelErrors(
        np.array(error).reshape(count, 1, 3), np.tile(np.eye(3), (count, 1, 1, 1)), inside, np.zeros((count, 1))
    )


def test_figures_are_those_of_the_errors() -> None:
    report = summary(errors(), CALIBRATED)
    lon = report["methods"]["egovm"]["lon"]
    assert lon["mae"] == pytest.approx(0.2)
    assert lon["rmse"] == pytest.approx(math.sqrt(0.21 / 4.0))
    assert lon["bias"] == pytest.approx(0.075)
    assert lon["max"] == pytest.approx(0.35)
    assert lon["below"] == {"0.1": 0.25, "0.2": 0.5, "0.3": 0.75}
    assert report["methods"]["egovm"]["yaw"]["below"] == {"0.1": 0.25, "0.3": 0.5, "0.6": 0.75}
    assert report["methods"]["initial"]["lat"]["mae"] == 1.0
    assert report["network_ms"]["p50"] == pytest.approx(40.0)
    (level,) = report["covariance"]
    assert (level["step_m"], level["step_deg"]) == (0.5, pytest.approx(1.0))
    assert level["truth_outside"] == 1
    for kind, factor in (("raw", 1.0), ("calibrated", 2.0)):
        assert level[kind]["mean_by_3"] == pytest.approx(36.0 / 12.0 / factor)
        assert level[kind]["median_by_3"] == pytest.approx(1.5 / factor)
        assert level[kind]["nees"]["yaw"] == pytest.approx(19.0 / 4.0 / factor)
        assert level[kind]["beyond_99"] == 0.25
    assert report["stated"] == level["calibrated"]


def test_frames_without_landmarks_are_counted_and_state_nothing() -> None:
    levels = off([[1.0, 1.0, 1.0]] * 3 + [[9.0, 9.0, 9.0]])
    levels.cov[3] = np.diag(np.full(3, np.inf))
    report = summary(errors(found=np.array([True, True, True, False]), levels=levels), CALIBRATED)
    assert report["without_landmarks"] == 1
    (level,) = report["covariance"]
    assert [level[kind]["frames"] for kind in ("raw", "calibrated")] == [3, 3]
    assert level["raw"]["mean_by_3"] == pytest.approx(1.0)


def test_without_a_calibration_raw_figures_are_all() -> None:
    (level,) = summary(errors(), uncalibrated(LATTICE))["covariance"]
    assert level["calibrated"] is None
    assert level["raw"]["frames"] == 4


def test_no_covariance_at_all_is_no_figure() -> None:
    assert summary(errors(levels=None), CALIBRATED)["covariance"] is None


def test_nothing_to_judge_is_told() -> None:
    with pytest.raises(EgolocError, match="expected one frame or more, got none"):
        summary(errors(0, estimate=np.empty((0, 3)), levels=None), CALIBRATED)


def test_a_network_that_regresses_has_nothing_to_calibrate() -> None:
    network = EgoVM(msgspec.structs.replace(NETWORK, ablation=ABLATIONS["A6"]))
    with pytest.raises(EgolocError, match="regression states no covariance"):
        calibrate(network, EvaluationBatches(RECIPE, network.config, NOISES["uniform"], 30, "calibration"))
