"""Known peaks: found from anywhere in the window, two told as two, and the covariance that of the evidence."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from egovm.config import LatticeConfig
from egovm.lattice import candidates
from egovm.pose_solver import PoseEstimate, PoseSolver
from egovm.solver_modes import two_modes
from tests.egovm.landmark_planes import layout, planes

LATTICE = LatticeConfig()
DEGREE = math.pi / 180.0


def estimate(places: Tensor, truths: Tensor, sigma_m: float = 0.3, sharp: float = 12.0) -> PoseEstimate:
    features = planes(LATTICE, places, truths, sigma_m, sharp)
    ones = torch.ones(1, len(places), 1, dtype=torch.float64)
    with torch.no_grad():
        found: PoseEstimate = PoseSolver(LATTICE)(features, [ones] * 3, places[None], ones[..., 0] > 0)
    return found


@settings(max_examples=6, deadline=None, derandomize=True)
@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.integers(0, 3))
def test_a_peak_is_found_from_any_start(x: float, y: float, yaw_deg: float, seed: int) -> None:
    truth = torch.tensor([x, y, yaw_deg * DEGREE], dtype=torch.float64)
    found = estimate(layout(seed), truth[None])
    error = (found.offset[0] - truth).abs()
    assert found.found.all()
    assert (error[:2] < 0.01).all()
    assert error[2] < 0.02 * DEGREE


def test_the_composed_pose_is_told_not_the_sum_of_the_offsets() -> None:
    truth = torch.tensor([2.8, -2.7, 2.9 * DEGREE], dtype=torch.float64)
    found = estimate(layout(1), truth[None])
    summed = torch.stack([each.mean for each in found.levels]).sum(0)[0]
    assert (found.offset[0] - truth).abs()[:2].max() < 0.01
    assert (summed - found.offset[0])[:2].norm() > 0.01


def test_two_peaks_are_told_as_two_modes() -> None:
    truths = torch.tensor([[1.9, 0.3, 1.0 * DEGREE], [-1.6, -0.2, -1.0 * DEGREE]], dtype=torch.float64)
    found = estimate(layout(2), truths)
    modes, weights = found.modes[0], found.weights[0]
    assert weights.sum() == pytest.approx(1.0)
    assert weights.min() > 0.1
    first = int((truths[0] - modes[:, :3]).norm(dim=1).argmin())
    ordered = modes[[first, 1 - first]]
    assert ((ordered - truths).abs() < torch.tensor([0.25, 0.25, 0.25 * DEGREE])).all()


def bumps(*peaks: tuple[float, float, float, float, float]) -> Tensor:
    """log_p (1, 13, 13, 13) of Gaussians (weight, yaw, x, y, sigma), in steps from the middle."""
    at = torch.arange(-6.0, 7.0, dtype=torch.float64)
    yaw, x, y = torch.meshgrid(at, at, at, indexing="ij")
    p = sum(
        w * torch.exp(-((yaw - a) ** 2 + (x - b) ** 2 + (y - c) ** 2) / (2 * s**2)) / s**3 for w, a, b, c, s in peaks
    )
    assert isinstance(p, Tensor)
    return (p / p.sum()).log()[None]


def modes_of(log_p: Tensor) -> tuple[Tensor, Tensor]:
    modes, weights = two_modes(log_p, candidates(LATTICE, 0, log_p))
    return modes[0], weights[0]


def test_masses_of_two_modes() -> None:
    modes, weights = modes_of(bumps((0.3, 0, 4, 0, 0.7), (0.7, 0, -3, 1, 0.7)))
    assert weights.tolist() == pytest.approx([0.7, 0.3], abs=1e-4)
    assert modes[0].tolist() == pytest.approx([-1.5, 0.5, 0.0], abs=0.01)
    assert modes[1].tolist() == pytest.approx([2.0, 0.0, 0.0], abs=0.02)


def test_a_broad_mode_that_weighs_more_than_the_highest_peak_comes_first() -> None:
    modes, weights = modes_of(bumps((0.3, 0, 4, 0, 0.6), (0.7, 0, -3, 0, 1.2)))
    assert weights[0] > 0.6
    assert 0.0 < weights[1] < 0.4
    assert modes[0, 0] < 0 < modes[1, 0]


@pytest.mark.parametrize(
    "one",
    [
        bumps((1.0, 0, 1, 2, 1.0)),
        bumps((1.0, 0, 1, 2, 1e-3)),  # a single bin
        bumps((1.0, 0, -2, 0, 1.5), (0.9, 0, 2, 0, 1.5)),  # one ridge without a dip
        bumps((1.0, 0, 0, 0, 1.0), (1e-5, 0, 5, 5, 1.0)),  # too weak
        bumps((1.0, 0, 0, 0, 0.5), (0.9, 0, 2, 0, 0.5)),  # too near
    ],
)
def test_one_mode_is_told_as_one(one: Tensor) -> None:
    modes, weights = modes_of(one)
    assert weights.tolist() == pytest.approx([1.0, 0.0])
    assert modes[1].tolist() == [0.0, 0.0, 0.0]


def test_a_histogram_that_a_prior_cut_has_modes_where_it_is_left() -> None:
    log_p = bumps((0.5, 0, 4, 0, 0.7), (0.5, 0, -3, 0, 0.7))
    log_p[:, :, :6] = -torch.inf
    modes, weights = modes_of(log_p - log_p.logsumexp((1, 2, 3)))
    assert modes[0, 0] == pytest.approx(2.0, abs=0.02)
    assert torch.isfinite(modes).all()
    assert weights[1] < 1e-3


def test_the_covariance_is_that_of_the_evidence() -> None:
    """Elements on a circle of radius r: information sharp / sigma^2 in each axis of the plane, times r^2 in yaw."""
    angle = torch.arange(36, dtype=torch.float64) * 10.0 * DEGREE
    places = 20.0 * torch.stack((angle.cos(), angle.sin()), -1)
    found = estimate(places, torch.zeros(1, 3).double(), sigma_m=0.3, sharp=12.0)
    variance = 0.3**2 / 12.0
    wanted = torch.tensor([variance, variance, variance / 20.0**2]).double()
    assert torch.allclose(found.levels[2].cov[0].diagonal(), wanted, rtol=0.05)


def test_more_evidence_is_sharper_with_a_smaller_alpha() -> None:
    few, many = layout(3, 15), layout(3, 60)
    spread = {}
    for alpha in (1.0, 0.0):
        for places in (few, many):
            features = planes(LATTICE, places, torch.zeros(1, 3).double(), 0.5, 0.2)
            ones = torch.ones(1, len(places), 1, dtype=torch.float64)
            with torch.no_grad():
                found = PoseSolver(LATTICE, alpha=alpha)(features, [ones] * 3, places[None], ones[..., 0] > 0)
            spread[alpha, len(places)] = float(found.levels[2].cov[0, 0, 0])
    assert spread[0.0, 60] < 0.5 * spread[0.0, 15]
    assert spread[1.0, 60] > 0.8 * spread[1.0, 15]
