"""The BEV side as ONNX: onnxruntime gives the same maps, for another number of points than it was exported with."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from egovm.batch import Images, Points
from egovm.bev_network import BevNetwork
from egovm.convolutions import deployed
from tests.egovm.scenes import TINY, images, points


class Lidar(nn.Module):
    """One frame of points, told by tensors alone."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, xyz: Tensor, intensity: Tensor) -> tuple[Tensor, ...]:
        found: tuple[Tensor, ...] = self.network(seen(xyz, intensity), None)
        return found


class Full(Lidar):
    """The same with images."""

    def forward(  # type: ignore[override]
        self, xyz: Tensor, intensity: Tensor, rgb: Tensor, K: Tensor, T_camera_body: Tensor, valid: Tensor
    ) -> tuple[Tensor, ...]:
        found: tuple[Tensor, ...] = self.network(seen(xyz, intensity), Images(rgb, K, T_camera_body, valid))
        return found


def seen(xyz: Tensor, intensity: Tensor) -> Points:
    """Points of one frame."""
    nothing = torch.zeros_like(intensity)
    return Points(xyz, intensity, nothing, nothing.long(), 1)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["full", "lidar"])
@pytest.mark.filterwarnings("ignore")  # of the exporter, about itself
def test_onnxruntime_gives_the_same_maps(mode: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    torch.manual_seed(0)
    exported = (Full if mode == "full" else Lidar)(deployed(BevNetwork(TINY))).eval()
    first, looked = points(), images()
    rest = (looked.rgb, looked.K, looked.T_camera_body, looked.valid) if mode == "full" else ()
    count = {0: torch.export.Dim("points", min=2, max=10**6)}
    program = torch.onnx.export(
        exported,
        (first.xyz, first.intensity, *rest),
        dynamo=True,
        dynamic_shapes=(count, count, *(None for _ in rest)),
        opset_version=18,
        verbose=False,
    )
    assert program is not None
    program.save(tmp_path / "bev.onnx")
    session = runtime.InferenceSession(tmp_path / "bev.onnx")
    more = points(777)
    flat = (more.xyz, more.intensity, *rest)
    names = [each.name for each in session.get_inputs()]
    found = session.run(None, dict(zip(names, (each.numpy() for each in flat), strict=True)))
    with torch.no_grad():
        for level, expected in enumerate(exported(*flat)):
            torch.testing.assert_close(torch.from_numpy(found[level]), expected, atol=1e-5, rtol=0.0)
