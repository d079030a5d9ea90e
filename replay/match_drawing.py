"""What is drawn of a match, in a picture as in a recording: levels, histograms, and its pieces of map before and after.

Places are in lifted axes at the initial pose unless said otherwise: x forward, y left, m. What the sensors saw stays
where it is; the map moves, from where the initial pose puts it to where the estimate does.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovm.batch import SURFEL
from egovm.config import BevConfig
from egovm.lattice import candidates, compose, seen_from
from egovm.map_elements import Pieces
from egovm.match import Match
from egovm.pose_solver import LevelEstimate, PoseEstimate
from sensors.frames import Frame
from sensors.maps.vector_map import Kind
from sensors.motion import Motion, Standing

Floats = NDArray[np.float64]

COLOURS: Mapping[int, str] = {
    Kind.LANE_LINE: "#56b4e9",
    Kind.ROAD_BOUNDARY: "#e69f00",
    Kind.STOP_LINE: "#cc79a7",
    Kind.CROSSING: "#00b583",
    Kind.MARKING: "#f0e442",
    Kind.POLE: "#ffffff",
    Kind.SIGN: "#e8612c",
    SURFEL: "#8c939c",
}
"""By type of a piece, before a dark ground; told apart by those who are colour-blind as well (Okabe and Ito)."""
AGAINST, NEUTRAL, FOR = "#ff9d2e", "#7d858f", "#3fb4ff"
"""Of what a piece adds to the score: less than nothing, nothing, much."""
MOST_CELLS = 40_000
"""Principal components are taken of so many cells of a level at most."""
SPREAD = (1.0, 99.0)
"""Percentiles of a component that become dark and bright."""

BRIGHTEST = 99.9
"""Percentile of a semantic map's probabilities that is drawn in full colour."""


class Pictured(NamedTuple):
    """A match, and what is known beside it.

    bev: of the network's config; truth: (3,) map x, y m and yaw rad of the body at the match's time; frame: what was
    matched, for its images; motion: of the vehicle around it.
    """

    match: Match
    bev: BevConfig
    truth: Floats | None = None
    frame: Frame | None = None
    motion: Motion = Standing()  # noqa: RUF012 (frozen)


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


def kind_name(kind: int) -> str:
    """As it stands in a legend."""
    return "surfel" if kind == SURFEL else Kind(kind).name.lower().replace("_", " ")


def estimate_of(match: Match) -> PoseEstimate | None:
    """The network's; None where it was not run."""
    estimate = None if match.output is None else match.output.estimate
    return estimate if isinstance(estimate, PoseEstimate) else None


def offset_of(match: Match, pose: Floats) -> Floats:
    """(3,) a pose (map x, y m, yaw rad) as an offset on the body side of the initial one: the inverse of what the
    matcher does, exactly, under roll and pitch as well."""
    R = match.T_map_init[:2, :2]
    x, y = np.linalg.solve(R, pose[:2] - match.T_map_init[:2, 3])
    cosine, sine = np.linalg.solve(R, (np.cos(pose[2]), np.sin(pose[2])))
    return np.array((x, y, np.arctan2(sine, cosine)))


def estimated_offset(match: Match) -> Floats:
    """(3,) of the pose that was found; 0 where none was."""
    return offset_of(match, match.pose)


def ends_at(pieces: Pieces, offset: Floats) -> Floats:
    """(K, 2, 3) ends of the pieces in lifted axes at an offset (3,) from the initial pose, z above the plane."""
    ends = torch.from_numpy(pieces.ends.astype(np.float64))
    xy: Floats = seen_from(torch.from_numpy(offset), ends[..., :2]).numpy()
    return np.concatenate((xy, pieces.ends[..., 2:]), axis=-1)


def points_of(match: Match) -> Floats | None:
    """(P, 4) x, y, z m and intensity 0..1 of what the network saw; None without LiDAR."""
    points = None if match.batch is None else match.batch.points
    return None if points is None else np.column_stack((array(points.xyz), array(points.intensity)))


def planes_of(match: Match) -> list[Floats]:
    """BEV features (C, H, W) of each level; none where the network was not run."""
    return [] if match.output is None else [array(level[0]) for level in match.output.bev]


def basis_of(planes: Sequence[Floats]) -> Basis:
    """The principal components of the features (C, H, W) of one level of some frames.

    An axis points where its largest loading is positive, so that frames like each other look like each other; frames of
    one recording share one basis.
    """
    rows = np.concatenate([plane.reshape(len(plane), -1).T for plane in planes])
    rows = rows[:: max(len(rows) // MOST_CELLS, 1)]
    mean = rows.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov(rows - mean, rowvar=False))
    axes = axes[:, ::-1][:, :3]
    axes = axes * np.sign(np.take_along_axis(axes, np.abs(axes).argmax(axis=0)[None], 0))
    low, high = np.percentile((rows - mean) @ axes, SPREAD, axis=0)
    return Basis(mean, axes, low, np.maximum(high, low + 1e-9))


def coloured(plane: Floats, basis: Basis) -> NDArray[np.uint8]:
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


def rgb(colour: str) -> tuple[int, int, int]:
    """0..255 of #rrggbb."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


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
    step, reach = lattice.step_m(number), lattice.reach + 2
    grid = np.arange(-reach, reach + 1) * step
    begin = array(centre)
    xy = _shared_out((offsets[:, :2] - begin[:2]) / step + reach, p.ravel(), len(grid))
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


def sigmas(match: Match) -> Floats:
    """(3,) that are stated: longitudinal and lateral at the pose that was found, m, and yaw, rad."""
    if not match.found:
        return np.full(3, np.inf)
    c, s = np.cos(match.pose[2]), np.sin(match.pose[2])
    axes = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    return np.sqrt(np.diagonal(axes.T @ match.cov @ axes))


def error_of(match: Match, truth: Floats) -> Floats:
    """(3,) forward and left, m, in the axes of the true heading, and yaw, rad: of the pose that was found."""
    c, s = np.cos(truth[2]), np.sin(truth[2])
    (x, y), yaw = match.pose[:2] - truth[:2], match.pose[2] - truth[2]
    return np.array((c * x + s * y, c * y - s * x, np.arctan2(np.sin(yaw), np.cos(yaw))))


def array(values: Tensor) -> Floats:
    """In float64, for drawing."""
    return values.detach().double().cpu().numpy()
