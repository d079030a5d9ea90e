"""What is drawn of a match: places, histograms, colours, strokes in images."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from egovm.dataset import planar
from egovm.lattice import candidates, compose
from egovm.match import planar_of
from replay.match_drawing import ends_at, error_of, estimated_offset, offset_of, sigmas, title
from replay.match_images import on_image
from replay.match_levels import (
    basis_of,
    coloured,
    ellipse,
    estimate_of,
    histograms,
    planes_of,
    semantic_colours,
    shares,
)
from sensors.maps.vector_map import Kind
from tests.egovm.made_map import made
from tests.replay.matches import GROUND_M, NO_WALL, PLACE, POLE_M, Around, camera, frame, pictured

TILT = np.array([[1.0, 0.0, 0.0], [0.0, 0.995, -0.0998749], [0.0, 0.0998749, 0.995]])


def test_pieces_at_the_estimate_are_those_of_the_map_seen_from_there() -> None:
    match = pictured().match
    T = np.linalg.inv(match.T_map_body @ match.T_body_lifted) @ match.T_map_init @ match.T_body_lifted
    xyz = match.pieces.ends.astype(np.float64)
    placed = np.concatenate((xyz, np.ones((*xyz.shape[:2], 1))), axis=2) @ T.T
    np.testing.assert_allclose(ends_at(match.pieces, estimated_offset(match)), placed[..., :3], atol=1e-6)
    assert np.hypot(*(placed[..., :2] - xyz[..., :2]).reshape(-1, 2).T).max() > 0.05  # it did move
    np.testing.assert_array_equal(ends_at(match.pieces, np.zeros(3)), xyz)


def test_offsets_undo_what_the_matcher_does_under_roll_and_pitch() -> None:
    match = pictured().match
    T_map_init = match.T_map_init.copy()
    T_map_init[:3, :3] = T_map_init[:3, :3] @ TILT
    given = np.array((1.2, -0.7, 0.05))
    tilted = replace(match, T_map_init=T_map_init)
    np.testing.assert_allclose(offset_of(tilted, planar_of(T_map_init @ planar(given))), given, atol=1e-8)


def test_histograms_keep_mass_mean_and_yaw_of_their_levels() -> None:
    match = pictured().match
    estimate = estimate_of(match)
    assert estimate is not None
    for level, found in zip(estimate.levels, histograms(match), strict=True):
        poses = compose(
            level.centre[0].double(), candidates(level.window.lattice, level.window.level, torch.zeros(()).double())
        )
        p = level.log_p[0].double().exp()
        expected = (p[..., None] * poses).sum((0, 1, 2)).numpy()
        assert found.xy.sum() == pytest.approx(1.0, abs=1e-6)
        assert found.yaw_mass.sum() == pytest.approx(1.0, abs=1e-6)
        assert found.xy.sum(axis=1) @ found.forward == pytest.approx(expected[0], abs=1e-6)
        assert found.xy.sum(axis=0) @ found.left == pytest.approx(expected[1], abs=1e-6)
        assert found.yaw_mass @ found.yaw == pytest.approx(expected[2], abs=1e-6)
        np.testing.assert_allclose(found.mean, expected, atol=1e-5)
    np.testing.assert_allclose(histograms(match)[-1].mean, estimated_offset(match), atol=1e-5)


def test_an_ellipse_lies_two_sigmas_from_its_mean() -> None:
    found = histograms(pictured().match)[0]
    away = ellipse(found) - found.mean[:2]
    squared = np.einsum("ni,ij,nj->n", away, np.linalg.inv(found.cov[:2, :2]), away)
    np.testing.assert_allclose(squared, 4.0, rtol=1e-6)


def test_frames_like_each_other_get_colours_like_each_other_and_what_is_rare_is_bright() -> None:
    random = np.random.default_rng(1)
    mixing = random.normal(size=(6, 8))
    pictures = []
    for _ in range(2):
        sources = 0.1 * random.normal(size=(6, 64, 64)) * np.array((2.0, 1.0, 0.5, 0.1, 0.1, 0.1))[:, None, None]
        sources[0, :, 30:33] += 3.0
        sources[1, 10:14] -= 2.0
        plane = np.tensordot(mixing.T, sources, 1).astype(np.float32)
        pictures.append(coloured(plane, basis_of([plane])).astype(int))
    assert np.abs(pictures[0] - pictures[1])[..., :2].mean() < 20.0
    assert pictures[0][:, 31, 0].mean() > pictures[0][20:, :28, 0].mean() + 100.0


def test_cells_have_the_colour_of_their_likeliest_kind_as_bright_as_it_is_probable() -> None:
    logits = torch.full((7, 8, 8), -9.0)
    logits[Kind.POLE, 2, 3], logits[Kind.CROSSING, 5] = 3.0, 0.0
    colours, brightest = semantic_colours(logits)
    assert brightest == pytest.approx(1.0 / (1.0 + np.exp(-3.0)), abs=0.03)
    assert colours[2, 3].tolist() == [255, 255, 255]
    assert (colours[5, 0] == colours[5, 7]).all()
    assert colours[5, 0, 1] == pytest.approx(181 * 0.5 / brightest, abs=1.5)
    assert colours[0, 0].max() <= 1


def test_shares_of_the_score_are_the_networks() -> None:
    match = pictured().match
    last = shares(match)[-1]
    assert np.abs(last.percent).sum() == pytest.approx(100.0)
    np.testing.assert_allclose(last.percent / np.abs(match.contribution).sum() ** -1 / 100.0, match.contribution)


def test_figures_of_a_match() -> None:
    seen = pictured()
    match, truth = seen.match, seen.truth
    assert truth is not None
    c, s = np.cos(match.pose[2]), np.sin(match.pose[2])
    along: NDArray[np.float64] = np.array((c, s))
    assert sigmas(match)[0] == pytest.approx(np.sqrt(along @ match.cov[:2, :2] @ along))
    off = np.linalg.inv(planar(truth)) @ planar(match.pose)
    np.testing.assert_allclose(
        error_of(match, truth), (off[0, 3], off[1, 3], np.arctan2(off[1, 0], off[0, 0])), atol=1e-6
    )
    first, second = title(seen)
    forward, left, yaw = estimated_offset(match)
    assert f"offset {forward:+.3f} m forward, {left:+.3f} m left, {np.degrees(yaw):+.3f}°" in first
    assert "error" in second
    assert f"landmarks {'/'.join(map(str, match.landmarks))} of {len(match.pieces)}" in second
    assert "error" not in title(pictured(known=False))[1]


def test_pieces_appear_in_an_image_where_they_stand() -> None:
    seen = pictured(seen=frame(images=(camera(),)))
    assert seen.frame is not None
    (image,) = seen.frame.images
    match, offset = seen.match, np.array((0.3, -0.2, 0.03))
    strokes = on_image(seen, image, offset)
    T_body_map = np.linalg.inv(
        match.T_map_init @ match.T_body_lifted @ planar(offset) @ np.linalg.inv(match.T_body_lifted)
    )
    pole = strokes.pixels[match.pieces.type[strokes.piece] == Kind.POLE].reshape(-1, 2)
    foot = (T_body_map @ (*(PLACE + (3.9, 1.0)), 0.0, 1.0))[:3] * (1.0, 1.0, 0.0) + (0.0, 0.0, GROUND_M)  # noqa: RUF005
    expected = image.seen(np.stack((foot, foot + np.array((0.0, 0.0, POLE_M))))).pixels
    assert len(pole) > 10
    np.testing.assert_allclose(pole[:, 0], expected[0, 0], atol=1e-3)  # upright in a level camera
    parts = (pole[:, 1] - expected[0, 1]) / (expected[1, 1] - expected[0, 1]) * 16
    np.testing.assert_allclose(parts, np.rint(parts), atol=1e-3)
    assert (match.pieces.ends[strokes.piece][:, :, 0].max(axis=1) > 1.0).all()  # the camera looks on from 1.5 m ahead


def test_nothing_is_found_without_map_or_data() -> None:
    empty = pictured(around=Around(made(), NO_WALL))
    assert title(empty)[0].endswith("no fix, no landmarks")
    assert title(empty)[1].startswith("landmarks 0/0/0 of 0")
    assert np.isinf(sigmas(empty.match)).all()
    assert not np.nan_to_num(shares(empty.match)[0].percent).any()
    blind = pictured(seen=frame(points=0))
    assert blind.match.output is None
    assert (histograms(blind.match), shares(blind.match), planes_of(blind.match)) == ([], [], [])
    assert title(blind)[0].endswith("no fix, no points and no images")
