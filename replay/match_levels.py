"""What each level of a match's network made of a frame: colours of features and semantic maps, histograms, what each
piece of map adds to the score; and colours of points."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib import colormaps
from numpy.typing import NDArray
from torch import Tensor

from egovm.lattice import candidates, compose
from egovm.match import Match
from egovm.pose_solver import LevelEstimate, PoseEstimate
from replay.match_drawing import COLOURS, array, rgb

Floats = NDArray[np.float64]

MOST_CELLS = 40_000
"""Principal components are taken of so many cells of a level at most."""
SPREAD = (1.0, 99.0)
"""Percentiles of a component that become dark and bright."""
FULL_SHARE = 95.0
"""Percentile of the pieces' shares that is drawn in full colour."""
BRIGHTEST = 99.9
"""Percentile of a semantic map's probabilities that is drawn in full colour."""
SIGMAS = 2.0
"""Ellipses and bands are so many sigmas wide to each side."""
ABOVE_M = (-0.3, 4.0)
"""Heights above the ground that become dark and bright."""
HEIGHTS = "cividis"
DARKEST = 0.25
"""Of what the scales of points begin with, so that no point vanishes in the ground."""


class Basis(NamedTuple):
    """Features into colours. mean: (C,); axes: (C, 3) principal ones; low, high: (3,) what becomes dark and bright."""

    mean: Floats
    axes: Floats
    low: Floats
    high: Floats


class Histogram(NamedTuple):
    """A level's posterior, as offsets from the initial pose.

    xy: (n, n) mass by forward and left, at the places forward: (n,) and left: (n,) m; yaw_mass: (m,) at yaw: (m,) rad;
    mean: (3,) and cov: (3, 3), the stated one, infinite where nothing was found, in m, m, rad.
    """

    xy: Floats
    forward: Floats
    left: Floats
    yaw: Floats
    yaw_mass: Floats
    mean: Floats
    cov: Floats


class Share(NamedTuple):
    """percent: (K,) what a level's score would lose without each piece, in % of the sum of their sizes, NaN of pieces
    that it did not use; most: what is drawn in full colour."""

    percent: Floats
    most: float


def estimate_of(match: Match) -> PoseEstimate | None:
    """The network's; None where it was not run."""
    estimate = None if match.output is None else match.output.estimate
    return estimate if isinstance(estimate, PoseEstimate) else None


def planes_of(match: Match) -> list[NDArray[np.float32]]:
    """BEV features (C, H, W) of each level; none where the network was not run."""
    return [] if match.output is None else [level[0].detach().float().cpu().numpy() for level in match.output.bev]


def basis_of(planes: Sequence[NDArray[np.float32]]) -> Basis:
    """The principal components of the features (C, H, W) of one level of some frames.

    An axis points to where the features' tail is longer: what is rare is bright, and frames like each other look like
    each other. Frames of one recording share one basis.
    """
    rows = np.concatenate([plane.reshape(len(plane), -1).T for plane in planes])
    if len(rows) > MOST_CELLS:
        rows = rows[np.random.default_rng(0).choice(len(rows), MOST_CELLS, replace=False)]
    rows = rows.astype(np.float64)
    mean = rows.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov(rows, rowvar=False))
    along = (rows - mean) @ axes[:, :-4:-1]
    sign = np.where((along**3).sum(axis=0) < 0.0, -1.0, 1.0)
    low, high = np.percentile(sign * along, SPREAD, axis=0)
    return Basis(mean, sign * axes[:, :-4:-1], low, np.maximum(high, low + 1e-9))


def coloured(plane: NDArray[np.float32], basis: Basis) -> NDArray[np.uint8]:
    """(H, W, 3) the three components of features (C, H, W) as red, green and blue."""
    along = np.tensordot(basis.axes.T, plane - basis.mean[:, None, None], 1)
    shade = (along - basis.low[:, None, None]) / (basis.high - basis.low)[:, None, None]
    return np.rint(255.0 * shade.clip(0.0, 1.0)).transpose(1, 2, 0).astype(np.uint8)


def semantic_colours(logits: Tensor) -> tuple[NDArray[np.uint8], float]:
    """(H, W, 3) the likeliest kind of each cell in its colour, as bright as it is probable, and the probability of the
    brightest. logits: (kinds, H, W)."""
    probability = array(torch.sigmoid(logits))
    colours = np.array([rgb(COLOURS[kind]) for kind in range(len(probability))])
    best, most = probability.argmax(axis=0), probability.max(axis=0)
    brightest = float(np.percentile(most, BRIGHTEST))
    share = (most / max(brightest, 1e-9)).clip(max=1.0)
    return np.rint(colours[best] * share[..., None]).astype(np.uint8), brightest


def histograms(match: Match) -> list[Histogram]:
    """Of each level, coarse to fine; none where the network was not run."""
    estimate = estimate_of(match)
    if estimate is None:
        return []
    return [_histogram(level, match.levels[number]) for number, level in enumerate(estimate.levels)]


def _histogram(level: LevelEstimate, cov: Floats) -> Histogram:
    """Candidates of one yaw stand in rows that it turns; each one's mass is shared out among the four places around
    it, which leaves the mean where it is."""
    window = level.window
    lattice, number = window.lattice, window.level
    centre = level.centre[0].double()
    offsets = compose(centre, candidates(lattice, number, centre)).reshape(-1, 3).numpy()
    p = array(level.log_p[0].double().exp())
    begin, step = array(centre), lattice.step_m(number)
    places = (offsets[:, :2] - begin[:2]) / step
    reach = math.floor(np.abs(places).max()) + 1
    grid = np.arange(-reach, reach + 1) * step
    xy = _shared_out(places + reach, p.ravel(), len(grid))
    yaw = begin[2] + np.arange(-lattice.reach, lattice.reach + 1) * lattice.step_rad(number)
    mean = array(compose(centre, level.mean[0].double()))
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(begin[2]), -np.sin(begin[2])], [np.sin(begin[2]), np.cos(begin[2])]]
    turned = turn @ cov @ turn.T if np.isfinite(cov).all() else cov
    return Histogram(xy, begin[0] + grid, begin[1] + grid, yaw, p.sum(axis=(1, 2)), mean, turned)


def _shared_out(places: Floats, mass: Floats, side: int) -> Floats:
    """(side, side) masses (N,) at places (N, 2), in cells, by bilinear weights."""
    low = np.floor(places).astype(np.int64)
    part = places - low
    found = np.zeros((side, side))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weights = np.abs(1 - i - part[:, 0]) * np.abs(1 - j - part[:, 1])
        np.add.at(found, (low[:, 0] + i, low[:, 1] + j), mass * weights)
    return found


def shares(match: Match) -> list[Share]:
    """Of each level; none where the network was not run."""
    estimate = estimate_of(match)
    return [] if estimate is None else [_share(level, len(match.pieces)) for level in estimate.levels]


def _share(level: LevelEstimate, pieces: int) -> Share:
    used = level.window.valid[0, :pieces].cpu().numpy()
    added = array(level.contribution[0, :pieces])
    total = np.abs(added).sum()
    percent = np.where(used, 100.0 * added / total if total > 0.0 else added, np.nan)
    most = float(np.percentile(np.abs(percent[used]), FULL_SHARE)) if used.any() else 0.0
    return Share(percent, most if most > 0.0 else 1.0)


def ellipse(found: Histogram) -> Floats:
    """(N, 2) forward and left on the ellipse of the covariance."""
    angle = np.linspace(0.0, 2.0 * math.pi, 73)
    values, axes = np.linalg.eigh(found.cov[:2, :2])
    circle = np.stack((np.cos(angle), np.sin(angle)))
    around: Floats = (axes * np.sqrt(values.clip(min=0.0))) @ circle * SIGMAS
    return found.mean[:2] + around.T


def heights_shaded(height: Floats) -> Floats:
    """(N, 4) colours 0..1 of heights above the ground (N,) m."""
    low, high = ABOVE_M
    level = DARKEST + (1.0 - DARKEST) * ((height - low) / (high - low)).clip(0.0, 1.0)
    colours: Floats = np.asarray(colormaps[HEIGHTS](level))
    return colours
