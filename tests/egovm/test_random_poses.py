"""Importance sampling: densities integrate to one, samples follow them, integrals of known posteriors come out."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from egovm.random_poses import UNIFORM, Proposal, sample_poses, von_mises

torch.set_num_threads(1)

HALF = (3.0, math.radians(3.0))
MEAN = torch.tensor([[0.4, -0.3, 0.004]], dtype=torch.float64)
ROOT = torch.tensor([[0.3, 0.0, 0.0], [-0.1, 0.15, 0.0], [0.002, 0.004, 0.008]], dtype=torch.float64)
COV = (ROOT @ ROOT.T)[None]


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def gaussian(mean: Tensor, cov: Tensor) -> Callable[[Tensor], Tensor]:
    """Its log without the constant."""

    def score(offsets: Tensor) -> Tensor:
        apart = offsets - mean[:, None]
        return -0.5 * torch.einsum("bmi,bij,bmj->bm", apart, cov.inverse(), apart)

    return score


def log_integral(cov: Tensor) -> float:
    return float(1.5 * math.log(2.0 * math.pi) + 0.5 * torch.logdet(cov[0]))


def estimates(start: Tensor, spread: Tensor, frames: int, seed: int = 0, **how: int) -> np.ndarray:
    """(frames,) independent estimates of the integral of the known density, which is 1."""
    mean, cov = MEAN.repeat(frames, 1), COV.repeat(frames, 1, 1)
    score = gaussian(mean, cov)
    begin, wide = start.repeat(frames, 1), spread.repeat(frames, 1, 1)
    _, log_q, scores = sample_poses(score, begin, wide, HALF, generator(seed), **how)
    return torch.exp(scores - log_q - log_integral(COV)).mean(1).numpy()


def bias(found: np.ndarray) -> tuple[float, float]:
    """How far the mean is from 1, and its standard error."""
    return float(found.mean() - 1.0), float(found.std(ddof=1)) / math.sqrt(len(found))


def test_a_proposals_density_is_that_of_its_distributions() -> None:
    proposal = Proposal.around(MEAN, COV, HALF)
    at = proposal.draw(50, generator(0))
    scale = proposal.root[0] @ proposal.root[0].T
    xy = stats.multivariate_t(MEAN[0, :2].numpy(), scale.numpy(), df=3).logpdf(at[0, :, :2].numpy())
    yaw = at[0, :, 2].numpy()
    peaked = stats.vonmises(float(proposal.kappa[0]), loc=float(MEAN[0, 2])).pdf(yaw)
    flat = np.where(np.abs(yaw) <= HALF[1], 0.5 / HALF[1], 0.0)
    expected = xy + np.log((1.0 - UNIFORM) * peaked + UNIFORM * flat)
    assert proposal.log_density(at)[0].numpy() == pytest.approx(expected, abs=1e-10)


def test_a_proposals_samples_follow_its_density() -> None:
    proposal = Proposal.around(MEAN, COV, HALF)
    drawn = proposal.draw(20_000, generator(1))[0]
    white = torch.linalg.solve_triangular(proposal.root[0], (drawn[:, :2] - MEAN[0, :2]).T, upper=False)
    assert stats.kstest(white[0].numpy(), stats.t(3).cdf).pvalue > 1e-3
    assert stats.kstest((white.square().sum(0) / 2.0).numpy(), stats.f(2, 3).cdf).pvalue > 1e-3

    def cdf(yaw: np.ndarray) -> np.ndarray:
        peaked = stats.vonmises(float(proposal.kappa[0]), loc=float(MEAN[0, 2])).cdf(yaw)
        return (1.0 - UNIFORM) * peaked + UNIFORM * np.clip(0.5 + 0.5 * yaw / HALF[1], 0.0, 1.0)

    assert stats.kstest(drawn[:, 2].numpy(), cdf).pvalue > 1e-3


@pytest.mark.parametrize("kappa", [0.5, 10.0, 1e4, 1e7])
def test_von_mises_samples(kappa: float) -> None:
    drawn = von_mises(torch.full((20_000,), kappa, dtype=torch.float64), generator(2))
    assert stats.kstest(drawn.numpy(), stats.vonmises(kappa).cdf).pvalue > 1e-3


@pytest.mark.parametrize("start", [(0.4, -0.3, 0.004), (0.0, 0.0, 0.0)])
def test_the_integral_of_a_known_density_is_unbiased(start: tuple[float, float, float]) -> None:
    """Of one round, exactly so, at the peak and off it."""
    found, error = bias(estimates(torch.tensor([start], dtype=torch.float64), 4.0 * COV, 1000, rounds=1))
    assert error < 0.01
    assert abs(found) < 4.0 * error


def test_rounds_that_learn_are_low_by_a_percent_and_less_with_more_poses() -> None:
    """The price of proposals that depend on the samples: it falls as one over their number."""
    few, error = bias(estimates(MEAN, 4.0 * COV, 1000))
    many, smaller_error = bias(estimates(MEAN, 4.0 * COV, 100, count=8192))
    assert error < 0.003
    assert -0.02 < few < -3.0 * error
    assert smaller_error < 0.002
    assert abs(many) < max(0.1 * abs(few), 4.0 * smaller_error)


def test_rounds_learn_from_each_other() -> None:
    """From a start 5 sigma and more away, four rounds of 128 come closer to the integral than one of 512."""
    start = torch.tensor([[-1.0, 0.8, -0.02]], dtype=torch.float64)
    errors = {rounds: np.abs(estimates(start, COV, 200, rounds=rounds) - 1.0).mean() for rounds in (1, 4)}
    assert errors[4] < 0.5 * errors[1]


def test_only_the_window_is_integrated() -> None:
    """A flat score has the volume of the window as its integral."""

    def flat(offsets: Tensor) -> Tensor:
        inside = (offsets.abs() <= offsets.new_tensor((HALF[0], HALF[0], HALF[1]))).all(-1)
        return torch.where(inside, 0.0, -torch.inf)

    volume = 8.0 * HALF[0] ** 2 * HALF[1]
    wide = torch.diag(torch.tensor([1.5, 1.5, 0.02], dtype=torch.float64)).square()[None]
    _, log_q, scores = sample_poses(
        flat, torch.zeros(400, 3, dtype=torch.float64), wide.repeat(400, 1, 1), HALF, generator(0)
    )
    found, error = bias((torch.exp(scores - log_q).mean(1) / volume).numpy())
    assert error < 0.01
    assert abs(found) < 0.03


def test_the_same_generator_gives_the_same_poses() -> None:
    a, b, c = (sample_poses(gaussian(MEAN, COV), MEAN, COV, HALF, generator(seed)) for seed in (5, 5, 6))
    assert torch.equal(a[0], b[0])
    assert torch.equal(a[1], b[1])
    assert not torch.equal(a[0], c[0])


@pytest.mark.parametrize(("count", "rounds"), [(512, 4), (10, 3), (7, 1)])
def test_as_many_poses_as_asked_for(count: int, rounds: int) -> None:
    mean, cov = MEAN.repeat(3, 1).requires_grad_(), COV.repeat(3, 1, 1)
    score = gaussian(mean, cov)
    drawn, log_q, scores = sample_poses(score, mean, cov, HALF, generator(0), count, rounds)
    assert torch.equal(scores, score(drawn))
    assert scores.requires_grad
    assert drawn.shape == (3, count, 3)
    assert log_q.shape == (3, count)
    assert not drawn.requires_grad


def test_a_window_that_no_pose_hits_leaves_finite_proposals() -> None:
    drawn, log_q, _ = sample_poses(lambda o: torch.full(o.shape[:2], -torch.inf), MEAN, COV, HALF, generator(0))
    assert torch.isfinite(drawn).all()
    assert torch.isfinite(log_q).all()


def test_a_posterior_without_width_is_sampled_all_the_same() -> None:
    drawn, log_q, _ = sample_poses(gaussian(MEAN, COV * 1e-8), MEAN, torch.zeros(1, 3, 3), HALF, generator(0))
    assert torch.isfinite(drawn).all()
    assert torch.isfinite(log_q).all()
