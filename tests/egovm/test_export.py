"""The whole network as ONNX: onnxruntime says what PyTorch does, of other frames than it was made with."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import msgspec
import numpy as np
import pytest
import torch

from egovm.batch import SURFEL, Batch, Images, MapElements
from egovm.config import SMALL, BevConfig, LatticeConfig, MatchingConfig, NetworkConfig, SolverConfig
from egovm.convolutions import deployed
from egovm.export import metadata, write_onnx
from egovm.export_check import LIMITS, Session, answers, apart, check_differences
from egovm.export_graph import (
    OUTPUTS,
    FrameGraph,
    Inputs,
    Mode,
    batch_of,
    chosen_mode,
    inputs_of,
    names_of,
    open_dimension,
)
from egovm.export_sample import sample_frames
from egovm.network import EgoVM
from egovm.timm_models import normalization
from replay import cli
from replay.commands.exporting import Export
from sensors.errors import EgolocError
from tests.egovm.scenes import TINY, images, no_points, points

WHOLE = msgspec.structs.replace(
    TINY, matching=MatchingConfig(layers=1, heads=2, hidden=16, most_elements=96), solver=SolverConfig(alpha=0.5)
)
LIDAR = msgspec.structs.replace(WHOLE, name="tiny-lidar", camera=None)
ONE_LEVEL = msgspec.structs.replace(
    LIDAR,
    bev=BevConfig(half_m=8.0, cell_m=(0.5,), channels=(8,), blocks=(0,)),
    lidar=msgspec.structs.replace(LIDAR.lidar, channels=(8, 8), blocks=(1, 1)),
    solver=SolverConfig(LatticeConfig(levels=1)),
)


ROOT = Path(cli.__file__).parents[1]


def network(config: NetworkConfig) -> torch.nn.Module:
    """Of random weights, sure enough of itself that its answers depend on what it sees."""
    torch.manual_seed(0)
    made = EgoVM(config)
    assert made.solver is not None
    torch.nn.init.constant_(made.solver.tau, 4.0)
    return deployed(made)


def elements(count: int, seed: int, valid: float = 0.8) -> MapElements:
    draw = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(1, count, *shape, generator=draw)

    type_ = torch.randint(0, SURFEL + 1, (1, count), generator=draw)
    ends = (uniform(2, 3) - 0.5) * torch.tensor((8.0, 8.0, 0.0))
    return MapElements(type_, ends, 3.0 * uniform(), uniform(3), uniform(2), uniform() < valid)


def seen_by(count: int, seed: int) -> Images:
    """Other noise from each seed, by cameras that look other ways."""
    made = images(tuple(0.7 * seed + 1.3 * each for each in range(count)))
    rgb = torch.randn(made.rgb.shape, generator=torch.Generator().manual_seed(seed))
    return Images(rgb, made.K.clone(), made.T_camera_body, made.valid)


def given(mode: Mode, p: int, n: int, k: int, seed: int, valid: float = 0.8) -> Inputs:
    return inputs_of(Batch(points(p) if p else no_points(), seen_by(n, seed), elements(k, seed, valid)), mode)


def with_(inputs: Inputs, **changes: Callable[[torch.Tensor], torch.Tensor]) -> Inputs:
    """The same where it has none of these inputs."""
    return inputs | {name: change(inputs[name]) for name, change in changes.items() if name in inputs}


def compare(config: NetworkConfig, mode: Mode, cases: dict[str, Inputs], folder: Path) -> dict[str, np.ndarray]:
    """All answers of all cases side by side; returns PyTorch's offsets."""
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    made, path = network(config), folder / "a.onnx"
    write_onnx(made, config, mode, given(mode, 400, 3, 20, 9), path)
    session = Session(path, threads=1)
    offsets = {}
    for name, inputs in cases.items():
        ours, theirs = answers(made, inputs), session(inputs)
        for answer in OUTPUTS:
            np.testing.assert_allclose(theirs[answer], ours[answer], atol=2e-5, rtol=1e-4, err_msg=f"{name}: {answer}")
        offsets[name] = ours["offset"]
        if not ours["landmarks"].all():
            assert (theirs["offset"] == 0.0).all()
            assert np.isposinf(np.diagonal(theirs["cov"][ours["landmarks"] == 0], axis1=1, axis2=2)).all()
    return offsets


def test_one_level_by_lidar(tmp_path: Path) -> None:
    cases = {
        "as exported": given("lidar", 400, 0, 20, 9),
        "more": given("lidar", 901, 0, 96, 2),
        "one of each": given("lidar", 1, 0, 1, 3, valid=1.0),
        "no points": given("lidar", 0, 0, 30, 4),
        "no elements": given("lidar", 400, 0, 5, 5, valid=0.0),
    }
    offsets = compare(ONE_LEVEL, "lidar", cases, tmp_path)
    assert np.abs(offsets["more"] - offsets["as exported"]).max() > 1e-3
    assert not offsets["no elements"].any()


@pytest.mark.slow
@pytest.mark.parametrize("mode", get_args(Mode))
def test_every_mode_says_the_same_of_other_frames(mode: Mode, tmp_path: Path) -> None:
    frame = given(mode, 500, 3, 40, 1)
    cases = {
        "frame": frame,
        "others": given(mode, 1200, 5, 96, 2),
        "fewest": given(mode, 1, 1, 1, 3, valid=1.0),
        "no points": given(mode, 0, 2, 30, 4),
        "points off the plane": with_(frame, points_xyz=lambda xyz: xyz + 100.0),
        "no elements": given(mode, 300, 2, 7, 6, valid=0.0),
        "elements off the plane": with_(frame, elements_ends=lambda ends: ends + 50.0),
        "black images": with_(frame, images_rgb=torch.zeros_like),
        "no valid image": with_(frame, images_valid=torch.zeros_like),
        "one valid image": with_(frame, images_valid=lambda valid: valid & torch.tensor([[True, False, False]])),
        "cameras that see the sky": with_(frame, images_T_camera_body=lambda T: T @ turned_up()),
    }
    offsets = compare(WHOLE, mode, cases, tmp_path)
    apart_from = {name: float(np.abs(offset - offsets["frame"]).max()) for name, offset in offsets.items()}
    assert apart_from["others"] > 1e-3
    assert (apart_from["no valid image"] > 1e-6) == (mode != "lidar")
    assert (apart_from["points off the plane"] > 1e-6) == (mode != "visual")


def turned_up() -> torch.Tensor:
    """(4, 4) T_body_other of axes whose z points down: cameras of it look anywhere but at the plane."""
    return torch.diag(torch.tensor((1.0, -1.0, -1.0, 1.0))) + 40.0 * torch.eye(4)[[2]].T @ torch.eye(4)[[3]]


@pytest.mark.slow
def test_groups_of_channels_by_lidar(tmp_path: Path) -> None:
    """h of several groups goes over the elements by chunks in PyTorch: 64 of them are not the most."""
    config = msgspec.structs.replace(ONE_LEVEL, solver=msgspec.structs.replace(ONE_LEVEL.solver, groups=4))
    cases = {"few": given("lidar", 300, 0, 9, 1), "many": given("lidar", 300, 0, 96, 2)}
    assert compare(config, "lidar", cases, tmp_path)["many"].any()


def test_the_graph_says_what_the_network_says() -> None:
    made, batch = network(WHOLE), Batch(points(), images(), elements(30, 1))
    found = dict(zip(OUTPUTS, FrameGraph(made)(inputs_of(batch, "full")), strict=True))
    wanted = made(batch).estimate
    assert torch.equal(found["offset"], wanted.offset[0])
    assert torch.equal(found["cov"], torch.stack([level.cov[0] for level in wanted.levels]))
    assert found["landmarks"].tolist() == [level.landmarks.item() for level in wanted.levels]
    assert torch.equal(found["modes"], wanted.modes[0])
    assert torch.equal(found["weights"], wanted.weights[0])
    assert torch.equal(found["log_p"], wanted.levels[0].log_p[0])
    assert torch.equal(found["contribution"], wanted.levels[-1].contribution[0])


def test_inputs_are_the_tensors_of_a_batch() -> None:
    batch = Batch(points(7), images(), elements(5, 1))
    back = batch_of(inputs_of(batch, "full"))
    assert back.points is not None
    assert torch.equal(back.points.xyz, batch.points.xyz)  # type: ignore[union-attr]
    assert back.images == batch.images
    assert back.elements == batch.elements
    assert batch_of(inputs_of(batch, "visual")).points is None
    assert batch_of(inputs_of(batch, "lidar")).images is None
    with pytest.raises(ValueError, match="expected one frame, got 2"):
        inputs_of(Batch(None, None, MapElements(*(torch.zeros(2, 1) for _ in range(6)))), "lidar")


def test_modes_that_a_network_has() -> None:
    visual = msgspec.structs.replace(WHOLE, lidar=None)
    assert [chosen_mode(config, None) for config in (WHOLE, LIDAR, visual)] == ["full", "lidar", "visual"]
    assert chosen_mode(WHOLE, "visual") == "visual"
    with pytest.raises(EgolocError, match="mode: expected lidar, for the network 'tiny-lidar' has a lidar alone"):
        chosen_mode(LIDAR, "full")
    with pytest.raises(EgolocError, match="mode: expected visual, for the network 'tiny' has a camera alone, got lid"):
        chosen_mode(visual, "lidar")


def test_the_file_tells_what_its_users_must_know() -> None:
    told = metadata(SMALL, "full")
    assert told["mode"] == "full"
    assert 'backbone = "mobilenetv3_small_100"' in told["config"]
    mean, deviation = normalization("mobilenetv3_small_100")
    assert [float(x) for x in told["rgb_mean"].split()] == list(mean)
    assert [float(x) for x in told["rgb_deviation"].split()] == list(deviation)
    assert "rgb_mean" not in metadata(SMALL, "lidar")


def test_differences_are_found() -> None:
    ours = answers(network(LIDAR), given("lidar", 300, 0, 30, 1))
    same = apart(ours, ours)
    assert set(same.values()) == {0.0}
    check_differences({"a": same}, Path("a.onnx"))
    turned = ours | {"offset": ours["offset"] + np.array((0.0, 0.002, 0.0), np.float32)}
    assert apart(ours, turned)["offset m"] == pytest.approx(0.002, abs=1e-6)
    assert apart(ours, turned)["offset deg"] == 0.0
    with pytest.raises(EgolocError, match=r"a\.onnx: not written: b: onnxruntime's offset m differs .* 0\.002, "):
        check_differences({"a": same, "b": apart(ours, turned)}, Path("a.onnx"))
    for answer, worst in (("cov", np.inf), ("offset", np.nan)):
        bad = apart(ours, ours | {answer: np.full_like(ours[answer], worst)})
        assert np.inf in bad.values()
    assert set(LIMITS) <= set(same)


@pytest.fixture
def egoloc(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    monkeypatch.setitem(cli.COMMANDS, "export", Export)
    return lambda *words: cli.main(["export", *map(str, words)])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("a.onnx", "--mode", "full"), "mode: expected lidar, for the network"),
        (("a.pt",), "a.pt: expected a name that ends in .onnx"),
        (("there.onnx",), "there.onnx: exists already"),
        (("none/a.onnx",), "none: expected a folder to write into, found none"),
    ],
)
def test_mistakes_are_told_in_a_line(
    words: tuple[str, ...],
    told: str,
    egoloc: Callable[..., int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.onnx").write_text("of another")
    assert egoloc("small-lidar", *words) == 2
    errors = capsys.readouterr().err
    assert told in errors
    assert errors.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["there.onnx"]
    assert egoloc("none.safetensors", "b.onnx") == 2


def test_without_the_extra_it_says_how_to_get_it(
    egoloc: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("egovm.export.find_spec", lambda name: None if name != "onnx" else sys)
    assert egoloc("small-lidar", tmp_path / "a.onnx") == 2
    assert capsys.readouterr().err == (
        "egoloc: error: export: expected onnxscript, onnxruntime, not installed: pip install egoloc[export]\n"
    )


@pytest.mark.slow
def test_the_weights_that_come_with_egoloc_and_the_example_of_the_docs(
    egoloc: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    monkeypatch.chdir(tmp_path)
    path = Path("small-lidar.onnx")
    assert egoloc("small-lidar", path, "--json") == 0
    report = msgspec.json.decode(capsys.readouterr().out)
    assert report["mode"] == "lidar"
    assert report["bytes"] == path.stat().st_size < 20e6
    assert list(report["differences"]) == ["frame 1", "frame 2", "an empty frame"]
    assert all(found["offset m"] < 1e-3 and found["offset deg"] < 1e-3 for found in report["differences"].values())
    model = onnx.load(path)
    assert [each.name for each in model.graph.input] == list(names_of("lidar"))
    assert [each.name for each in model.graph.output] == list(OUTPUTS)
    assert {entry.key for entry in model.metadata_props} >= {"egoloc.version", "egoloc.config", "egoloc.weights"}
    assert str(ROOT).encode() not in path.read_bytes()
    found, true = example_of_the_docs(capsys)
    np.testing.assert_allclose(found, true, atol=0.1)  # m, m, deg
    assert np.abs(true).max() > 0.5


def example_of_the_docs(capsys: pytest.CaptureFixture[str]) -> list[list[float]]:
    """The offset that it finds, and the true one."""
    _, _, code = (ROOT / "docs" / "export.md").read_text().partition("```python\n")
    exec(code.partition("```")[0], {})
    return [[float(x) for x in line.split()[1:4]] for line in capsys.readouterr().out.splitlines()[:2]]


@pytest.mark.parametrize("mode", get_args(Mode))
def test_sample_frames_are_inputs_of_their_mode(mode: Mode) -> None:
    """Of a network without a LiDAR, too; and the network takes them."""
    config = WHOLE if mode != "visual" else msgspec.structs.replace(WHOLE, lidar=None)
    made, frames = network(config), dict(sample_frames(config, mode))
    assert [tuple(inputs) for inputs in frames.values()] == 3 * [names_of(mode)]
    sizes = [[value.shape[open_dimension(name)] for name, value in inputs.items()] for inputs in frames.values()]
    assert min(sizes[0]) >= 2
    assert all(a != b for a, b in zip(*sizes[:2], strict=True))
    found = [answers(made, inputs) for inputs in frames.values()]
    assert np.isfinite(found[0]["cov"]).all()
    assert not found[2]["landmarks"].any()
