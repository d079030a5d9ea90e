"""The pose solver against sampling at every candidate, its gradients, and its operator."""

import math

import pytest
import torch
from torch import Tensor

from egovm.config import LatticeConfig
from egovm.lattice import candidates
from egovm.pose_solver import PoseSolver
from egovm.solver_dots import gathered_dots, patch_dots
from egovm.solver_sums import can_sum
from egovm.solver_window import (
    dot_window,
    dots_at,
    gathered_lattice_dots,
    in_window,
    lattice_dots,
    summed_lattice_dots,
)
from tests.egovm.reference_solver import lattice_poses, solve, solve_level, vector
from tests.egovm.solver_inputs import inputs

LATTICE = LatticeConfig()
SMALL = LatticeConfig(half_m=1.0, half_deg=2.0, steps=5, levels=2)


def cells_of(lattice: LatticeConfig) -> tuple[float, ...]:
    return tuple(lattice.step_m(level) for level in range(lattice.levels))


@pytest.mark.parametrize("points", [1, 2])
def test_it_equals_sampling_at_every_candidate(points: int) -> None:
    features, embeddings, places, valid = inputs(LATTICE, 2, 24, points)
    with torch.no_grad():
        found = PoseSolver(LATTICE)(features, embeddings, places, valid)
    for b in range(2):
        one = [each[b] for each in features], [each[b] for each in embeddings], places[b], valid[b]
        offset, levels = solve(*one, cells_of(LATTICE))
        assert torch.allclose(found.offset[b], offset, atol=1e-9, rtol=0)
        for ours, theirs in zip(found.levels, levels, strict=True):
            assert torch.equal(ours.window.valid[b], theirs.used)
            assert 0 < int(ours.landmarks[b]) == int(theirs.used.sum()) < 24
            assert torch.allclose(ours.log_p[b], theirs.log_p, atol=1e-9, rtol=0)
            assert torch.allclose(ours.mean[b], theirs.mean, atol=1e-9, rtol=0)  # the goal is 1e-5 m and rad
            assert torch.allclose(ours.cov[b], theirs.cov, atol=1e-10, rtol=0)  # the goal is 1e-6


def test_tau_and_alpha_are_those_of_the_score() -> None:
    features, embeddings, places, valid = inputs(LATTICE, 1, 10)
    solver = PoseSolver(LATTICE, alpha=0.5)
    with torch.no_grad():
        solver.tau[0] = 0.7
        found = solver(features, embeddings, places, valid).levels[0]
    theirs = solve_level(
        features[0][0], embeddings[0][0], places[0], valid[0], 0.5, lattice_poses(0), math.exp(0.7), 0.5
    )
    assert torch.allclose(found.scores[0], theirs.scores, atol=1e-6, rtol=0)  # tau is float32


def test_maps_that_are_not_square() -> None:
    features, embeddings, places, valid = inputs(SMALL, 1, 20, cells=32, half_m=7.0)
    wide = features[0][:, :, :20]
    window = dot_window(SMALL, 0, wide, embeddings[0], places, valid)
    theirs = solve_level(wide[0], embeddings[0][0], places[0], valid[0], 0.5, lattice_poses(0, 1.0, 2.0, 5), 1.0, 0.0)
    assert torch.equal(window.valid[0], theirs.used)
    assert 0 < int(theirs.used.sum()) < 20
    assert torch.allclose(summed_lattice_dots(window)[0], theirs.scores, atol=1e-10)


@pytest.mark.parametrize("x", [-6.75, -6.5, 6.5, 6.75])
def test_places_on_the_very_edge_of_what_is_inside(x: float) -> None:
    """40 cells of 0.5 m: the outermost middles at 9.75 m, less the 3 m of translation, is 6.75 m."""
    features, embeddings, _, _ = inputs(LATTICE, 1, 1)
    flat = LatticeConfig(half_deg=1e-9)
    window = dot_window(flat, 0, features[0], embeddings[0], torch.tensor([[[[x, x]]]]).double(), torch.ones(1, 1) > 0)
    poses = lattice_poses(0, 3.0, 1e-9)
    place = torch.tensor([[[x, x]]]).double()
    theirs = solve_level(features[0][0], embeddings[0][0], place, torch.ones(1) > 0, 0.5, poses)
    if window.valid.all():
        assert torch.allclose(lattice_dots(window)[0, 0, 0], theirs.scores, atol=1e-6)
    assert window.valid.all() or abs(x) == 6.75  # there the last bit of a rotation decides


def test_float32_is_close_to_float64() -> None:
    features, embeddings, places, valid = inputs(LATTICE, 1, 24)
    solver = PoseSolver(LATTICE)
    with torch.no_grad():
        exact = solver(features, embeddings, places, valid)
        short = solver([f.float() for f in features], [e.float() for e in embeddings], places.float(), valid)
        with torch.autocast("cpu", torch.bfloat16):
            mixed = solver([f.bfloat16() for f in features], [e.float() for e in embeddings], places.float(), valid)
    assert short.offset.dtype == mixed.offset.dtype == mixed.levels[2].cov.dtype == torch.float32
    assert torch.allclose(short.offset.double(), exact.offset, atol=1e-5, rtol=0)
    rounded = solver([f.bfloat16().float() for f in features], [e.float() for e in embeddings], places.float(), valid)
    assert torch.equal(mixed.offset, rounded.offset)


@pytest.mark.parametrize("points", [1, 2])
def test_any_pose_of_the_window_is_scored_as_the_candidates_are(points: int) -> None:
    features, embeddings, places, valid = inputs(LATTICE, 2, 12, points)
    solver = PoseSolver(LATTICE)
    found = solver(features, embeddings, places, valid).levels[1]
    offsets = candidates(LATTICE, 1, places).flatten(0, 2)
    assert in_window(LATTICE, 1, offsets).all()
    assert not in_window(LATTICE, 1, 1.01 * offsets[:1]).any()
    scores = solver.scores_at(found.window, offsets.expand(2, -1, -1))
    assert torch.allclose(scores, found.scores.flatten(1), atol=1e-9)


def test_contributions_add_up_to_the_score_at_the_mean() -> None:
    features, embeddings, places, valid = inputs(LATTICE, 1, 12)
    solver = PoseSolver(LATTICE)
    found = solver(features, embeddings, places, valid).levels[0]
    at_mean = solver.scores_at(found.window, found.mean[:, None])[:, 0]
    assert torch.allclose(found.contribution.sum(1), at_mean)
    assert (found.contribution[~found.window.valid] == 0).all()
    without = valid.clone()
    without[0, dropped := int(found.contribution[0].argmax())] = False
    rest = solver(features, embeddings, places, without).levels[0]
    scale = float(rest.landmarks) / float(found.landmarks)
    left = scale * solver.scores_at(rest.window, found.mean[:, None])[:, 0]
    assert torch.allclose(at_mean - left, found.contribution[:, dropped])


def small_sums(features: Tensor, embeddings: Tensor, places: Tensor, groups: int) -> Tensor:
    window = dot_window(SMALL, 0, features, embeddings, places, torch.ones(places.shape[:2]) > 0, groups)
    return torch.cat((lattice_dots(window).flatten(), summed_lattice_dots(window).flatten()))


@pytest.mark.parametrize("groups", [1, 2])
def test_gradients_of_the_dots(groups: int) -> None:
    draw = torch.Generator().manual_seed(3)
    features = torch.randn(1, 4, 12, 12, generator=draw, dtype=torch.float64, requires_grad=True)
    embeddings = torch.randn(1, 3, 4, generator=draw, dtype=torch.float64, requires_grad=True)
    places = torch.rand(1, 3, 2, 2, generator=draw, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda *given: small_sums(*given, groups), (features, embeddings, places), fast_mode=True
    )


def test_gradients_of_the_estimate() -> None:
    draw = torch.Generator().manual_seed(4)
    features = [torch.randn(1, 2, n, n, generator=draw, dtype=torch.float64, requires_grad=True) for n in (12, 24)]
    embeddings = [torch.randn(1, 3, 2, generator=draw, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    places = torch.rand(1, 3, 2, generator=draw, dtype=torch.float64).requires_grad_()
    solver = PoseSolver(SMALL).double()

    def moments(tau: Tensor, *given: Tensor) -> tuple[Tensor, ...]:
        """The later level's centre is detached, so it is held."""
        centres = (torch.zeros(1, 3).double(), torch.tensor([[0.1, -0.2, 0.01]]).double())
        solver.__dict__["tau"] = tau
        levels = [
            solver.level(each, given[each], given[2 + each], given[4][:, :, None], torch.ones(1, 3) > 0, centres[each])
            for each in range(2)
        ]
        offset = torch.tensor([[[0.11, -0.07, 0.013]]]).double()
        return tuple(x for each in levels for x in (each.mean, each.cov, solver.scores_at(each.window, offset)))

    tau = torch.tensor([0.3, -0.2]).double().requires_grad_()
    del solver._parameters["tau"]
    assert torch.autograd.gradcheck(moments, (tau, *features, *embeddings, places), fast_mode=True)


def test_gradients_against_the_reference() -> None:
    """Not only against themselves: the derivative of the reference's mean by the features and embeddings."""
    features, embeddings, places, valid = inputs(LATTICE, 1, 6)
    plane, embedding = features[0].requires_grad_(), embeddings[0].requires_grad_()
    solver = PoseSolver(LATTICE)
    ours = solver.level(0, plane, embedding, places, valid, torch.zeros(1, 3).double())
    given = torch.autograd.grad(ours.mean.sum() + ours.cov.sum(), (plane, embedding))
    theirs = solve_level(plane[0], embedding[0], places[0], valid[0], 0.5, lattice_poses(0))
    wanted = torch.autograd.grad(theirs.mean.sum() + theirs.cov.sum(), (plane, embedding))
    assert given[0].abs().max() > 0
    for a, b in zip(given, wanted, strict=True):
        assert torch.allclose(a, b, atol=1e-10)


@pytest.mark.parametrize("groups", [1, 3])
def test_the_kernel_and_torch_agree(groups: int) -> None:
    features, embeddings, _, valid = inputs(SMALL, 2, 150, cells=20, half_m=4.0)
    plane = features[0].permute(0, 2, 3, 1)
    corners = torch.randint(0, 20 - 8, (2, 150, 2), generator=torch.Generator().manual_seed(1))
    given = [plane.requires_grad_(), embeddings[0].requires_grad_()]
    weight = torch.randn(2, 150, groups, 8, 8, generator=torch.Generator().manual_seed(2)).double()
    results = []
    for dots in (patch_dots, gathered_dots):
        found = dots(*given, corners, valid, 8, groups)
        results.append((found, *torch.autograd.grad((weight * found).sum(), given)))
    for a, b in zip(*results, strict=True):
        assert a.abs().max() > 0
        assert torch.allclose(a, b, atol=1e-12)


@pytest.mark.parametrize("groups", [1, 3])
def test_features_that_are_no_float_go_through_torch(groups: int) -> None:
    """As features on other devices do: the operator's own way there, forward and backward, against autograd's."""
    features, embeddings, _, valid = inputs(SMALL, 2, 150, cells=20, half_m=4.0)
    plane = features[0].permute(0, 2, 3, 1).bfloat16().requires_grad_()
    given = [plane, embeddings[0].float().requires_grad_()]
    corners = torch.randint(0, 20 - 8, (2, 150, 2), generator=torch.Generator().manual_seed(1))
    weight = torch.randn(2, 150, groups, 8, 8, generator=torch.Generator().manual_seed(2))
    results = []
    for dots, first in ((patch_dots, plane), (gathered_dots, plane.float())):
        found = dots(first, given[1], corners, valid, 8, groups)
        results.append((found, *torch.autograd.grad((weight * found).sum(), given)))
    for a, b, tolerance in zip(*results, (1e-5, 0.01, 1e-4), strict=True):  # the features' gradient is bfloat16
        assert a.dtype == b.dtype
        assert torch.allclose(a, b, atol=tolerance, rtol=tolerance)


def test_the_operator_keeps_torchs_rules() -> None:
    features, embeddings, _, valid = inputs(SMALL, 1, 3, cells=10)
    corners = torch.zeros(1, 3, 2, dtype=torch.int64)
    given = (features[0].permute(0, 2, 3, 1).detach().requires_grad_(), embeddings[0].requires_grad_())
    torch.library.opcheck(torch.ops.egovm.patch_dots.default, (*given, corners, valid, 8, 1))


def test_groups_go_through_their_h() -> None:
    features, embeddings, places, valid = inputs(LATTICE, 1, 70)
    torch.manual_seed(0)
    solver = PoseSolver(LATTICE, groups=2).double()
    found = solver(features, embeddings, places, valid).levels[0]
    flat = torch.stack([vector(pose) for pose in lattice_poses(0)])
    by_pose = solver.scores_at(found.window, flat[None])
    assert torch.allclose(by_pose, found.scores.flatten(1), atol=1e-9)
    halves = [
        dot_window(LATTICE, 0, features[0][:, s], embeddings[0][..., s], places, valid) for s in (slice(3), slice(3, 6))
    ]
    dots = torch.cat([dots_at(half, flat[None]) for half in halves], -1)
    alike = solver.similarity[0](dots)
    wanted = torch.where(found.window.valid[:, None], alike, 0.0).sum(-1) / found.landmarks
    assert torch.allclose(by_pose, wanted, atol=1e-9)


@pytest.mark.parametrize("groups", [1, 2])
def test_sums_by_the_kernel_are_those_of_torch(groups: int) -> None:
    """Of points that ask for the same as others, and of elements that are not used."""
    features, embeddings, places, valid = inputs(LATTICE, 2, 24, 2)
    places = places.clone()
    places[:, ::2, 1] = places[:, ::2, 0]
    for level in range(3):
        window = dot_window(LATTICE, level, features[level], embeddings[level], places, valid, groups)
        assert 0 < int(window.valid.sum()) < window.valid.numel()
        assert can_sum(window.dots, window.places)
        gathered = gathered_lattice_dots(window)
        assert gathered.abs().max() > 0.0
        assert torch.allclose(summed_lattice_dots(window), gathered, atol=1e-10, rtol=0)


def test_gradients_are_not_left_to_the_kernel() -> None:
    features, embeddings, places, valid = inputs(LATTICE, 1, 4)
    window = dot_window(LATTICE, 0, features[0].requires_grad_(), embeddings[0], places, valid)
    assert not can_sum(window.dots, window.places)
    assert summed_lattice_dots(window).requires_grad
    with torch.no_grad():
        assert can_sum(window.dots, window.places)


def test_features_in_sixteen_bits_are_read_as_they_are() -> None:
    """By the kernel, the dots of the numbers that they are rounded to."""
    draw = torch.Generator().manual_seed(6)
    features = torch.randn(2, 20, 20, 16, generator=draw).bfloat16()
    embeddings, corners = torch.randn(2, 9, 16, generator=draw), torch.randint(0, 12, (2, 9, 2), generator=draw)
    valid = torch.rand(2, 9, generator=draw) < 0.7
    for groups in (1, 4):
        found = patch_dots(features, embeddings, corners, valid, 8, groups)
        expected = gathered_dots(features.double(), embeddings.double(), corners, valid, 8, groups)
        assert torch.allclose(found.double(), expected, atol=1e-5)


def test_points_that_ask_for_the_same_have_the_same_dots() -> None:
    """In any order; another embedding or another place is another point."""
    draw = torch.Generator().manual_seed(5)
    features = torch.randn(1, 20, 20, 8, generator=draw)
    corners = torch.tensor([[[3, 4], [9, 2], [3, 4], [3, 4], [9, 2], [3, 4], [0, 11]]])
    embeddings = torch.randn(1, 7, 8, generator=draw)
    embeddings[0, 2], embeddings[0, 5] = embeddings[0, 0], embeddings[0, 0]
    valid = torch.tensor([[True, True, True, True, True, False, True]])
    found = patch_dots(features, embeddings, corners, valid, 8)
    assert torch.allclose(found, gathered_dots(features, embeddings, corners, valid, 8, 1), atol=1e-5)
    assert torch.equal(found[0, 2], found[0, 0])
    assert not found[0, 5].any()
