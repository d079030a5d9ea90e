"""An exported network beside its original: how far onnxruntime's answers lie from PyTorch's."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from egovm.export_graph import OUTPUTS, FrameGraph, Inputs
from sensors.errors import EgolocError

Answers = dict[str, NDArray[Any]]

LIMITS = {
    "offset m": 1e-3,
    "offset deg": 1e-3,
    "sigma m": 1e-3,
    "sigma deg": 1e-3,
    "landmarks": 0.0,
    "probability": 1e-4,
    "contribution": 1e-3,
}
"""The most by which an answer may differ, of all frames. Modes are not among them: of a flat histogram, any bin may be
the strongest."""


def differences(network: nn.Module, path: Path, frames: Iterable[tuple[str, Inputs]]) -> dict[str, dict[str, float]]:
    """The greatest difference of each answer, by frame. network: what was exported; path: the ONNX file."""
    run = Session(path)
    return {name: apart(answers(network, inputs), run(inputs)) for name, inputs in frames}


def check_differences(found: dict[str, dict[str, float]], path: Path) -> None:
    """Raise EgolocError for a difference beyond its limit, and for one that is no number."""
    for frame, values in found.items():
        for name, limit in LIMITS.items():
            if not values[name] <= limit:
                raise EgolocError(
                    f"{path}: not written: {frame}: onnxruntime's {name} differs from PyTorch's by {values[name]:.3g},"
                    f" expected at most {limit:g}"
                )


class Session:
    """A file in onnxruntime, on the CPU: Session(path)(inputs) -> answers by name."""

    def __init__(self, path: Path, threads: int = 0) -> None:
        """threads: 0: as many as there are cores."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def __call__(self, inputs: Inputs) -> Answers:
        found = self._session.run(OUTPUTS, {name: value.numpy() for name, value in inputs.items()})
        return dict(zip(OUTPUTS, found, strict=True))


@torch.inference_mode()
def answers(network: nn.Module, inputs: Inputs) -> Answers:
    """PyTorch's own."""
    return dict(zip(OUTPUTS, (value.numpy() for value in FrameGraph(network)(inputs)), strict=True))


def apart(ours: Answers, theirs: Answers) -> dict[str, float]:
    """The greatest difference of each answer, m or deg where it says so."""
    moved = {name: _most(ours[name], theirs[name]) for name in ("landmarks", "contribution")}
    probability = _most(np.exp(ours["log_p"]), np.exp(theirs["log_p"]))
    found = moved | {"probability": probability, "mode weight": _most(ours["weights"], theirs["weights"])}
    sigma = [np.sqrt(np.diagonal(each["cov"], axis1=1, axis2=2)) for each in (ours, theirs)]
    for name, a, b in (
        ("offset", ours["offset"], theirs["offset"]),
        ("sigma", *sigma),
        ("mode", ours["modes"], theirs["modes"]),
    ):
        found |= {f"{name} m": _most(a[..., :2], b[..., :2])}
        found |= {f"{name} deg": float(np.degrees(_most(a[..., 2], b[..., 2])))}
    return found


def _most(a: NDArray[Any], b: NDArray[Any]) -> float:
    """The greatest difference; infinite where shapes differ, or only one is finite."""
    if a.shape != b.shape or (np.isfinite(a) != np.isfinite(b)).any():
        return float("inf")
    finite = np.isfinite(a)
    return float(np.abs(a[finite].astype(np.float64) - b[finite]).max(initial=0.0))
