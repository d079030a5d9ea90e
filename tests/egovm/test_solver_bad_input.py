"""The pose solver with inputs that hold little or nothing, with padding, and with a prior."""

import math

import pytest
import torch
from torch import Tensor

from egovm.config import LatticeConfig
from egovm.lattice import candidates
from egovm.pose_solver import PoseEstimate, PoseSolver
from sensors.errors import EgolocError
from tests.egovm.solver_inputs import Inputs, inputs

LATTICE = LatticeConfig()


def estimate(given: Inputs, **options: Tensor) -> PoseEstimate:
    with torch.no_grad():
        found: PoseEstimate = PoseSolver(LATTICE)(*given, **options)
    for each in found.levels:
        for tensor in (each.scores, each.log_p, each.mean, each.cov, each.contribution):
            assert not tensor.isnan().any()
    assert not found.offset.isnan().any()
    assert not found.modes.isnan().any()
    return found


def nothing(given: Inputs) -> list[Inputs]:
    """Inputs that hold no landmark: none, none valid, all outside, places that are no numbers."""
    features, embeddings, places, valid = given
    return [
        (features, [e[:, :0] for e in embeddings], places[:, :0], valid[:, :0]),
        (features, embeddings, places, torch.zeros_like(valid)),
        (features, embeddings, places + 200.0, valid),
        (features, embeddings, torch.full_like(places, torch.nan), valid),
        (features, embeddings, torch.full_like(places, 1e300), valid),
    ]


@pytest.mark.parametrize("which", range(5))
def test_no_landmarks_is_a_clear_answer(which: int) -> None:
    found = estimate(nothing(inputs(LATTICE, 2, 5))[which])
    assert not found.found.any()
    assert (found.offset == 0).all()
    assert (found.weights == 0).all()
    for each in found.levels:
        assert (each.landmarks == 0).all()
        assert (each.mean == 0).all()
        assert torch.equal(each.cov, torch.diag(torch.full((3,), torch.inf)).double().expand(2, 3, 3))
        assert torch.allclose(each.log_p, torch.full((), -math.log(13**3)).double())


def test_one_sample_without_landmarks_leaves_the_gradients_of_the_other() -> None:
    features, embeddings, places, valid = inputs(LATTICE, 2, 5, half_m=3.0)
    valid[0], valid[1] = True, False
    plane = [f.requires_grad_() for f in features]
    found = PoseSolver(LATTICE)(plane, embeddings, places, valid)
    assert found.found.tolist() == [True, False]
    (found.offset.sum() + sum(each.cov[0].sum() for each in found.levels)).backward()
    for each in plane:
        assert each.grad is not None
        assert each.grad.isfinite().all()
        assert each.grad[0].abs().max() > 0
        assert (each.grad[1] == 0).all()


@pytest.mark.parametrize("elements", [1, 40])
def test_one_element_and_repeated_ones(elements: int) -> None:
    """Forty times the same element is a mean of one and the same: the answer of one."""
    features, embeddings, _, _ = inputs(LATTICE, 1, 1)
    place = torch.tensor([[[1.3, -2.1]]]).double()
    one = estimate((features, embeddings, place, torch.ones(1, 1) > 0))
    many = estimate(
        (
            features,
            [e.expand(-1, elements, -1) for e in embeddings],
            place.expand(-1, elements, -1),
            torch.ones(1, elements) > 0,
        )
    )
    assert one.found.all()
    assert torch.isfinite(one.levels[2].cov).all()
    assert torch.allclose(one.offset, many.offset, atol=1e-12)


def test_padding_changes_nothing() -> None:
    features, embeddings, places, valid = inputs(LATTICE, 2, 9)
    found = estimate((features, embeddings, places, valid))
    rubbish = torch.full((2, 6, 1, 2), torch.nan).double()
    padded = (
        features,
        [torch.cat((e, torch.full_like(e[:, :6], torch.nan)), 1) for e in embeddings],
        torch.cat((places, rubbish), 1),
        torch.cat((valid, torch.zeros(2, 6) > 0), 1),
    )
    again = estimate(padded)
    assert torch.allclose(found.offset, again.offset, atol=1e-13, rtol=0)
    assert torch.allclose(found.levels[2].cov, again.levels[2].cov, atol=1e-13, rtol=0)
    assert torch.equal(again.levels[0].contribution[:, 9:], torch.zeros(2, 6).double())


def test_a_prior_narrows_the_search_and_nothing_else() -> None:
    given = inputs(LATTICE, 1, 12)
    free = estimate(given)
    wide = estimate(given, search=torch.tensor([[9.0, 9.0, 0.3]]))
    assert torch.equal(free.offset, wide.offset)
    narrow = estimate(given, search=torch.tensor([[1.0, 0.5, math.radians(1.0)]]))
    offsets = candidates(LATTICE, 0, given[2])
    kept = narrow.levels[0].log_p[0].isfinite()
    assert 0 < int(kept.sum()) < 13**3
    assert (offsets[kept].abs() <= torch.tensor([1.25, 0.75, math.radians(1.25)]) + 1e-9).all()
    assert torch.equal(narrow.levels[0].scores, free.levels[0].scores)
    ratio = narrow.levels[0].log_p[0][kept] - free.levels[0].log_p[0][kept]
    assert torch.allclose(ratio, ratio[0].expand_as(ratio))  # by the likelihood alone
    only = estimate(given, search=torch.zeros(1, 3))
    assert int(only.levels[0].log_p.isfinite().sum()) >= 1
    assert (only.offset.abs() < torch.tensor([0.5, 0.5, math.radians(0.5)])).all()


def test_a_map_smaller_than_the_window_is_refused() -> None:
    features, embeddings, places, valid = inputs(LATTICE, 1, 2, cells=12)
    with pytest.raises(EgolocError, match="expected at least 14 x 14 cells, got 12 x 12"):
        PoseSolver(LATTICE)(features, embeddings, places, valid)
