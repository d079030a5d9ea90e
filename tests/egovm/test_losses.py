"""Losses: gradients against finite differences, known posteriors in closed form, and inputs that hold little."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from egovm.losses import (
    focal_loss,
    random_pose_loss,
    regression_loss,
    rmse_loss,
    semantic_loss,
    solver_loss,
)
from egovm.random_poses import sample_poses
from tests.egovm.test_random_poses import COV, HALF, MEAN, gaussian, generator

torch.set_num_threads(1)

TRUTH = torch.tensor([[0.5, -0.2, 0.006]], dtype=torch.float64)
UNITS = torch.tensor([1.0, 1.0, 180.0 / math.pi], dtype=torch.float64)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def test_rmse_weighs_sharp_axes_most() -> None:
    """By hand: variances 0.01, 0.04 and 0.0025 along the axes, in m and deg."""
    cov = torch.diag(torch.tensor([0.01, 0.04, 0.0025], dtype=torch.float64) / UNITS**2)[None]
    error = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    inverse = np.array([1 / 0.0101, 1 / 0.0401, 1 / 0.0026])
    expected = math.sqrt((3.0 * inverse / inverse.sum() * np.array([0.1, 0.2, 0.3]) ** 2).sum())
    assert rmse_loss(TRUTH + error / UNITS, cov, TRUTH).item() == pytest.approx(expected, rel=1e-9)


def test_rmse_of_a_round_posterior_is_the_distance() -> None:
    cov = (torch.eye(3, dtype=torch.float64) * 0.2 / UNITS / UNITS[:, None])[None]
    error = torch.tensor([[0.3, 0.0, -0.4]], dtype=torch.float64)
    assert rmse_loss(error / UNITS, cov, torch.zeros(1, 3).double()).item() == pytest.approx(0.5)
    assert regression_loss(error / UNITS, torch.zeros(1, 3).double()).item() == pytest.approx(0.5)


def test_rmse_does_not_change_with_the_axes_it_is_told_in() -> None:
    """Turned error and covariance give the same."""
    c, s = math.cos(0.7), math.sin(0.7)
    R = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    here, there = rmse_loss(MEAN, COV, TRUTH), rmse_loss(MEAN @ R.T, R @ COV @ R.T, TRUTH @ R.T)
    assert torch.allclose(here, there, rtol=1e-9)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1.0, math.inf])
def test_rmse_has_gradients_where_eigenvalues_are_equal(scale: float) -> None:
    mean = TRUTH.float().clone().requires_grad_()
    identity = torch.eye(3) / UNITS.float() / UNITS.float()[:, None]
    cov = torch.where(torch.eye(3) > 0, scale * identity.clamp(min=1e-9), torch.zeros(3, 3))[None].requires_grad_()
    rmse_loss(mean, cov, torch.zeros(1, 3)).sum().backward()
    assert mean.grad is not None
    assert torch.isfinite(mean.grad).all()
    assert mean.grad.abs().max() > 0.0
    assert cov.grad is None  # a wider posterior must not lower the loss
    at_truth = torch.zeros(1, 3, requires_grad=True)
    rmse_loss(at_truth, cov.detach(), torch.zeros(1, 3)).sum().backward()
    assert at_truth.grad is not None
    assert not at_truth.grad.any()


def test_gradients_are_those_of_finite_differences() -> None:
    cov = COV + 0.0
    assert torch.autograd.gradcheck(lambda mean: rmse_loss(mean, cov, TRUTH), MEAN.clone().requires_grad_())
    scores, at_truth = normal(2, 30).requires_grad_(), normal(2, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(solver_loss, (scores, at_truth))
    density = normal(2, 30, seed=2)
    assert torch.autograd.gradcheck(lambda s, t: random_pose_loss(s, density, t), (scores, at_truth))
    outside = torch.arange(30) % 3 == 0
    masked = lambda s, t: random_pose_loss(s.masked_fill(outside, -math.inf), density, t)  # noqa: E731
    assert torch.autograd.gradcheck(masked, (scores, at_truth))
    logits, drawn = (3.0 * normal(2, 3, 4, 4)).requires_grad_(), normal(2, 3, 4, 4, seed=3) > 1.0
    assert torch.autograd.gradcheck(lambda given: focal_loss(given, drawn), logits)
    fine = normal(2, 3, 8, 8, seed=4).requires_grad_()
    both = lambda a, b: semantic_loss((a, b), (drawn, drawn.repeat(1, 1, 2, 2)))  # noqa: E731
    assert torch.autograd.gradcheck(both, (logits, fine))


def test_the_solver_loss_is_never_below_zero() -> None:
    scores = 30.0 * normal(200, 40)
    at_truth = 60.0 * normal(200, seed=1)
    loss = solver_loss(scores, at_truth)
    assert loss.min() >= 0.0
    expected = -(torch.cat((scores, at_truth[:, None]), 1).log_softmax(1)[:, -1])
    assert torch.allclose(loss, expected)
    assert solver_loss(torch.zeros(1, 2196), torch.zeros(1)).item() == pytest.approx(math.log(2197))


def test_the_random_pose_loss_of_a_gaussian_is_its_closed_form() -> None:
    """-log N(truth; mean, cov): 100 frames of 2048 poses, so that the Monte-Carlo error is 0.2 %."""
    mean, cov = MEAN.repeat(100, 1), COV.repeat(100, 1, 1)
    score = gaussian(mean, cov)
    _, log_q, scores = sample_poses(score, mean, 2.0 * cov, HALF, generator(4), count=2048)
    at_truth = score(TRUTH.repeat(100, 1)[:, None])[:, 0]
    loss = random_pose_loss(scores, log_q, at_truth)
    expected = -torch.distributions.MultivariateNormal(MEAN[0], COV[0]).log_prob(TRUTH[0])
    error = float(loss.std()) / 10.0
    assert error < 0.003
    assert (
        abs(float(loss.mean() - expected)) < 4.0 * error + 0.004
    )  # and a bias of 1 % / 4, as test_random_poses measures
    assert expected < 0.0  # a density's logarithm: legal


def test_the_random_pose_loss_without_a_pose_in_the_window_is_told_apart() -> None:
    scores = torch.full((2, 5), -math.inf)
    scores[1, 2] = 1.0
    loss = random_pose_loss(scores.requires_grad_(), torch.zeros(2, 5), torch.zeros(2))
    assert torch.isfinite(loss).tolist() == [False, True]
    torch.where(torch.isfinite(loss), loss, 0.0).sum().backward()
    assert scores.grad is not None
    assert torch.isfinite(scores.grad).all()


def test_focal_loss_by_hand() -> None:
    """One type, four cells, one drawn; p = 0.5 there, 0.2 elsewhere."""
    logits = torch.tensor([[[[0.0, math.log(0.25)], [math.log(0.25), math.log(0.25)]]]])
    drawn = torch.tensor([[[[True, False], [False, False]]]])
    expected = 0.5**2 * -math.log(0.5) + 3 * 0.2**2 * -math.log(0.8)
    assert focal_loss(logits, drawn).item() == pytest.approx(expected, rel=1e-5)
    double = focal_loss(logits.repeat(2, 3, 1, 1), drawn.repeat(2, 3, 1, 1)).item()
    assert double == pytest.approx(3.0 * expected, rel=1e-5)  # summed over types, by drawn cell over frames


def test_focal_loss_is_finite_where_it_is_sure_and_where_nothing_is_drawn() -> None:
    logits = torch.tensor([200.0, -200.0, 0.0, 80.0]).reshape(1, 1, 2, 2).requires_grad_()
    for drawn in (torch.zeros(1, 1, 2, 2, dtype=torch.bool), torch.ones(1, 1, 2, 2, dtype=torch.bool)):
        loss = focal_loss(logits, drawn)
        (gradient,) = torch.autograd.grad(loss, logits)
        assert torch.isfinite(loss)
        assert torch.isfinite(gradient).all()
