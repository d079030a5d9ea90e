"""Errors against answers by hand: axes of the true heading, yaw, and the covariance that is stated."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from egovm.config import LatticeConfig
from egovm.evaluate import Errors, summary
from egovm.judging import judged
from egovm.pose_solver import PoseEstimate, PoseSolver
from egovm.regression_solver import RegressedPose
from sensors.errors import EgolocError

LATTICE = LatticeConfig(half_m=1.0, half_deg=2.0, steps=5, levels=1)


def estimate(offset: Tensor, cov: Tensor, centre_yaw: float = 0.0) -> PoseEstimate:
    """An estimate with a covariance at a centre that is turned by a yaw."""
    count = len(offset)
    solver = PoseSolver(LATTICE)
    maps, embeddings = torch.zeros(count, 1, 24, 24), torch.zeros(count, 1, 1)
    made = solver([maps], [embeddings], torch.zeros(count, 1, 2), torch.ones(count, 1, dtype=torch.bool))
    centre = torch.tensor([[0.0, 0.0, centre_yaw]]).repeat(count, 1)
    return replace(made, offset=offset, levels=(replace(made.levels[0], cov=cov, centre=centre),))


def test_errors_are_along_and_left_of_the_true_heading() -> None:
    """The vehicle heads 90 deg to the left of the initial pose: what is ahead of that is to its right."""
    truth = torch.tensor([[1.0, 2.0, math.pi / 2]])
    found = judged(RegressedPose(torch.tensor([[1.3, 2.1, math.pi / 2 + 0.01]]), torch.tensor([True])), truth)
    np.testing.assert_allclose(found.error[0].numpy(), (0.1, -0.3, 0.01), atol=1e-6)
    assert found.nees.isnan().all()
    assert found.total.isnan().all()


def test_nees_is_the_squared_error_by_the_stated_variance() -> None:
    offset = torch.tensor([[0.2, 0.3, 0.01]])
    cov = torch.diag(torch.tensor((0.1**2, 0.3**2, 0.02**2)))[None]
    found = judged(estimate(offset, cov), torch.zeros(1, 3))
    np.testing.assert_allclose(found.nees[0].numpy(), (4.0, 1.0, 0.25), rtol=1e-5)
    assert float(found.total) == pytest.approx(5.25, rel=1e-5)


def test_the_covariance_is_turned_to_the_truth() -> None:
    """Stated at a centre 90 deg to the right of the truth: its x is the truth's right, its y the truth's ahead."""
    truth = torch.tensor([[0.0, 0.0, math.pi / 2]])
    error_in_truth = torch.tensor([[0.2, 0.3, 0.0]])
    offset = torch.tensor([[-0.3, 0.2, math.pi / 2]])
    cov = torch.diag(torch.tensor((0.3**2, 0.1**2, 1.0)))[None]
    found = judged(estimate(offset, cov), truth)
    np.testing.assert_allclose(found.error, error_in_truth, atol=1e-6)
    np.testing.assert_allclose(found.nees[0, :2].numpy(), (4.0, 1.0), rtol=1e-4)


def test_an_infinite_covariance_states_nothing() -> None:
    cov = torch.diag(torch.full((3,), torch.inf))[None].repeat(2, 1, 1)
    cov[1] = torch.eye(3)
    found = judged(estimate(torch.ones(2, 3), cov), torch.zeros(2, 3))
    assert found.nees[0].isnan().all()
    assert found.total.isnan().tolist() == [True, False]


def test_a_covariance_without_width_is_told_from_none() -> None:
    cov = torch.zeros(2, 3, 3)
    cov[1] = torch.eye(3)
    found = judged(estimate(torch.ones(2, 3), cov), torch.zeros(2, 3))
    assert found.total.tolist() == [math.inf, pytest.approx(3.0)]
    report = summary(errors(2, nees=found.nees.numpy(), total=found.total.numpy(), estimate=np.ones((2, 3))))
    assert report["nees"]["without_width"] == 1
    assert report["nees"]["mean_by_3"] == pytest.approx(1.0)


def errors(count: int = 4, **columns: object) -> Errors:
    given = {
        "initial": np.ones((count, 3)),
        "estimate": np.array([[0.05, -0.15, 0.0], [0.15, 0.05, 0.2], [-0.25, 0.05, 0.4], [0.35, 0.05, 0.8]]),
        "nees": np.full((count, 3), 2.0),
        "total": np.array([3.0, 3.0, 6.0, 12.0]),
        "found": np.ones(count, bool),
        "seconds": np.full(count, 0.04),
    }
    return Errors(**(given | columns))  # type: ignore[arg-type]


def test_figures_are_those_of_the_errors() -> None:
    report = summary(errors())
    lon = report["methods"]["egovm"]["lon"]
    assert lon["mae"] == pytest.approx(0.2)
    assert lon["rmse"] == pytest.approx(math.sqrt(0.21 / 4.0))
    assert lon["bias"] == pytest.approx(0.075)
    assert lon["max"] == pytest.approx(0.35)
    assert lon["below"] == {"0.1": 0.25, "0.2": 0.5, "0.3": 0.75}
    assert report["methods"]["egovm"]["yaw"]["below"] == {"0.1": 0.25, "0.3": 0.5, "0.6": 0.75}
    assert report["methods"]["initial"]["lat"]["mae"] == 1.0
    assert report["nees"]["mean_by_3"] == pytest.approx(2.0)
    assert report["nees"]["median_by_3"] == pytest.approx(1.5)
    assert report["nees"]["beyond_99"] == 0.25
    assert report["nees"]["yaw"] == 2.0
    assert report["network_ms"]["p50"] == pytest.approx(40.0)


def test_frames_without_landmarks_are_counted_and_state_nothing() -> None:
    report = summary(errors(found=np.array([True, True, True, False]), total=np.array([3.0, 3.0, 6.0, np.nan])))
    assert report["without_landmarks"] == 1
    assert report["nees"]["mean_by_3"] == pytest.approx(4.0 / 3.0)


def test_no_covariance_at_all_is_no_figure() -> None:
    assert summary(errors(total=np.full(4, np.nan)))["nees"] is None


def test_nothing_to_judge_is_told() -> None:
    with pytest.raises(EgolocError, match="expected one frame or more, got none"):
        summary(errors(0, estimate=np.empty((0, 3)), total=np.empty(0), nees=np.empty((0, 3))))
