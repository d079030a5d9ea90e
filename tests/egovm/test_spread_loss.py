"""The loss against a truth that is shared out among candidates: where it is nothing, and that nothing is too sharp."""

import pytest
import torch
from torch import Tensor

from egovm.config import LatticeConfig
from egovm.lattice import candidates, rotated
from egovm.losses import spread_loss


def spread(local: Tensor, lattice: LatticeConfig, level: int) -> Tensor:
    """(yaw, x, y) the truth (3,) shared out among the candidates, one by one: linear in the steps along each axis."""
    n, shares = lattice.steps, []
    t = rotated(local[:2], -local[2])
    steps = (lattice.step_rad(level), lattice.step_m(level), lattice.step_m(level))
    for value, step in zip((local[2], *t), steps, strict=True):
        away = (torch.arange(n, dtype=torch.float64) - lattice.reach - value / step).abs()
        shares.append((1.0 - away).clamp(min=0.0))
    return torch.einsum("i,j,k->ijk", *shares)


@pytest.mark.parametrize("local", [(0.21, -0.33, 0.011), (0.0, 0.0, 0.0), (1.0, -1.0, 0.0), (-0.5, 0.26, -0.0349)])
def test_the_spread_loss_is_nothing_where_the_posterior_is_the_truth_shared_out(
    local: tuple[float, float, float],
) -> None:
    lattice, truth = (
        LatticeConfig(half_m=1.0, half_deg=2.0, steps=5, levels=1),
        torch.tensor([local], dtype=torch.float64),
    )
    wanted = spread(truth[0], lattice, 0)
    assert wanted.sum().item() == pytest.approx(1.0)
    scores = (wanted + 1e-30).log()[None] + 3.0
    assert spread_loss(lattice, 0, scores, truth).item() == pytest.approx(0.0, abs=1e-9)
    p, bins = wanted.flatten(), candidates(lattice, 0, truth).flatten(0, 2)
    along = rotated(bins[:, :2], -bins[:, 2])  # in t the lattice is regular
    torch.testing.assert_close(p @ along, rotated(truth[0, :2], -truth[0, 2]), atol=1e-9, rtol=0.0)
    assert (p @ bins[:, 2]).item() == pytest.approx(local[2], abs=1e-9)


def test_the_spread_loss_rises_for_what_is_too_sharp_and_too_wide() -> None:
    lattice, truth = (
        LatticeConfig(half_m=1.0, half_deg=2.0, steps=5, levels=1),
        torch.tensor([[0.2, -0.3, 0.01]], dtype=torch.float64),
    )
    scores = (spread(truth[0], lattice, 0) + 1e-3).log()[None]
    best, sharp, wide = (spread_loss(lattice, 0, factor * scores, truth).item() for factor in (1.0, 6.0, 0.2))
    assert 0.0 <= best < min(sharp, wide)


def test_the_spread_loss_has_its_gradient() -> None:
    lattice = LatticeConfig(half_m=1.0, half_deg=2.0, steps=3, levels=1)
    scores = torch.randn(
        2, 3, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True
    )
    truth = torch.tensor([[0.21, -0.33, 0.011], [1.0, 0.0, -0.02]], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda given: spread_loss(lattice, 0, given, truth), scores)
