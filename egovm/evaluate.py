"""What trained weights are worth on frames that they have never seen, beside taking the initial pose as it is.

Longitudinal and lateral are along and left of the true heading; yaw in degrees. Covariances are judged level by level,
as the histograms have them and calibrated (``honesty``), along body axes at the level's centre.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from egovm.batch import Batch, Truth
from egovm.calibration import Calibration, stated, steps_of
from egovm.calibration_fit import fitted
from egovm.convolutions import deployed, native_precision
from egovm.dataset import NOISES, EvaluationBatches, loader
from egovm.honesty import AXES, honesty
from egovm.judging import Judged, LevelErrors, joined, judged, level_errors
from egovm.lattice import between
from egovm.map_contents import MapContent
from egovm.network import EgoVM
from egovm.pose_solver import PoseEstimate
from sensors.errors import EgolocError

Floats = NDArray[np.float64]
Report = dict[str, Any]
Tell = Callable[[int], object]

BELOW = {"lon": (0.1, 0.2, 0.3), "lat": (0.1, 0.2, 0.3), "yaw": (0.1, 0.3, 0.6)}
"""Errors are counted under these, m and deg."""
CALIBRATION_NOISE = ("uniform", "gauss")
"""Presets that take turns in a calibration: where a user's initial poses lie, nobody knows."""
CALIBRATION_MAPS: tuple[MapContent, ...] = ("full", "no-surfels", "full", "lines", "thinned")
"""And these maps. On full ones alone errors hardly follow the histograms' widths; a fit to them makes all covariances
small, also where a poor map leaves the pose open and the width is true."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Of N frames: initial and estimate: (N, 3) m, m, deg; levels: None of a network that regresses the pose, which
    states no covariance; found: (N,) bool; seconds: (N,) of the network."""

    initial: Floats
    estimate: Floats
    levels: LevelErrors | None
    found: NDArray[np.bool_]
    seconds: Floats


@dataclass(frozen=True)
class InTurns(Dataset[tuple[Batch, Truth]]):
    """Each frame from the next of several batches, one frame later in each next round of the worlds: all of them meet
    every world."""

    several: tuple[EvaluationBatches, ...]

    def __len__(self) -> int:
        return len(self.several[0])

    def __getitem__(self, number: int) -> tuple[Batch, Truth]:
        return self.several[self.turn(number)][number]

    def turn(self, number: int) -> int:
        """Which of the batches a frame comes from."""
        return sum(divmod(number, self.several[0].recipe.worlds)) % len(self.several)


def evaluate(
    network: EgoVM, batches: EvaluationBatches, calibration: Calibration, workers: int = 1, tell: Tell = id
) -> Report:
    """Figures of all frames of the batches; tell: how many are done."""
    return summary(errors_of(network, batches, workers, tell), calibration)


def calibrate(network: EgoVM, batches: EvaluationBatches, workers: int = 1, tell: Tell = id) -> Calibration:
    """A calibration from the frames of the batches, with CALIBRATION_NOISE and CALIBRATION_MAPS for theirs.

    Raises EgolocError for a network that regresses the pose, and where frames are too few.
    """
    if network.solver is None:
        raise EgolocError("calibration: expected a network with a histogram: regression states no covariance")
    turns = InTurns(
        tuple(
            replace(batches, noise=NOISES[name], content=content)
            for name in CALIBRATION_NOISE
            for content in CALIBRATION_MAPS
        )
    )
    levels = errors_of(network, turns, workers, tell).levels
    assert levels is not None
    return fitted(levels, network.config.solver.lattice, CALIBRATION_NOISE, CALIBRATION_MAPS, batches.seed)


@torch.inference_mode()
def errors_of(network: EgoVM, batches: EvaluationBatches | InTurns, workers: int, tell: Tell) -> Errors:
    """Run the network, ready for use, on every frame."""
    fast: Any = deployed(network, native_precision())
    initial, found, levels, seconds = [], [], [], []
    for number, (batch, truth) in enumerate(loader(batches, range(len(batches)), workers)):
        begin = time.perf_counter()
        output = fast(batch)
        seconds.append(time.perf_counter() - begin)
        found.append(judged(output.estimate, truth.offset))
        if isinstance(output.estimate, PoseEstimate):
            levels.append(level_errors(output.estimate, truth.offset, network.config.solver.lattice))
        initial.append(between(truth.offset, torch.zeros_like(truth.offset)))
        tell(number + 1)
    return _joined(torch.cat(initial), found, joined(levels) if levels else None, np.array(seconds))


def summary(errors: Errors, calibration: Calibration) -> Report:
    """What is told of errors. Frames without landmarks count with the initial pose: that is all there was."""
    if not len(errors.found):
        raise EgolocError("evaluation: expected one frame or more, got none")
    return {
        "frames": len(errors.found),
        "without_landmarks": int((~errors.found).sum()),
        "methods": {"initial": _method(errors.initial), "egovm": _method(errors.estimate)},
        "covariance": None if errors.levels is None else _levels(errors.levels, calibration),
        "stated": None if errors.levels is None else _stated(errors.levels, calibration),
        "network_ms": {"p50": 1e3 * float(np.median(errors.seconds)), "max": 1e3 * float(errors.seconds.max())},
    }


def _method(errors: Floats) -> Report:
    """Figures of errors (N, 3) m, m, deg."""
    return {axis: _axis(errors[:, i], BELOW[axis]) for i, axis in enumerate(AXES)}


def _axis(errors: Floats, below: tuple[float, ...]) -> Report:
    size = np.abs(errors)
    p50, p95, p99 = np.percentile(size, (50, 95, 99)).tolist()
    return {
        "mae": float(size.mean()),
        "rmse": float(np.sqrt((size**2).mean())),
        "p50": p50,
        "p95": p95,
        "p99": p99,
        "max": float(size.max()),
        "bias": float(errors.mean()),
        "below": {f"{limit:g}": float((size < limit).mean()) for limit in below},
    }


def _levels(levels: LevelErrors, calibration: Calibration) -> list[Report]:
    """By level, coarse to fine: honesty of its covariances, raw and calibrated, over all frames that state one."""
    fitted_covs = calibration.of_levels(levels.cov)
    found = []
    for level, (step_m, _, step_rad) in enumerate(steps_of(calibration.lattice).tolist()):
        error = levels.error[:, level]
        found.append(
            {
                "step_m": step_m,
                "step_deg": float(np.degrees(step_rad)),
                "truth_outside": int((~levels.inside[:, level]).sum()),
                "raw": honesty(error, levels.cov[:, level]),
                "calibrated": None if calibration.fit is None else honesty(error, fitted_covs[:, level]),
            }
        )
    return found


def _stated(levels: LevelErrors, calibration: Calibration) -> Report | None:
    """Honesty of what a fix states."""
    return honesty(levels.error[:, -1], stated(calibration, levels.cov, levels.yaw))


def _joined(initial: Tensor, found: list[Judged], levels: LevelErrors | None, seconds: Floats) -> Errors:
    units = np.array((1.0, 1.0, 180.0 / np.pi))
    return Errors(
        initial.double().numpy() * units,
        torch.cat([each.error for each in found]).double().numpy() * units,
        levels,
        torch.cat([each.found for each in found]).numpy(),
        seconds,
    )
