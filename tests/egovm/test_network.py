"""The whole network: what it gives, every ablation, and frames in which nothing is to be seen or matched."""

from pathlib import Path

import msgspec
import pytest
import torch

from egovm.batch import Batch, MapElements, Truth
from egovm.config import ABLATIONS, PRESETS, NetworkConfig
from egovm.convolutions import deployed
from egovm.dataset import InitialNoise, TrainingBatches
from egovm.network import EgoVM
from egovm.pose_solver import PoseEstimate
from egovm.regression_solver import RegressedPose
from egovm.train import begun, learn
from tests.egovm.made_training import NETWORK, RECIPE, STILL, TRAINING, made_cache
from tests.egovm.scenes import no_points

__all__ = ["made_cache"]


@pytest.fixture(scope="module")
def seen(made_cache: Path) -> tuple[Batch, Truth]:
    return TrainingBatches(RECIPE, NETWORK, InitialNoise(), STILL, 2, 0, made_cache)[0]


def network(config: NetworkConfig = NETWORK) -> EgoVM:
    torch.manual_seed(0)
    return EgoVM(config)


def test_it_gives_maps_embeddings_and_a_pose(seen: tuple[Batch, Truth]) -> None:
    output = network().eval()(seen[0])
    assert [tuple(level.shape) for level in output.bev] == [(2, 16, 64, 64), (2, 8, 128, 128), (2, 4, 256, 256)]
    assert all(level.is_contiguous(memory_format=torch.channels_last) for level in output.bev)
    elements = seen[0].elements.valid.shape[1]
    assert [tuple(level.shape) for level in output.embeddings] == [(2, elements, c) for c in (16, 8, 4)]
    assert output.logits == ()
    assert isinstance(output.estimate, PoseEstimate)
    assert output.estimate.found.all()
    assert output.estimate.offset.isfinite().all()


def test_logits_come_when_asked_for_and_in_training(seen: tuple[Batch, Truth]) -> None:
    given = network()
    shapes = [tuple(level.shape) for level in given(seen[0]).logits]
    assert shapes == [(2, 7, 64, 64), (2, 7, 128, 128), (2, 7, 256, 256)]
    assert given.eval()(seen[0]).logits == ()
    assert len(given(seen[0], semantics=True).logits) == 3


def test_deployed_in_sixteen_bits_it_estimates_the_same(seen: tuple[Batch, Truth]) -> None:
    """To a twentieth of the finest steps; it is not trained, so that posteriors are as wide as the windows."""
    given = network().eval()
    with torch.inference_mode():
        exact, short = given(seen[0], semantics=True), deployed(given, torch.bfloat16)(seen[0], semantics=True)
    assert torch.allclose(short.estimate.offset, exact.estimate.offset, atol=0.05 * 0.125)
    assert not torch.equal(short.estimate.offset, exact.estimate.offset)
    for a, b in zip(short.logits, exact.logits, strict=True):
        assert a.dtype == torch.float32
        assert (a - b).square().mean() < 0.03**2 * (b - b.mean()).square().mean()


def test_a_prior_narrows_what_is_searched(seen: tuple[Batch, Truth]) -> None:
    given = network().eval()
    search = torch.tensor([[0.5, 0.5, 0.01]]).expand(2, 3)
    estimate = given(seen[0], search).estimate
    open_, narrow = (e.levels[0].log_p.isfinite().sum() for e in (given(seen[0]).estimate, estimate))
    assert open_ == 2 * 13**3
    assert narrow == 2 * 3**3


@pytest.mark.parametrize("name", list(ABLATIONS))
def test_every_ablation_learns_for_a_step(name: str, made_cache: Path) -> None:
    """All weights that the switches leave get a gradient, and the losses that they leave out are zero."""
    config = msgspec.structs.replace(TRAINING, ablation=name)
    training = begun(config)
    batch, truth = TrainingBatches(RECIPE, config.built(), InitialNoise(), STILL, 2, 0, made_cache)[0]
    assert isinstance(training.network(batch).estimate, RegressedPose if name == "A6" else PoseEstimate)
    before = {key: value.clone() for key, value in training.network.named_parameters()}
    entry = learn(training, batch, truth)
    assert entry["gradient"] > 0.0
    assert (entry["semantic"] == 0.0) == (name in ("A3", "A4"))
    assert (entry["random_pose"] == 0.0) == (name in ("A5", "A6"))
    assert (entry["solver"] == 0.0) == (name == "A6")
    with_gradient = {key for key, value in training.network.named_parameters() if value.grad is not None}
    moved = {key for key, value in training.network.named_parameters() if not torch.equal(value, before[key])}
    assert {"bev", "matching"} <= {key.partition(".")[0] for key in with_gradient & moved}
    assert not ((batch.elements.type == 7) & batch.elements.valid).any()


def nothing(elements: MapElements) -> MapElements:
    """The same without a valid piece."""
    columns = {name: getattr(elements, name) for name in ("type", "ends", "height", "normal", "ratios")}
    return MapElements(**columns, valid=torch.zeros_like(elements.valid))


@pytest.mark.parametrize("solver", ["histogram", "regression"])
@pytest.mark.parametrize("missing", ["points", "map", "both"])
def test_frames_without_points_or_map_give_no_nan(seen: tuple[Batch, Truth], solver: str, missing: str) -> None:
    batch, truth = seen
    points = batch.points if missing == "map" else no_points(2)
    elements = batch.elements if missing == "points" else nothing(batch.elements)
    training = begun(msgspec.structs.replace(TRAINING, ablation="A6" if solver == "regression" else None))
    entry = learn(training, Batch(points, None, elements), truth)
    assert entry["gradient"] is not None
    assert all(value.isfinite().all() for value in training.network.state_dict().values())
    found = training.network.eval()(Batch(points, None, elements)).estimate
    assert found.offset.isfinite().all()
    assert bool(found.found.any()) == (missing == "points")
    if missing != "points":
        assert (found.offset == 0.0).all()


def test_presets_are_built() -> None:
    """Of cameras as well; the LiDAR's is within what is promised."""
    sizes = {name: sum(p.numel() for p in EgoVM(PRESETS[name]).parameters()) for name in ("small", "small-lidar")}
    assert sizes["small-lidar"] < sizes["small"] < 5_000_000
