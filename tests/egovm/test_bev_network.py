"""The BEV side in every mode: shapes, gradients, sensors that saw nothing, and the copy that runs faster."""

import msgspec
import pytest
import torch
from torch import Tensor

from egovm.batch import Images, Points
from egovm.bev_network import BevNetwork
from egovm.config import PAPER, SMALL, BevConfig, CameraConfig, FusionConfig, LidarConfig, NetworkConfig
from egovm.convolutions import deployed, fold_traced
from egovm.timm_models import backbone
from sensors.errors import EgolocError
from tests.egovm.scenes import TINY, images, no_points, points

MODES = ("full", "visual", "lidar")


def network(config: NetworkConfig = TINY) -> BevNetwork:
    torch.manual_seed(0)
    return BevNetwork(config).eval()


def given(mode: str, frames: int = 1) -> tuple[Points | None, Images | None]:
    """What the sensors of a mode saw."""
    return (None if mode == "visual" else points(frames=frames)), (None if mode == "lidar" else images(frames=frames))


def close(found: tuple[Tensor, ...], expected: tuple[Tensor, ...], atol: float = 0.0) -> None:
    for level, (a, b) in enumerate(zip(found, expected, strict=True)):
        torch.testing.assert_close(a, b, atol=atol, rtol=0.0, msg=lambda text, level=level: f"level {level}: {text}")


@pytest.mark.parametrize("config", [PAPER, SMALL], ids=lambda config: config.name)
@pytest.mark.parametrize("mode", MODES)
def test_maps_have_the_sizes_of_the_presets(config: NetworkConfig, mode: str) -> None:
    """On a smaller plane and smaller images; the sizes of the whole plane are those of the config."""
    few = msgspec.structs.replace(
        config,
        bev=msgspec.structs.replace(config.bev, half_m=4.0),
        camera=msgspec.structs.replace(config.camera, image_hw=(64, 96)),
    )
    with torch.no_grad():
        maps = BevNetwork(few)(*given(mode))
    assert [tuple(found.shape) for found in maps] == [(1, few.bev.channels[i], 16 * 2**i, 16 * 2**i) for i in range(3)]
    assert [config.bev.cells(level) for level in range(3)] == [160, 320, 640]
    assert all(found.isfinite().all() for found in maps)


def test_paper_sizes() -> None:
    assert PAPER.bev.channels == (256, 128, 64)
    assert PAPER.camera is not None
    assert (PAPER.camera.backbone, PAPER.camera.image_hw, PAPER.camera.channels) == ("ese_vovnet39b", (448, 640), 256)
    assert PAPER.fusion.layers == 4


@pytest.mark.parametrize("mode", MODES)
def test_gradients_are_finite_and_reach_every_part(mode: str) -> None:
    trained = network(
        msgspec.structs.replace(TINY, fusion=FusionConfig(1.0, 1, 2, 4, cross_points=4, hidden=16))
    ).train()
    trained.drops = (0.0, 0.0)
    sum(found.square().mean() for found in trained(*given(mode, 2))).backward()
    reached = {name.partition(".")[0] for name, p in trained.named_parameters() if p.grad is not None and p.grad.any()}
    expected = {"full": {"camera", "fusion", "lidar"}, "visual": {"camera", "fusion", "queries"}, "lidar": {"lidar"}}
    assert reached == expected[mode] | {"pyramid"}
    assert all(p.grad.isfinite().all() for p in trained.parameters() if p.grad is not None)


def test_a_lidar_that_saw_nothing_is_as_none() -> None:
    close(network()(no_points(), images()), network()(None, images()))


def test_frames_do_not_mix() -> None:
    """Of two frames one has no points and one no valid image."""
    tested, seen, looked = network(), points(frames=1), images(frames=2)
    valid = torch.tensor([[False, False], [True, True]])
    both = tested(
        Points(seen.xyz, seen.intensity, seen.offset_s, torch.zeros_like(seen.frame), 2),
        Images(looked.rgb, looked.K, looked.T_camera_body, valid),
    )
    close(tuple(found[:1] for found in both), tested(seen, None), 1e-5)
    second = Images(looked.rgb[1:], looked.K[1:], looked.T_camera_body[1:], valid[1:])
    close(tuple(found[1:] for found in both), tested(None, second), 1e-5)


@pytest.mark.parametrize("value", [0.0, 1e4])
@pytest.mark.parametrize("training", [True, False])
def test_black_and_blown_out_images(value: float, training: bool) -> None:
    looked = images()
    tested = network().train(training)
    maps = tested(no_points(), Images(torch.full_like(looked.rgb, value), looked.K, looked.T_camera_body, looked.valid))
    assert all(found.isfinite().all() for found in maps)


@pytest.mark.parametrize(("cameras", "lidar", "mode"), [(1.0, 0.0, "lidar"), (0.0, 1.0, "visual"), (0.0, 0.0, "full")])
def test_sensors_are_left_out_in_training(cameras: float, lidar: float, mode: str) -> None:
    tested = network(msgspec.structs.replace(TINY, fusion=FusionConfig(drop_cameras=cameras, drop_lidar=lidar))).train()
    close(tested(*given("full")), tested(*given(mode)))


def test_sensors_are_left_out_as_often_as_told() -> None:
    fusion = msgspec.structs.replace(TINY.fusion, drop_cameras=0.3, drop_lidar=0.2)
    tested = network(msgspec.structs.replace(TINY, fusion=fusion))
    some = [tested._some(*given("full")) for _ in range(500)]
    assert 0.24 < sum(looked is None for _, looked in some) / 500 < 0.36
    assert 0.14 < sum(seen is None for seen, _ in some) / 500 < 0.26


@pytest.mark.parametrize("mode", MODES)
def test_the_faster_copy_gives_the_same(mode: str) -> None:
    tested = network().train()
    for _ in range(2):  # norms that are not their first values
        tested(*given("full"))
    tested.eval()
    with torch.no_grad():
        close(deployed(tested)(*given(mode)), tested(*given(mode)), 1e-4)
    assert any(isinstance(module, torch.nn.BatchNorm2d) for module in tested.pyramid.modules())
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in deployed(tested).modules())


@pytest.mark.parametrize("mode", MODES)
def test_a_shorter_type_gives_nearly_the_same(mode: str) -> None:
    """Off by what eight bits of each number make."""
    tested = network()
    with torch.no_grad():
        short, exact = deployed(tested, torch.bfloat16)(*given(mode)), tested(*given(mode))
    for a, b in zip(short, exact, strict=True):
        assert 0.0 < float((a.float() - b).square().mean() / b.square().mean()) < 0.03**2
    assert short[-1].dtype == torch.bfloat16
    assert all(p.dtype == torch.float32 for p in tested.parameters())


@pytest.mark.parametrize("name", ["mobilenetv3_small_050", "ese_vovnet39b"])
def test_a_backbones_norms_are_folded(name: str) -> None:
    """Those of timm's that have an activation in them, too."""
    torch.manual_seed(1)
    tested = backbone(name)
    rgb = torch.randn(2, 3, 64, 64)
    with torch.no_grad():
        tested(rgb)  # norms that are not their first values
        expected = tested.eval()(rgb)
        fold_traced(tested)
        found = tested(rgb)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in tested.modules())
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


def test_what_cannot_be_traced_stays_as_it_is() -> None:
    class Deciding(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer, self.norm = torch.nn.Conv2d(3, 3, 1), torch.nn.BatchNorm2d(3)

        def forward(self, x: Tensor) -> Tensor:
            found: Tensor = self.norm(self.layer(x)) if x.sum() > 0 else x
            return found

    tested = Deciding().eval()
    fold_traced(tested)
    assert isinstance(tested.norm, torch.nn.BatchNorm2d)


def test_a_network_without_cameras() -> None:
    tested = network(msgspec.structs.replace(TINY, camera=None))
    close(tested(*given("full")), tested(*given("lidar")))
    with pytest.raises(EgolocError, match="nothing that it has an encoder for"):
        tested(*given("visual"))


def test_different_numbers_of_frames() -> None:
    with pytest.raises(EgolocError, match="as many frames"):
        network()(points(frames=2), images(frames=1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bev": BevConfig(cell_m=(0.5, 0.2, 0.1))}, "half as wide"),
        ({"bev": BevConfig(blocks=(0, 1))}, "as many channels and blocks"),
        ({"camera": CameraConfig(image_hw=(450, 640))}, "multiples of 32"),
        ({"camera": CameraConfig(channels=128)}, "first BEV level, 256"),
        ({"lidar": LidarConfig(cell_m=0.5)}, "half a cell"),
        ({"lidar": LidarConfig(blocks=(3,), channels=(64,))}, "two stages"),
        ({"lidar": LidarConfig(blocks=(1,) * 8, channels=(8,) * 8)}, "multiple of 64"),
        ({"fusion": FusionConfig(cell_m=0.75)}, "multiple of 0.5"),
        ({"fusion": FusionConfig(drop_cameras=0.7, drop_lidar=0.4)}, "at most 1"),
    ],
)
def test_configs_that_fit_nothing(change: dict[str, msgspec.Struct], message: str) -> None:
    with pytest.raises(EgolocError, match=message):
        msgspec.structs.replace(PAPER, **change)
