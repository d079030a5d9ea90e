"""Matcher: frames of made-up worlds that no training saw are found, whatever the body's height; and what is not."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from egovm.config import PRESETS, Ablation
from egovm.dataset import planar
from egovm.infer import Matcher
from egovm.made_samples import Recipe, made_sample
from egovm.match import NO_DATA, NO_LANDMARKS, planar_of
from egovm.network import EgoVM
from egovm.sample import Sample
from egovm.weights import save_weights, weights_path
from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.geodesy import utm_frame
from sensors.maps.map_file import MapFile, open_map
from sensors.maps.store import write_map
from sensors.maps.vector_map import NO_SURFELS, VectorMap
from tests.egovm.made_map import made
from tests.egovm.scenes import TINY
from tests.sensors.pictures import AHEAD, image

Floats = NDArray[np.float64]

T0 = 1_700_000_000_000_000_000
OFFSET = np.array((1.7, -1.2, np.radians(1.6)))
LOW = np.array((0.0, 0.0, 1.1))
"""The body's origin of another vehicle, below this one's, m."""


@pytest.fixture(scope="module")
def sample() -> Sample:
    return made_sample(Recipe(worlds=1), "held-out", 7)


@pytest.fixture(scope="module")
def vector_map(sample: Sample, tmp_path_factory: pytest.TempPathFactory) -> MapFile:
    return stored(sample, tmp_path_factory.mktemp("map") / "map.parquet")


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    return Matcher(weights_path("small-lidar"))


def stored(sample: Sample, path: Path) -> MapFile:
    frame = utm_frame(np.array((0.6945, 2.0333, 40.0)))
    elements = sample.elements.chosen(np.arange(len(sample.elements)))
    write_map(VectorMap(frame, elements, sample.surfels, ("made",), 1.0), path)
    return open_map(path)


def frame_of(sample: Sample, below: Floats | float = 0.0) -> Frame:
    """What was seen, in axes whose origin lies so far below the sample's, m."""
    xyz = (sample.xyz + below).astype(np.float32)
    return Frame(T0, T0 + 50_000_000, (Sweep(xyz, intensity=sample.intensity * 255.0, compensated=True),))


def off(T_map_body: Floats) -> Floats:
    return T_map_body @ np.linalg.inv(planar(OFFSET))


def test_a_frame_is_found_to_a_decimetre_and_says_how_sure_it_is(
    matcher: Matcher, sample: Sample, vector_map: MapFile
) -> None:
    match = matcher(frame_of(sample), vector_map, off(sample.T_map_body), semantics=True)
    error = match.pose - planar_of(sample.T_map_body)
    assert match.found
    assert np.hypot(*error[:2]) < 0.1
    assert abs(error[2]) < np.radians(0.15)
    assert error @ np.linalg.solve(match.cov, error) < 16.3  # 0.1 % of a chi-square of 3
    assert np.sqrt(np.diag(match.cov))[:2].max() < 0.2
    assert match.weights[0] > 0.9
    assert np.abs(match.modes[0] - match.pose).max() < 0.3
    assert (match.landmarks > 50).all()
    assert len(match.contribution) == len(match.pieces)
    assert match.output is not None
    assert len(match.output.logits) == 3
    fix = match.fix()
    assert fix.t_ns.tolist() == [T0]
    assert fix.arrival_ns.tolist() == [T0 + 50_000_000]
    assert np.array_equal(fix.pose[0], match.pose)
    assert np.array_equal(fix.cov[0], match.cov)


def test_the_height_of_the_body_does_not_matter(matcher: Matcher, sample: Sample, vector_map: MapFile) -> None:
    plain = matcher(frame_of(sample), vector_map, off(sample.T_map_body), ground_m=sample.ground_m)
    T = off(sample.T_map_body).copy()
    T[:3, 3] -= T[:3, :3] @ LOW
    ground = sample.ground_m + LOW[2]
    lower = matcher(frame_of(sample, LOW), vector_map, T, ground_m=ground)
    expected = plain.T_map_body.copy()
    expected[:3, 3] -= expected[:3, :3] @ LOW
    assert np.allclose(lower.T_map_body, expected, atol=1e-3)
    assert np.allclose(lower.cov, plain.cov, rtol=1e-2, atol=1e-7)
    assert lower.T_body_lifted[2, 3] == pytest.approx(0.5 + ground)
    seen = matcher(frame_of(sample, LOW), vector_map, T)
    assert seen.T_body_lifted[2, 3] == pytest.approx(0.5 + ground, abs=0.1)
    assert np.abs(seen.pose - planar_of(expected))[:2].max() < 0.05


def test_without_a_map_points_or_landmarks_there_is_no_fix(
    matcher: Matcher, sample: Sample, vector_map: MapFile, tmp_path: Path
) -> None:
    bare = stored(replace(sample, elements=made(), surfels=NO_SURFELS), tmp_path / "bare.parquet")
    T = sample.T_map_body
    blind = Frame(T0, T0, (Sweep(np.empty((0, 3), np.float32)),))
    for frame, where, reason in (
        (frame_of(sample), bare, NO_LANDMARKS),
        (blind, vector_map, NO_DATA),
        (Frame(T0, T0), vector_map, NO_DATA),
    ):
        match = matcher(frame, where, T)
        assert match.reason == reason
        assert np.array_equal(match.T_map_body, T)
        assert np.isinf(np.diag(match.cov)).all()
        assert np.isnan(match.modes).all()
        assert not match.weights.any()
        assert len(match.fix()) == 0


def test_a_prior_narrows_the_search_only(matcher: Matcher, sample: Sample, vector_map: MapFile) -> None:
    near = sample.T_map_body @ np.linalg.inv(planar(np.array((0.3, -0.2, 0.004))))
    wide = matcher(frame_of(sample), vector_map, near)
    narrow = matcher(frame_of(sample), vector_map, near, search=np.array((1.5, 1.5, np.radians(1.5))))
    assert np.allclose(narrow.pose, wide.pose, atol=0.02)
    assert narrow.output is not None
    assert narrow.output.estimate.levels[0].log_p.isneginf().any()  # type: ignore[union-attr]


def test_what_cannot_be_used_is_refused(matcher: Matcher, sample: Sample, vector_map: MapFile, tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="T_map_init: expected a rigid transform"):
        matcher(frame_of(sample), vector_map, 2.0 * sample.T_map_body)
    with pytest.raises(EgolocError, match=r"T_map_init: expected shape \(4, 4\), got \(3, 3\)"):
        matcher(frame_of(sample), vector_map, np.eye(3))
    for search in ((np.nan, 1.0, 1.0), (1.0, 0.0, 1.0), (1.0, 1.0)):
        with pytest.raises(EgolocError, match="search: expected three numbers above 0"):
            matcher(frame_of(sample), vector_map, sample.T_map_body, search=search)
    regressing = msgspec.structs.replace(PRESETS["small-lidar"], ablation=Ablation(solver="regression"))
    save_weights(EgoVM(regressing), regressing, tmp_path / "a6.safetensors")
    with pytest.raises(EgolocError, match=r"a6.safetensors: ablation: solver: expected histogram"):
        Matcher(tmp_path / "a6.safetensors")


@pytest.mark.parametrize("seen", ["both", "image", "black image", "points"])
def test_a_network_with_cameras_takes_what_a_frame_has(
    seen: str, sample: Sample, vector_map: MapFile, tmp_path: Path
) -> None:
    """Untrained: no more is asked than a fix that states a covariance, one way or the other."""
    torch.manual_seed(1)
    save_weights(EgoVM(TINY), TINY, tmp_path / "tiny.safetensors")
    matcher = Matcher(tmp_path / "tiny.safetensors")
    taken = image(T0, "ahead", "rgb8", T_body_camera=AHEAD)
    if seen == "black image":
        taken = replace(taken, data=bytes(len(taken.data)))
    frame = replace(
        frame_of(sample),
        sweeps=frame_of(sample).sweeps if seen in {"both", "points"} else (),
        images=() if seen == "points" else (taken,),
    )
    match = matcher(frame, vector_map, sample.T_map_body, ground_m=sample.ground_m)
    assert match.found
    assert np.isfinite(match.pose).all()
    assert (np.linalg.eigvalsh(match.cov) > 0.0).all()
    assert len(match.fix()) == 1
