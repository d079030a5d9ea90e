"""All losses together, with the solver that they judge; what ablations leave out; nothing, one, and all outside."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from egovm.batch import TYPES, Truth
from egovm.config import Ablation, LatticeConfig
from egovm.lattice import between
from egovm.losses import LossConfig, Losses, network_losses
from egovm.pose_solver import PoseEstimate, PoseSolver
from egovm.solver_window import in_window
from tests.egovm.landmark_planes import layout, planes

torch.set_num_threads(1)

LATTICE = LatticeConfig(half_m=1.0, half_deg=2.0, steps=5, levels=2)
TRUTH = torch.tensor([[0.33, -0.42, 0.011]], dtype=torch.float64)
CONFIG = LossConfig()


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def rasters(frames: int) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Logits and truth of two levels."""
    logits = tuple(torch.randn(frames, TYPES - 1, 8 << n, 8 << n, generator=generator(n)) - 4.6 for n in range(2))
    drawn = tuple(torch.rand(frames, TYPES - 1, 8 << n, 8 << n, generator=generator(9 + n)) < 0.05 for n in range(2))
    return logits, drawn


def solved(sharp: float = 2.0, dtype: torch.dtype = torch.float64) -> tuple[PoseSolver, PoseEstimate, list[Tensor]]:
    """A solver's estimate where the truth is known, and the BEV maps, whose gradients are wanted."""
    places = layout(1, 12, 8.0)
    maps = [plane.to(dtype).requires_grad_() for plane in planes(LATTICE, places, TRUTH, 0.4, sharp)]
    solver = PoseSolver(LATTICE).to(dtype)
    embeddings = [torch.ones(1, len(places), 1, dtype=dtype) for _ in maps]
    valid = torch.ones(1, len(places), dtype=torch.bool)
    return solver, solver(maps, embeddings, places.to(dtype)[None], valid), maps


def losses(
    estimate: PoseEstimate | Tensor, solver: PoseSolver | None, truth: Tensor = TRUTH, **switches: bool
) -> Losses:
    logits, drawn = rasters(len(truth))
    return network_losses(CONFIG, Ablation(**switches), Truth(truth, drawn), estimate, solver, logits, generator())


def test_the_total_is_the_weighted_sum_and_every_part_counts() -> None:
    solver, estimate, maps = solved()
    found = losses(estimate, solver)
    expected = found.rmse + found.solver + found.random_pose + 0.1 * found.semantic
    assert found.total.item() == pytest.approx(expected.item())
    assert found.rmse > 0.0
    assert found.solver > 0.0
    assert found.semantic > 0.0
    assert found.random_pose.item() != 0.0
    for part in (found.rmse, found.solver, found.random_pose):
        for gradient in torch.autograd.grad(part, maps, retain_graph=True):
            assert torch.isfinite(gradient).all()
            assert gradient.abs().max() > 0.0


def test_the_random_pose_loss_is_the_integral_over_the_window() -> None:
    """Against a sum of the solver's scores over a fine grid in (t, yaw), which has the volume of (d, yaw)."""
    solver, estimate, _ = solved()
    config = LossConfig(samples=8192)
    expected = []
    for level, found in enumerate(estimate.levels):
        n = 60
        middles = (torch.arange(n, dtype=torch.float64) + 0.5) / n * 2.0 - 1.0
        half = torch.tensor([LATTICE.half_m, LATTICE.half_m, math.radians(LATTICE.half_deg)]) / 2**level
        t = torch.stack(torch.meshgrid(middles, middles, middles, indexing="ij"), -1).flatten(0, 2) * half.double()
        c, s = t[:, 2].cos(), t[:, 2].sin()
        offsets = torch.stack((c * t[:, 0] - s * t[:, 1], s * t[:, 0] + c * t[:, 1], t[:, 2]), -1)[None]
        assert in_window(LATTICE, level, offsets).all()
        with torch.no_grad():
            scores = torch.cat([solver.scores_at(found.window, part) for part in offsets.split(20_000, 1)], 1)
            at_truth = solver.scores_at(found.window, between(found.centre, TRUTH)[:, None])[0, 0]
        volume = 8.0 * math.prod(half.tolist())
        expected.append(float(torch.logsumexp(scores[0], 0)) + math.log(volume / n**3) - float(at_truth))
    logits, drawn = rasters(1)
    found = network_losses(config, Ablation(), Truth(TRUTH, drawn), estimate, solver, logits, generator())
    assert found.random_pose.item() == pytest.approx(np.mean(expected), abs=0.02)


def test_following_the_gradient_brings_the_posterior_to_the_truth() -> None:
    """Of a flat map, by 120 steps on the features alone: to a tenth of the finer level's step of 0.25 m and 0.5 deg."""
    places = layout(2, 12, 8.0)
    maps = [torch.zeros(1, 1, 48 << n, 48 << n, dtype=torch.float64, requires_grad=True) for n in range(2)]
    solver, config = PoseSolver(LATTICE).double().requires_grad_(False), LossConfig(samples=128)
    optimizer = torch.optim.Adam(maps, lr=0.1)
    ones, valid = [torch.ones(1, 12, 1).double()] * 2, torch.ones(1, 12, dtype=torch.bool)
    logits, drawn = rasters(1)
    first = None
    for step in range(120):
        estimate = solver(maps, ones, places[None], valid)
        found = network_losses(config, Ablation(), Truth(TRUTH, drawn), estimate, solver, logits, generator(step))
        first = found if first is None else first
        optimizer.zero_grad()
        found.total.backward()
        optimizer.step()
    assert first is not None
    assert (estimate.offset - TRUTH).abs()[0, :2].max() < 0.025
    assert (estimate.offset - TRUTH).abs()[0, 2] < math.radians(0.05)
    assert found.rmse < 0.1 * first.rmse
    assert found.solver < first.solver
    assert found.random_pose < first.random_pose - 1.0


def test_ablations_leave_their_loss_out() -> None:
    solver, estimate, _ = solved()
    everything = losses(estimate, solver)
    a3, a5 = losses(estimate, solver, semantic_supervision=False), losses(estimate, solver, random_pose_loss=False)
    assert a3.semantic.item() == 0.0
    assert a3.total.item() == pytest.approx((everything.total - 0.1 * everything.semantic).item())
    assert a5.random_pose.item() == 0.0
    assert a5.total.item() == pytest.approx((everything.total - everything.random_pose).item())


def test_a6_is_judged_by_its_distance_alone() -> None:
    offset = (TRUTH + torch.tensor([[0.3, 0.4, 0.0]])).requires_grad_()
    found = losses(offset, None)
    assert found.rmse.item() == pytest.approx(0.5)
    assert found.solver.item() == found.random_pose.item() == 0.0
    assert found.semantic > 0.0
    found.total.backward()
    assert offset.grad is not None
    assert torch.isfinite(offset.grad).all()


def test_a_truth_outside_a_level_is_not_learnt_there() -> None:
    solver, estimate, maps = solved()
    out = torch.tensor([[1.2, 0.0, 0.0]], dtype=torch.float64)
    found = losses(estimate, solver, out)
    assert found.rmse.item() == found.solver.item() == found.random_pose.item() == 0.0
    centre = estimate.levels[1].centre
    only_first = centre + torch.tensor([[-0.9, 0.9, 0.0]], dtype=torch.float64)  # level 1 reaches 0.5 m
    assert in_window(LATTICE, 0, only_first).all()
    found = losses(estimate, solver, only_first)
    gradients = torch.autograd.grad(found.rmse + found.solver + found.random_pose, maps)
    assert gradients[0].abs().max() > 0.0
    assert not gradients[1].any()


@pytest.mark.parametrize("kept", [0, 1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_landmark_and_one_give_finite_losses_and_gradients(kept: int, dtype: torch.dtype) -> None:
    """Beside a frame that has some; and all places outside the map are as none."""
    maps = [torch.randn(3, 2, 48 << n, 48 << n, generator=generator(n)).to(dtype).requires_grad_() for n in range(2)]
    places = layout(1, 6, 8.0).to(dtype).repeat(3, 1, 1)
    places[2] += 100.0
    valid = torch.arange(6) < torch.tensor([[kept], [6], [6]])
    embeddings = [torch.randn(3, 6, 2, generator=generator(5)).to(dtype).requires_grad_() for _ in maps]
    solver = PoseSolver(LATTICE).to(dtype)
    estimate = solver(maps, embeddings, places, valid)
    assert (estimate.levels[0].landmarks == torch.tensor([kept, 6, 0])).all()
    found = losses(estimate, solver, TRUTH.to(dtype).repeat(3, 1))
    assert torch.isfinite(found.total)
    found.total.backward()
    assert all(torch.isfinite(each.grad).all() for each in (*maps, *embeddings, *solver.parameters()))
    assert not maps[0].grad[2].any()


def test_nothing_at_all_is_a_loss_of_zero() -> None:
    maps = [torch.randn(1, 2, 48 << n, 48 << n, requires_grad=True) for n in range(2)]
    solver = PoseSolver(LATTICE)
    estimate = solver(maps, [torch.zeros(1, 3, 2)] * 2, torch.zeros(1, 3, 2), torch.zeros(1, 3, dtype=torch.bool))
    found = losses(estimate, solver, TRUTH.float())
    assert found.rmse.item() == found.solver.item() == found.random_pose.item() == 0.0
    found.total.backward()
    assert not any(plane.grad.any() for plane in maps if plane.grad is not None)


def test_the_same_seed_gives_the_same_losses() -> None:
    solver, estimate, _ = solved()
    a, b = losses(estimate, solver), losses(estimate, solver)
    assert a.total.item() == b.total.item()


def test_an_estimate_comes_with_its_solver() -> None:
    _, estimate, _ = solved()
    with pytest.raises(ValueError, match="the solver that made the estimate"):
        losses(estimate, None)


def test_autocast_does_not_reach_the_losses() -> None:
    solver, estimate, _ = solved(dtype=torch.float32)
    exact = losses(estimate, solver, TRUTH.float())
    with torch.autocast("cpu", torch.bfloat16):
        assert losses(estimate, solver, TRUTH.float()).total.item() == exact.total.item()
