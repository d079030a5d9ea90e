"""What one frame says of the pose: Match, read off the network's estimate.

The pose is T_init dT, six degrees of which a match decides three: x, y and yaw. The covariance is the last level's,
along directions in which a coarser level was flat that one's as well (``sensors.histogram``), in map axes.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovm.batch import Batch
from egovm.config import LatticeConfig
from egovm.dataset import planar
from egovm.lattice import candidates
from egovm.map_elements import Pieces
from egovm.network import Output
from egovm.pose_solver import PoseEstimate
from sensors.histogram import stated_covariance
from sensors.records import PoseFix

Floats = NDArray[np.float64]

NO_LANDMARKS = "no landmarks"
NO_DATA = "no points and no images"


class Answer(NamedTuple):
    """Fields of a Match that are the same for all frames of which nothing is found."""

    reason: str
    T_map_body: Floats
    cov: Floats
    modes: Floats
    weights: Floats
    levels: Floats
    landmarks: NDArray[np.int64]
    contribution: Floats


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Match:
    """What a frame says of the pose of the body at t_ns.

    reason: why there is no fix, "" where there is one; without a fix the pose is the initial one, and the covariance
    infinite on its diagonal.
    T_map_init: (4, 4) where the search began, T_map_body: (4, 4) where it ended; cov: (3, 3) in (m, m, rad), map axes;
    modes: (2, 3) the two strongest modes of the first level's histogram as map x, map y m, yaw rad, the stronger first,
    NaN where there is none; weights: (2,) their masses.
    levels: (L, 3, 3) covariances in body axes at the levels' centres; landmarks: (L,) pieces of map that each level
    used; contribution: (K,) what the last level's score would lose without each piece; seconds: of all of it.
    pieces: of map, in lifted axes (``frame_inputs``) at the initial pose; T_body_lifted: (4, 4). batch, output: what
    went into the network and came out of it, one frame; None where it was not run.
    """

    t_ns: int
    arrival_ns: int
    reason: str
    T_map_init: Floats
    T_map_body: Floats
    cov: Floats
    modes: Floats
    weights: Floats
    levels: Floats
    landmarks: NDArray[np.int64]
    contribution: Floats
    seconds: float
    T_body_lifted: Floats
    pieces: Pieces
    batch: Batch | None
    output: Output | None

    @property
    def found(self) -> bool:
        """Whether there is a fix."""
        return not self.reason

    @property
    def pose(self) -> Floats:
        """(3,) map x m, map y m, yaw rad."""
        return planar_of(self.T_map_body)

    @property
    def left_out(self) -> int:
        """Pieces of map beyond the network's limit."""
        return self.pieces.left_out

    def fix(self) -> PoseFix:
        """One row; none where there is no fix. It arrives when the frame does."""
        rows = slice(0, int(self.found))
        t_ns, arrival_ns = np.array([self.t_ns], np.int64), np.array([self.arrival_ns], np.int64)
        columns = self.pose[None], self.cov[None], self.modes[None], self.weights[None]
        return PoseFix(t_ns[rows], arrival_ns[rows], *(column[rows] for column in columns))


def planar_of(T_map_body: Floats) -> Floats:
    """(3,) map x m, map y m, yaw rad of a pose (4, 4)."""
    return np.array((T_map_body[0, 3], T_map_body[1, 3], np.arctan2(T_map_body[1, 0], T_map_body[0, 0])))


def nothing(reason: str, T_map_init: Floats, levels: int, pieces: int) -> Answer:
    """No fix."""
    unknown = np.diag(np.full(3, np.inf))
    none = np.full((2, 3), np.nan), np.zeros(2), np.repeat(unknown[None], levels, axis=0), np.zeros(levels, np.int64)
    return Answer(reason, T_map_init, unknown, *none, np.zeros(pieces))


def answer_of(estimate: PoseEstimate, T_map_init: Floats, T_body_lifted: Floats, lattice: LatticeConfig) -> Answer:
    """What the estimate of one frame says. Its offsets are of the lifted axes."""
    found = bool(estimate.found[0])
    landmarks = np.array([int(level.landmarks[0]) for level in estimate.levels], np.int64)
    contribution = _array(estimate.levels[-1].contribution[0])
    if not found:
        empty = nothing(NO_LANDMARKS, T_map_init, len(landmarks), len(contribution))
        return empty._replace(landmarks=landmarks, contribution=contribution)
    offsets = np.concatenate((_array(estimate.offset[0])[None], _array(estimate.modes[0])))
    T_map_lifted, T_lifted_body = T_map_init @ T_body_lifted, np.linalg.inv(T_body_lifted)
    T = [T_map_lifted @ planar(offset) @ T_lifted_body for offset in offsets]
    weights = _array(estimate.weights[0])
    weights = weights / max(weights.sum(), 1.0)  # float32
    modes = np.where(weights[:, None] > 0.0, [planar_of(mode) for mode in T[1:]], np.nan)
    raw = np.stack([_array(level.cov[0]) for level in estimate.levels])
    levels = raw
    yaw = planar_of(T_map_lifted)[2] + np.array([float(level.centre[0, 2]) for level in estimate.levels])
    R = np.stack([planar(np.array((0.0, 0.0, angle)))[:3, :3] for angle in yaw])
    cov = _stated(R @ raw @ R.transpose(0, 2, 1), R[-1] @ levels[-1] @ R[-1].T, lattice)
    return Answer("", T[0], cov, modes, weights, levels, landmarks, contribution)


def _stated(raw: Floats, last: Floats, lattice: LatticeConfig) -> Floats:
    """(3, 3) the last level's calibrated covariance, and what levels that were flat add to it.

    raw: (L, 3, 3) of the histograms: they show which are flat.
    """
    flat = [
        candidates(lattice, level, torch.zeros((), dtype=torch.float64)).flatten(0, 2).std(0, correction=0).numpy()
        for level in range(lattice.levels)
    ]
    stated: Floats = last + stated_covariance(raw[None], np.stack(flat))[0] - raw[-1]
    return 0.5 * (stated + stated.T)


def _array(values: Tensor) -> Floats:
    return values.detach().double().cpu().numpy()
