"""A pose graph: corrections of a given trajectory from registrations, Gauss-Newton on SE(3).

The given poses err by a Gauss-Markov process: of known size, and forgotten over a correlation time. A registration
says where a pose lies in another, or in the map. Robust weights are Dynamic Covariance Scaling (Agarwal et al., Robust
map optimization using dynamic covariance scaling, ICRA 2013), after a first solution without any, so that a large but
common error is not taken for many wrong registrations.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MAP = -1
"""As the first node of an edge: the map itself."""
CHI2_6_999 = 22.46
"""An edge with a larger squared residual is weighed down: 99.9 % of good ones are below (6 degrees of freedom)."""
PLAIN, MOST = 4, 30
"""Iterations without robust weights, and at most."""
DONE = 1e-5
"""Largest step that ends the iteration, rad or m."""
MARGINALS = 120
"""Nodes whose covariance is computed; between them it is interpolated."""


class Given(NamedTuple):
    """Poses to correct. t_s: (N,) rising; p: (N, 3) m; R: (N, 3, 3); sigma: (N, 6) rad, m: rotation and translation
    in map axes; correlation_s: over which an error is forgotten, s."""

    t_s: Floats
    p: Floats
    R: Floats
    sigma: Floats
    correlation_s: float


class Edges(NamedTuple):
    """Node second lies at T (E, 4, 4) in node first, or in the map where first is MAP; cov: (E, 6, 6) of T Exp(.)."""

    first: Ints
    second: Ints
    T: Floats
    cov: Floats


class Solution(NamedTuple):
    """p: (N, 3), R: (N, 3, 3) corrected; cov: (N, 6, 6) rotation rad, translation m in map axes; weight: (E,) of each
    edge, 1: taken as it is; iterations."""

    p: Floats
    R: Floats
    cov: Floats
    weight: Floats
    iterations: int


def solve(given: Given, edges: Edges) -> Solution:
    """The most probable poses."""
    p, R = given.p.copy(), given.R.copy()
    root = np.linalg.cholesky(np.linalg.inv(edges.cov)).transpose(0, 2, 1) if len(edges.T) else np.empty((0, 6, 6))
    weight = np.ones(len(edges.T))
    for iteration in range(1, MOST + 1):
        residual, at_first, at_second = _linearized(p, R, edges)
        residual, at_first, at_second = (root @ part for part in (residual[:, :, None], at_first, at_second))
        if iteration > PLAIN:
            weight = _weights((residual[:, :, 0] ** 2).sum(axis=1))
        factor, gradient = _factor(given, p, R, edges, (residual[:, :, 0], at_first, at_second), weight)
        step = -factor.solve(gradient).reshape(-1, 6)
        p = p + step[:, 3:]
        R = Rotation.from_rotvec(step[:, :3]).as_matrix() @ R
        if iteration > PLAIN + 1 and np.abs(step).max(initial=0.0) < DONE:
            break
    return Solution(p, R, _marginals(factor, len(p)), weight, iteration)


def _linearized(p: Floats, R: Floats, edges: Edges) -> tuple[Floats, Floats, Floats]:
    """(E, 6) residuals, and (E, 6, 6) their slopes by rotation and translation, in map axes, of either node.

    Of the error Z^-1 T_first^-1 T_second its rotation vector and translation, slopes to first order in it.
    """
    world = edges.first == MAP
    R_i = np.where(world[:, None, None], np.eye(3), R[edges.first])
    p_i = np.where(world[:, None], 0.0, p[edges.first])
    R_j, R_z = R[edges.second], edges.T[:, :3, :3]
    between = p[edges.second] - p_i
    to_z = (R_i @ R_z).transpose(0, 2, 1)
    residual = np.empty((len(edges.T), 6))
    residual[:, :3] = Rotation.from_matrix(to_z @ R_j).as_rotvec()
    residual[:, 3:] = (to_z @ between[:, :, None] - R_z.transpose(0, 2, 1) @ edges.T[:, :3, 3:])[:, :, 0]
    at_first, at_second = np.zeros((2, len(edges.T), 6, 6))
    at_second[:, :3, :3] = R_j.transpose(0, 2, 1)
    at_second[:, 3:, 3:] = to_z
    at_first[:, :, :] = -at_second
    at_first[:, 3:, :3] = to_z @ _cross(between)
    at_first[world] = 0.0
    return residual, at_first, at_second


def _weights(squared: Floats) -> Floats:
    """(E,) Dynamic Covariance Scaling of squared residuals."""
    scale = np.minimum(1.0, 2.0 * CHI2_6_999 / (CHI2_6_999 + squared))
    return scale * scale


class _Factor:
    """Factored normal equations, nodes in Cuthill-McKee order: laps over the same road then lie side by side in a
    narrow band (SuperLU's own orderings take 30 times as long for a drive of three laps)."""

    def __init__(self, normal: csc_matrix) -> None:
        nodes = normal[::6, ::6].tocsr()
        order = reverse_cuthill_mckee(nodes, symmetric_mode=True).astype(np.int64)
        self._rows = (6 * order[:, None] + np.arange(6)).ravel()
        banded = normal[self._rows][:, self._rows].tocsc()
        self._factor = splu(banded, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def solve(self, right: Floats) -> Floats:
        """(6 N,) or (6 N, C) solution."""
        found = np.empty_like(right)
        found[self._rows] = self._factor.solve(right[self._rows])
        return found


def _factor(
    given: Given, p: Floats, R: Floats, edges: Edges, whitened: tuple[Floats, Floats, Floats], weight: Floats
) -> tuple[_Factor, Floats]:
    """The factored normal equations, and the gradient (6 N,)."""
    residual, at_first, at_second = whitened
    count = len(p)
    held = edges.first != MAP
    first, second = edges.first[held], edges.second
    a, b = at_first * weight[:, None, None], at_second * weight[:, None, None]
    blocks = [
        (second, second, at_second.transpose(0, 2, 1) @ b),
        (first, first, (at_first.transpose(0, 2, 1) @ a)[held]),
        (first, second[held], (at_first.transpose(0, 2, 1) @ b)[held]),
        (second[held], first, (at_second.transpose(0, 2, 1) @ a)[held]),
    ]
    gradient = np.zeros((count, 6))
    np.add.at(gradient, second, np.einsum("eij,ei->ej", b, residual))
    np.add.at(gradient, first, np.einsum("eij,ei->ej", a, residual)[held])
    error = np.hstack((Rotation.from_matrix(R @ given.R.transpose(0, 2, 1)).as_rotvec(), p - given.p))
    prior, slope = _gauss_markov(given, error)
    normal = _assembled(blocks, count) + prior
    return _Factor(normal), (gradient + slope).ravel()


def _gauss_markov(given: Given, error: Floats) -> tuple[csc_matrix, Floats]:
    """Information (6 N, 6 N) and gradient (N, 6) of errors (N, 6) as a Gauss-Markov process.

    In units of sigma: the first is N(0, 1), each next phi times the one before plus N(0, 1 - phi^2).
    """
    unit = error / given.sigma
    phi = np.exp(-np.diff(given.t_s) / given.correlation_s)[:, None]
    gain = 1.0 / (1.0 - phi * phi)
    innovation = gain * (unit[1:] - phi * unit[:-1])
    slope = np.zeros_like(unit)
    slope[0] = unit[0]
    slope[1:] += innovation
    slope[:-1] -= phi * innovation
    diagonal = np.zeros_like(unit)
    diagonal[0] = 1.0
    diagonal[1:] += gain
    diagonal[:-1] += phi * phi * gain
    beside = -(phi * gain) / (given.sigma[1:] * given.sigma[:-1])
    rows = np.arange(unit.size)
    every = np.concatenate((rows, rows[6:], rows[:-6]))
    other = np.concatenate((rows, rows[:-6], rows[6:]))
    values = np.concatenate(((diagonal / given.sigma**2).ravel(), beside.ravel(), beside.ravel()))
    return coo_matrix((values, (every, other)), shape=(unit.size, unit.size)).tocsc(), slope / given.sigma


def _assembled(blocks: list[tuple[Ints, Ints, Floats]], count: int) -> csc_matrix:
    """Sum of 6 x 6 blocks (row node, column node, values) as a sparse matrix."""
    inner = np.arange(6)
    rows = np.concatenate(
        [np.broadcast_to((6 * i)[:, None, None] + inner[:, None], b.shape).ravel() for i, _, b in blocks]
    )
    columns = np.concatenate([np.broadcast_to((6 * j)[:, None, None] + inner, b.shape).ravel() for _, j, b in blocks])
    values = np.concatenate([block.ravel() for _, _, block in blocks])
    return coo_matrix((values, (rows, columns)), shape=(6 * count, 6 * count)).tocsc()


def _marginals(factor: _Factor, count: int) -> Floats:
    """(N, 6, 6) covariances: diagonal blocks of the inverse, at most MARGINALS of them, linear in between."""
    nodes = np.unique(np.linspace(0, count - 1, min(count, MARGINALS)).round().astype(np.int64))
    found = np.empty((len(nodes), 6, 6))
    for k, node in enumerate(nodes):
        unit = np.zeros((6 * count, 6))
        unit[6 * node : 6 * node + 6] = np.eye(6)
        found[k] = factor.solve(unit)[6 * node : 6 * node + 6]
    right = np.clip(np.searchsorted(nodes, np.arange(count)), 1 if len(nodes) > 1 else 0, len(nodes) - 1)
    left = np.maximum(right - 1, 0)
    share = (np.arange(count) - nodes[left]) / np.maximum(nodes[right] - nodes[left], 1)
    between: Floats = found[left] + share[:, None, None] * (found[right] - found[left])
    return between


def _cross(v: Floats) -> Floats:
    """(N, 3, 3) matrices of the product v x . of (N, 3)."""
    zero = np.zeros(len(v))
    x, y, z = v.T
    matrices: Floats = np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=-1).reshape(-1, 3, 3)
    return matrices
