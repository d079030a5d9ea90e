"""The map around a pose as the network takes it."""

import logging
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from egovm.batch import SURFEL
from egovm.config import PAPER, Ablation, BevConfig, LatticeConfig, MatchingConfig, NetworkConfig
from egovm.map_elements import Pieces, padded, pieces_around, places_of, usable_half_m
from egovm.solver_window import dot_window
from sensors.errors import EgolocError
from sensors.maps.vector_map import NO_ELEMENTS, NO_SURFELS, Elements, Kind, Style, Surfels
from tests.egovm.made_map import made
from tests.egovm.test_projection import UTM, pose

GROUND_M = -1.8


def around(
    elements: Elements, surfels: Surfels = NO_SURFELS, config: NetworkConfig = PAPER, yaw: float = 0.0
) -> Pieces:
    return pieces_around(elements, surfels, pose(0.0, 0.0, yaw, np.zeros(3)), config, GROUND_M)


def patches(p: np.ndarray, normal: np.ndarray) -> Surfels:
    count = len(p)
    return Surfels(np.asarray(p, float), np.full(count, 2.0), np.asarray(normal, float), np.full((count, 2), 0.05))


def test_segments_turn_into_the_vehicles_axes_nearest_first() -> None:
    found = around(made((Kind.LANE_LINE, [(0, 20), (0, 28)]), (Kind.STOP_LINE, [(-2, 6), (2, 6)])), yaw=90.0)
    assert found.type.tolist() == [Kind.STOP_LINE, Kind.LANE_LINE, Kind.LANE_LINE]
    assert found.ends[:, :, 2].tolist() == [[0.0, 0.0]] * 3
    expected = [[(6, 2), (6, -2)], [(20, 0), (24, 0)], [(24, 0), (28, 0)]]
    assert np.allclose(found.ends[:, :, :2], expected, atol=1e-5)
    assert found.ends.dtype == np.float32
    assert found.left_out == 0


def test_points_have_heights_of_their_own() -> None:
    face = [(10, -1, 3.2), (10, 1, 3.2), (10, 1, 4.2), (10, -1, 4.2), (10, -1, 3.2)]
    found = around(
        made(
            (Kind.LANE_LINE, [(30, 0, 1.0), (33, 0, 1.0)]),
            (Kind.ROAD_BOUNDARY, [(9, 5, 0.5), (12, 5, 0.5)]),
            (Kind.POLE, [(3, 4, 0.0), (3.1, 4, 6.0)]),
            (Kind.POLE, [(6, 0, np.nan)]),
            (Kind.SIGN, face),
            (Kind.SIGN, [(20, 3, np.nan)]),
            (Kind.SIGN, face, Style.VIRTUAL),
        )
    )
    points = found.type >= Kind.POLE
    assert found.type[points].tolist() == [Kind.POLE, Kind.POLE, Kind.SIGN, Kind.SIGN]
    assert np.allclose(found.ends[points][:, :, :2], [[(3, 4)] * 2, [(6, 0)] * 2, [(10, 0)] * 2, [(20, 3)] * 2])
    assert found.height[points] == pytest.approx((6.0, 0.0, 3.7 - 0.5, 0.0))  # above the nearest line's height
    assert found.ends[points][:, 0, 2] == pytest.approx((0.0, 0.0, 3.2, 0.0))
    assert not found.height[~points].any()


def test_walls_face_the_vehicle_slopes_up_and_level_ground_is_left_out() -> None:
    surfels = patches(
        np.array([(10, 0), (0, -8), (5, 5), (1, 2)]),
        np.array([(1, 0, 0), (0, -0.8, 0.6), (0.6, 0, 0.8), (0.1, 0, 0.99498744)]),
    )
    found = around(NO_ELEMENTS, surfels, yaw=0.0)
    assert found.type.tolist() == [SURFEL] * 3
    assert np.allclose(found.ends[:, 0], [(5, 5, 3.8), (0, -8, 3.8), (10, 0, 3.8)])
    assert np.allclose(found.normal, [(0.6, 0, 0.8), (0, 0.8, -0.6), (-1, 0, 0)])
    assert np.allclose(found.ratios, 0.05)
    turned = around(NO_ELEMENTS, surfels, yaw=90.0)
    assert np.allclose(turned.ends[2, 0, :2], (0, -10), atol=1e-5)
    assert np.allclose(turned.normal[2], (0, 1, 0), atol=1e-6)


def test_without_surfels_there_are_none() -> None:
    a1 = msgspec.structs.replace(PAPER, ablation=Ablation(surfels=False))
    assert len(around(NO_ELEMENTS, patches(np.ones((3, 2)), np.tile((1.0, 0.0, 0.0), (3, 1))), a1)) == 0


def test_what_lies_outside_is_cut_off() -> None:
    half = usable_half_m(PAPER)
    assert half == pytest.approx((40.0 - 0.25 - 3.0) / (np.cos(np.pi / 60) + np.sin(np.pi / 60)), abs=2e-3)
    found = around(
        made(
            (Kind.LANE_LINE, [(30, 1), (half - 1, 1), (50, 1)]),  # leaves
            (Kind.STOP_LINE, [(half - 1, half + 1), (half + 1, half - 1)]),  # touches the corner
            (Kind.STOP_LINE, [(half - 1, half + 3), (half + 3, half - 1)]),  # passes by it
            (Kind.ROAD_BOUNDARY, [(60, 0), (90, 0)]),
            (Kind.ROAD_BOUNDARY, [(-90, -36), (90, -36)]),
            (Kind.POLE, [(0, half + 0.1)]),
        ),
        patches(np.array([(0, -half - 0.1), (0, 49)]), np.tile((1.0, 0.0, 0.0), (2, 1))),
    )
    assert found.type.tolist() == [Kind.LANE_LINE] * 2
    assert found.ends[-1, 1, 0] == pytest.approx(half, abs=1e-5)
    assert np.abs(found.ends[..., :2]).max() <= half + 1e-5


def test_the_solver_uses_every_piece_that_is_left() -> None:
    """Its rule is that an element lies on the map for all candidates."""
    bev = BevConfig(half_m=12.0, channels=(2, 2, 2))
    config = msgspec.structs.replace(PAPER, camera=None, bev=bev)
    grid = np.linspace(-30.0, 30.0, 41)
    found = around(made(*((Kind.STOP_LINE, [(-30, y), (30, y + 9)]) for y in grid)), config=config)
    elements = padded([found])
    embeddings = torch.zeros((*elements.valid.shape, 2))
    places = places_of(elements, config.matching)
    window = dot_window(LatticeConfig(), 0, torch.zeros(1, 2, 48, 48), embeddings, places, elements.valid)
    assert len(found) > 10
    assert window.valid.all()


def test_the_nearest_are_kept_surfels_within_their_share_and_the_rest_counted(caplog: pytest.LogCaptureFixture) -> None:
    lines = made(*((Kind.STOP_LINE, [(x, -1), (x, 1)]) for x in range(1, 9)))
    near = patches(np.column_stack((np.linspace(0.1, 0.9, 9), np.zeros(9))), np.tile((1.0, 0.0, 0.0), (9, 1)))
    config = msgspec.structs.replace(PAPER, matching=MatchingConfig(most_elements=8))
    with caplog.at_level(logging.INFO):
        found = around(lines, near, config)
    assert found.type.tolist() == [SURFEL] * 4 + [Kind.STOP_LINE] * 4
    assert np.allclose(found.ends[:, :, 0].mean(1), [0.1, 0.2, 0.3, 0.4, 1, 2, 3, 4])
    assert found.left_out == 9
    assert "9 of 17 pieces of map left out: most_elements is 8" in caplog.text
    few = around(lines.chosen(np.arange(2)), near, config)  # surfels take what others leave
    assert np.bincount(few.type)[[Kind.STOP_LINE, SURFEL]].tolist() == [2, 6]
    assert np.bincount(around(lines, near.chosen(np.arange(1)), config).type)[[Kind.STOP_LINE, SURFEL]].tolist() == [
        7,
        1,
    ]


def test_frames_are_padded_under_a_mask() -> None:
    one = around(made((Kind.STOP_LINE, [(1, 0), (3, 0)])))
    two = around(made((Kind.POLE, [(1, 1, 0), (1, 1, 4)]), (Kind.LANE_LINE, [(5, 0), (12, 0)])))
    batch = padded([one, two, around(NO_ELEMENTS)])
    assert batch.valid.tolist() == [[True, False, False], [True, True, True], [False, False, False]]
    assert batch.ends.shape == (3, 3, 2, 3)
    assert batch.type.dtype == torch.int64
    assert batch.height[1].tolist() == [4.0, 0.0, 0.0]
    assert not batch.ends[0, 1:].any()
    assert padded([one], 512).ends.shape == (1, 512, 2, 3)
    assert padded([around(NO_ELEMENTS)]).valid.tolist() == [[False]]
    with pytest.raises(ValueError, match="expected at most 2 pieces in a frame, got 3"):
        padded([two], 2)


def test_places_are_ends_middles_or_as_many_as_asked_for() -> None:
    batch = padded([around(made((Kind.STOP_LINE, [(1, 0), (3, 2)])))])
    assert places_of(batch, MatchingConfig()).tolist() == [[[[1.0, 0.0], [3.0, 2.0]]]]
    assert places_of(batch, MatchingConfig(sampled="middle")).tolist() == [[[[2.0, 1.0]]]]
    assert places_of(batch, MatchingConfig(sampled=3)).tolist() == [[[[1.0, 0.0], [2.0, 1.0], [3.0, 2.0]]]]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"segment_m": 0.0}, "segment_m: expected metres above 0, got 0"),
        ({"most_elements": 0}, "most_elements: expected 1 or more, got 0"),
        ({"surfel_share": 1.5}, "surfel_share: expected 0 to 1, got 1.5"),
        ({"sampled": 1}, "sampled: expected 2 places or more, got 1"),
    ],
)
def test_a_wrong_configuration_is_told(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(EgolocError, match=f"network: matching: {told}"):
        MatchingConfig(**wrong)


def test_pieces_do_not_depend_on_where_the_map_lies() -> None:
    drawn = (Kind.LANE_LINE, np.array([(3.0, 4.0, 0.0), (30.0, 11.0, 0.0)])), (Kind.POLE, np.array([(9.0, 2.0, 0.0)]))
    T = pose(2.0, -3.0, 40.0, np.zeros(3))
    here = pieces_around(made(*drawn), NO_SURFELS, T, PAPER, GROUND_M)
    T[:3, 3] = UTM
    there = pieces_around(made(*((kind, v + UTM) for kind, v in drawn)), NO_SURFELS, T, PAPER, GROUND_M)
    assert np.allclose(here.ends, there.ends, atol=1e-5)


def test_a_bev_that_is_narrower_than_the_search_is_told() -> None:
    with pytest.raises(EgolocError, match="half_m: expected more than the search range, got 3"):
        usable_half_m(msgspec.structs.replace(PAPER, camera=None, bev=BevConfig(half_m=3.0)))
