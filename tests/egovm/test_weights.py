"""Weights and their config, written and read back; and files that do not fit."""

from pathlib import Path

import msgspec
import pytest
import torch
from safetensors.torch import save_file

from egovm.bev_network import BevNetwork
from egovm.calibration import read_calibration
from egovm.config import PAPER, SMALL, CameraConfig, NetworkConfig
from egovm.timm_models import backbone
from egovm.weights import config_toml, load_weights, read_config, save_weights, weights_path
from sensors.errors import EgolocError
from tests.egovm.scenes import TINY, images

NO_CAMERA = msgspec.structs.replace(TINY, camera=None, name='of "one" sensor')


@pytest.mark.parametrize("config", [PAPER, SMALL, NO_CAMERA], ids=lambda config: config.name)
def test_config_comes_back(config: NetworkConfig, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(config_toml(config))
    assert read_config(tmp_path / "a.safetensors") == config


def test_weights_come_back(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    written = BevNetwork(TINY)
    save_weights(written, TINY, path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.safetensors", "a.toml"]
    read = BevNetwork(read_config(path))
    load_weights(read, path)
    for a, b in zip(written.eval()(None, images()), read.eval()(None, images()), strict=True):
        assert torch.equal(a, b)


def test_weights_of_another_network(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_weights(torch.nn.Linear(2, 3), TINY, path)
    with pytest.raises(EgolocError, match=r"a\.safetensors: bias: expected shape \(4,\), got \(3,\)"):
        load_weights(torch.nn.Linear(2, 4), path)
    with pytest.raises(EgolocError, match=r"a\.safetensors: bias: not in this network"):
        load_weights(torch.nn.Linear(2, 3, bias=False), path)
    with pytest.raises(EgolocError, match=r"a\.safetensors: 0\.bias: expected, found none"):
        load_weights(torch.nn.Sequential(torch.nn.Linear(2, 3)), path)


def test_files_that_are_none(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    with pytest.raises(EgolocError, match="found no file"):
        load_weights(torch.nn.Linear(2, 3), path)
    with pytest.raises(EgolocError, match="found no file"):
        read_config(path)
    path.write_bytes(b"no weights at all")
    with pytest.raises(EgolocError, match="expected a safetensors file"):
        load_weights(torch.nn.Linear(2, 3), path)
    with pytest.raises(EgolocError, match=r"ends in \.safetensors"):
        save_weights(torch.nn.Linear(2, 3), TINY, tmp_path / "a.pt")
    (tmp_path / "a.toml").write_text("[bev]\nhalf = 3.0\n")
    with pytest.raises(EgolocError, match=r"a\.toml: .*half"):
        read_config(path)


def test_backbones_take_local_weights(tmp_path: Path) -> None:
    """As timm writes them: those of the whole classifier."""
    import timm  # after timm_models: see there

    torch.manual_seed(1)
    whole = timm.create_model("mobilenetv3_small_050")
    save_file(whole.state_dict(), tmp_path / "w.safetensors")
    stem = backbone("mobilenetv3_small_050", tmp_path / "w.safetensors").state_dict()["conv_stem.weight"]
    assert torch.equal(stem, whole.state_dict()["conv_stem.weight"])


def test_backbones_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="expected a model of timm"):
        backbone("vovnet_of_nobody")
    with pytest.raises(EgolocError, match="stride 16 and 32"):
        backbone("vit_tiny_patch16_224")
    with pytest.raises(EgolocError, match="found none"):
        backbone("mobilenetv3_small_050", tmp_path / "w.safetensors")
    save_file({"a": torch.ones(1)}, tmp_path / "w.safetensors")
    with pytest.raises(EgolocError, match=r"w\.safetensors: expected weights of mobilenetv3_small_050, .* is missing"):
        backbone("mobilenetv3_small_050", tmp_path / "w.safetensors")
    assert CameraConfig().backbone == "ese_vovnet39b"


def test_weights_that_come_with_egoloc_have_their_calibration() -> None:
    """Trained anew, they need another: egoloc eval small-lidar --calibrate 800."""
    path = weights_path("small-lidar")
    calibration = read_calibration(path, read_config(path).solver.lattice)
    assert calibration.fit is not None
    assert calibration.fit.frames >= 400
    assert all(a < b for a, b in zip(calibration.fit.nll_after, calibration.fit.nll_before, strict=True))
