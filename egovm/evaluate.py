"""What trained weights are worth on frames that they have never seen, beside taking the initial pose as it is.

Longitudinal and lateral are along and left of the true heading; yaw in degrees. NEES: squared errors by the variance
that the last level states, of 3 degrees of freedom: by 3 its mean is 1 and its median 0.79 where covariances are true.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovm.convolutions import deployed
from egovm.dataset import EvaluationBatches, loader
from egovm.judging import Judged, judged
from egovm.lattice import between
from egovm.network import EgoVM
from sensors.errors import EgolocError

Floats = NDArray[np.float64]
Report = dict[str, Any]

AXES = ("lon", "lat", "yaw")
BELOW = {"lon": (0.1, 0.2, 0.3), "lat": (0.1, 0.2, 0.3), "yaw": (0.1, 0.3, 0.6)}
"""Errors are counted under these, m and deg."""
TAIL = 11.34
"""A NEES of three axes is beyond that in 1 % where covariances are true (chi-square)."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Of N frames: initial and estimate: (N, 3) m, m, deg; nees: (N, 3) of the axes and total: (N,), NaN where none is
    stated; found: (N,) bool; seconds: (N,) of the network."""

    initial: Floats
    estimate: Floats
    nees: Floats
    total: Floats
    found: NDArray[np.bool_]
    seconds: Floats


def evaluate(
    network: EgoVM, batches: EvaluationBatches, workers: int = 1, tell: Callable[[int], object] = id
) -> Report:
    """Figures of all frames of the batches; tell: how many are done."""
    return summary(errors_of(network, batches, workers, tell))


@torch.inference_mode()
def errors_of(network: EgoVM, batches: EvaluationBatches, workers: int, tell: Callable[[int], object]) -> Errors:
    """Run the network, ready for use, on every frame."""
    fast: Any = deployed(network)
    initial, found, seconds = [], [], []
    for number, (batch, truth) in enumerate(loader(batches, range(len(batches)), workers)):
        begin = time.perf_counter()
        output = fast(batch)
        seconds.append(time.perf_counter() - begin)
        found.append(judged(output.estimate, truth.offset))
        initial.append(between(truth.offset, torch.zeros_like(truth.offset)))
        tell(number + 1)
    return _joined(torch.cat(initial), found, np.array(seconds))


def summary(errors: Errors) -> Report:
    """What is told of errors. Frames without landmarks count with the initial pose: that is all there was."""
    if not len(errors.found):
        raise EgolocError("evaluation: expected one frame or more, got none")
    return {
        "frames": len(errors.found),
        "without_landmarks": int((~errors.found).sum()),
        "methods": {"initial": _method(errors.initial), "egovm": _method(errors.estimate)},
        "nees": _nees(errors),
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


def _nees(errors: Errors) -> Report | None:
    """Of frames that state a covariance with a width, and how many state one without; None where there are none."""
    stated = np.isfinite(errors.total) & np.isfinite(errors.nees).all(axis=1)
    if not stated.any():
        return None
    total = errors.total[stated]
    axes = {axis: float(errors.nees[stated, i].mean()) for i, axis in enumerate(AXES)}
    return {
        "mean_by_3": float(total.mean() / 3.0),
        "median_by_3": float(np.median(total) / 3.0),
        "beyond_99": float((total > TAIL).mean()),
        "without_width": int(np.isinf(errors.total).sum()),
        **axes,
    }


def _joined(initial: Tensor, found: list[Judged], seconds: Floats) -> Errors:
    def column(name: str) -> Any:
        return torch.cat([getattr(each, name) for each in found]).double().numpy()

    units = np.array((1.0, 1.0, 180.0 / np.pi))
    return Errors(
        initial.double().numpy() * units,
        column("error") * units,
        column("nees"),
        column("total"),
        torch.cat([each.found for each in found]).numpy(),
        seconds,
    )
