"""The pose graph: slopes against finite differences, exact data, wrong loops, jumps, and honest covariances."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sensors.maps.pose_graph import MAP, Edges, Given, _linearized, solve

Floats = NDArray[np.float64]

SIGMA = np.array([0.002, 0.002, 0.005, 0.3, 0.3, 0.45])
EDGE = np.array([0.0003, 0.0003, 0.0002, 0.006, 0.006, 0.004])
STEP_S = 0.5


def circle(count: int, laps: float = 1.2) -> tuple[Floats, Floats]:
    """True poses on a circle of 30 m."""
    angle = np.linspace(0.0, 2 * np.pi * laps, count)
    p = np.column_stack((30.0 * np.cos(angle), 30.0 * np.sin(angle), np.sin(angle)))
    rotation = Rotation.from_euler("ZYX", np.column_stack((angle + np.pi / 2, 0.02 * np.sin(angle), 0 * angle)))
    return p, rotation.as_matrix()


def matrices(p: Floats, R: Floats) -> Floats:
    T = np.tile(np.eye(4), (len(p), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p
    return T


def measured(p: Floats, R: Floats, pairs: list[tuple[int, int]], noise: Floats) -> Edges:
    """Edges between true poses, noise (E, 6) on their right."""
    first, second = np.array(pairs, np.int64).T
    T = matrices(p, R)
    target = np.where((first == MAP)[:, None, None], np.eye(4), T[first])
    error = matrices(noise[:, 3:], Rotation.from_rotvec(noise[:, :3]).as_matrix())
    between = np.linalg.solve(target, T[second]) @ error
    return Edges(first, second, between, np.tile(np.diag(EDGE**2), (len(pairs), 1, 1)))


def drifted(p: Floats, R: Floats, rng: np.random.Generator, tau_s: float) -> Given:
    """Poses with Gauss-Markov errors."""
    phi = np.exp(-STEP_S / tau_s)
    unit = rng.normal(size=(len(p), 6))
    for k in range(1, len(p)):
        unit[k] = phi * unit[k - 1] + np.sqrt(1 - phi * phi) * unit[k]
    error = unit * SIGMA
    turned = Rotation.from_rotvec(error[:, :3]).as_matrix() @ R
    return Given(STEP_S * np.arange(len(p)), p + error[:, 3:], turned, np.tile(SIGMA, (len(p), 1)), tau_s)


def chain(count: int, loop: int | None = None) -> list[tuple[int, int]]:
    pairs = [(k - hop, k) for k in range(count) for hop in (1, 3) if hop <= k]
    return pairs + [(k - loop, k) for k in range(loop, count)] if loop else pairs


def turned_error(R: Floats, truth: Floats) -> Floats:
    return Rotation.from_matrix(R @ truth.transpose(0, 2, 1)).as_rotvec()


def test_slopes_agree_with_finite_differences() -> None:
    rng = np.random.default_rng(4)
    p, R = circle(6)
    edges = measured(p, R, [(0, 1), (2, 5), (MAP, 3)], 1e-3 * rng.normal(size=(3, 6)))
    _, at_first, at_second = _linearized(p, R, edges)
    step = 1e-6
    for axis in range(6):
        for slopes, nodes in ((at_first, edges.first), (at_second, edges.second)):
            for edge, node in enumerate(nodes):
                if node == MAP:
                    assert not slopes[edge].any()
                    continue
                difference = np.zeros(6)
                for sign in (1.0, -1.0):
                    q, S = p.copy(), R.copy()
                    delta = np.zeros(6)
                    delta[axis] = sign * step
                    q[node] += delta[3:]
                    S[node] = Rotation.from_rotvec(delta[:3]).as_matrix() @ S[node]
                    difference += sign * _linearized(q, S, edges)[0][edge] / (2 * step)
                # slopes are to first order in the residual, which is 1e-3
                assert np.abs(difference - slopes[edge][:, axis]).max() < 2e-3


def test_exact_edges_to_the_map_give_the_true_poses() -> None:
    p, R = circle(20)
    given = drifted(p, R, np.random.default_rng(1), 10.0)
    edges = measured(p, R, [(MAP, k) for k in range(20)], np.zeros((20, 6)))
    solution = solve(given, edges._replace(cov=edges.cov * 1e-6))
    assert np.abs(solution.p - p).max() < 1e-4
    assert np.abs(turned_error(solution.R, R)).max() < 1e-5
    assert solution.iterations < 12


def test_exact_edges_between_poses_give_the_true_shape() -> None:
    p, R = circle(60)
    given = drifted(p, R, np.random.default_rng(2), 5.0)
    pairs = chain(60)
    edges = measured(p, R, pairs, np.zeros((len(pairs), 6)))
    solution = solve(given, edges._replace(cov=edges.cov * 1e-6))
    assert np.abs(given.p - p).max() > 0.5
    steps, true_steps = np.linalg.norm(np.diff(solution.p, axis=0), axis=1), np.linalg.norm(np.diff(p, axis=0), axis=1)
    assert np.abs(steps - true_steps).max() < 1e-4


def test_wrong_loops_are_weighed_down_and_good_ones_are_not() -> None:
    rng = np.random.default_rng(3)
    count, loop = 120, 100
    p, R = circle(count)
    pairs = chain(count, loop)
    noise = rng.normal(size=(len(pairs), 6)) * EDGE
    wrong = [len(pairs) - 3, len(pairs) - 9]
    noise[wrong, 3:] += [3.0, -2.0, 0.0]
    solution = solve(drifted(p, R, rng, 10.0), measured(p, R, pairs, noise))
    assert (solution.weight[wrong] < 0.01).all()
    assert (np.delete(solution.weight, wrong) < 0.5).sum() == 0
    centred = (solution.p - solution.p.mean(axis=0)) - (p - p.mean(axis=0))
    assert np.linalg.norm(centred[:, :2], axis=1).max() < 0.25


def test_a_jump_of_the_given_trajectory_does_not_cost_good_edges() -> None:
    count = 80
    p, R = circle(count)
    rng = np.random.default_rng(5)
    given = drifted(p, R, rng, 10.0)
    given.p[40:] += [1.5, 1.0, 0.0]
    pairs = chain(count)
    solution = solve(given, measured(p, R, pairs, rng.normal(size=(len(pairs), 6)) * EDGE))
    assert (solution.weight > 0.5).all()
    steps, true_steps = np.diff(solution.p, axis=0), np.diff(p, axis=0)
    assert np.abs(np.linalg.norm(steps, axis=1) - np.linalg.norm(true_steps, axis=1)).max() < 0.05


def test_a_single_pose_and_no_edges_keep_the_prior() -> None:
    p, R = circle(1)
    given = drifted(p, R, np.random.default_rng(6), 10.0)
    alone = Edges(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 4, 4)), np.empty((0, 6, 6)))
    solution = solve(given, alone)
    np.testing.assert_allclose(solution.p, given.p, atol=1e-12)
    np.testing.assert_allclose(solution.cov[0], np.diag(SIGMA**2), rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("to_map", [False, True])
def test_covariances_are_honest(to_map: bool) -> None:
    """Mean NEES of single poses over seeded runs, within its 99.9 % bounds (6 degrees of freedom)."""
    rng = np.random.default_rng(77 + to_map)
    runs, count, loop = 60, 60, 45
    p, R = circle(count, 1.4)
    pairs = chain(count, loop) + ([(MAP, k) for k in range(0, count, 7)] if to_map else [])
    nees = []
    for _ in range(runs):
        noise = rng.normal(size=(len(pairs), 6)) * EDGE
        solution = solve(drifted(p, R, rng, 10.0), measured(p, R, pairs, noise))
        node = int(rng.integers(count))
        error = np.concatenate((turned_error(solution.R, R)[node], solution.p[node] - p[node]))
        nees.append(error @ np.linalg.solve(solution.cov[node], error))
    spread = np.sqrt(2.0 * 6.0 / runs)
    assert abs(np.mean(nees) - 6.0) < 3.3 * spread
