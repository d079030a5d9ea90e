"""The solver outside eager PyTorch: ONNX run by onnxruntime, and torch.compile."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from egovm.config import LatticeConfig
from egovm.pose_solver import PoseSolver

LATTICE = LatticeConfig()
CHANNELS = (16, 8, 8)


class Plain(nn.Module):
    """The solver with tensors in and out, as an exported network has them."""

    def __init__(self, groups: int = 1) -> None:
        super().__init__()
        self.solver = PoseSolver(LATTICE, groups=groups)

    def forward(
        self, features: list[Tensor], embeddings: list[Tensor], places: Tensor, valid: Tensor
    ) -> tuple[Tensor, ...]:
        found = self.solver(features, embeddings, places, valid)
        moments = [x for each in found.levels for x in (each.mean, each.cov)]
        return found.offset, found.modes, found.weights, found.found, *moments


def inputs(seed: int, elements: int = 70, valid: float = 0.8) -> tuple[list[Tensor], list[Tensor], Tensor, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    features = [torch.randn(1, c, 60 << level, 60 << level, generator=draw) for level, c in enumerate(CHANNELS)]
    embeddings = [torch.randn(1, elements, c, generator=draw) for c in CHANNELS]
    places = (torch.rand(1, elements, 2, 2, generator=draw) - 0.5) * 28.0
    return features, embeddings, places, torch.rand(1, elements, generator=draw) < valid


@pytest.mark.parametrize(
    ("groups", "elements"), [(1, 10), *(pytest.param(g, k, marks=pytest.mark.slow) for g, k in ((1, 70), (4, 10)))]
)
def test_onnx_says_the_same(groups: int, elements: int, tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    torch.manual_seed(0)
    plain = Plain(groups).eval()
    path = tmp_path / "solver.onnx"
    torch.onnx.export(plain, inputs(1, elements), path, dynamo=True, verbose=False, optimize=False)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    for given in (inputs(2, elements), inputs(3, elements, valid=0.0)):
        flat = [*given[0], *given[1], *given[2:]]
        fed = {one.name: x.numpy() for one, x in zip(session.get_inputs(), flat, strict=True)}
        with torch.no_grad():
            wanted = plain(*given)
        for ours, theirs in zip(session.run(None, fed), wanted, strict=True):
            np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-5, rtol=0)
    assert wanted[0].abs().max() == 0  # the last had no landmarks


def test_compiled_it_is_one_graph() -> None:
    plain = Plain()
    explained = torch._dynamo.explain(plain)(*inputs(2))
    assert explained.graph_break_count == 0
    assert explained.graph_count == 1
