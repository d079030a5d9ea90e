"""Lines cut into pieces: ends on the line, equally long, corners of outlines kept."""

import numpy as np
import pytest

from egovm.polylines import line_pieces
from sensors.maps.vector_map import NO_ELEMENTS, Kind, Style
from tests.egovm.made_map import made

SQUARE = [(0, 0), (10, 0), (10, 3), (0, 3), (0, 0)]


def test_a_line_becomes_equal_pieces_as_few_as_stay_under_the_limit() -> None:
    ends, kind = line_pieces(made((Kind.LANE_LINE, [(5, 0), (6, 0), (15, 0)])), 4.0)
    assert ends[:, :, 0].tolist() == [pytest.approx(pair) for pair in ((5, 25 / 3), (25 / 3, 35 / 3), (35 / 3, 15))]
    assert kind.tolist() == [Kind.LANE_LINE] * 3
    assert len(line_pieces(made((Kind.STOP_LINE, [(0, 0), (8, 0)])), 4.0)[0]) == 2  # and not three


def test_ends_lie_on_a_bent_line_and_follow_each_other() -> None:
    angle = np.linspace(0.0, np.pi, 60)
    arc = 20.0 * np.column_stack((np.cos(angle), np.sin(angle), angle)) + (448_000.0, 5_411_000.0, 0.0)
    ends, _ = line_pieces(made((Kind.ROAD_BOUNDARY, arc)), 4.0)
    assert np.array_equal(ends[1:, 0], ends[:-1, 1])
    assert ends[0, 0] == pytest.approx(arc[0])
    assert ends[-1, 1] == pytest.approx(arc[-1])
    radius = np.hypot(*(ends[..., :2] - (448_000.0, 5_411_000.0)).T)
    assert (np.abs(radius - 20.0) < 0.01).all()  # its vertices are chords of 1 m
    assert np.hypot(*(ends[:, 1] - ends[:, 0])[:, :2].T).max() <= 4.0


def test_outlines_keep_their_corners() -> None:
    ends, _ = line_pieces(made((Kind.CROSSING, SQUARE)), 4.0)
    assert len(ends) == 3 + 1 + 3 + 1
    corners = {tuple(corner) for corner in ends[..., :2].reshape(-1, 2)}
    assert {(0.0, 0.0), (10.0, 0.0), (10.0, 3.0), (0.0, 3.0)} <= corners
    assert np.hypot(*(ends[:, 1] - ends[:, 0])[:, :2].T).sum() == pytest.approx(26.0)
    assert len(line_pieces(made((Kind.MARKING, SQUARE)), 4.0)[0]) == 8
    assert len(line_pieces(made((Kind.MARKING, SQUARE[:-1])), 4.0)[0]) == 6  # open: 23 m along it
    assert len(line_pieces(made((Kind.ROAD_BOUNDARY, SQUARE)), 4.0)[0]) == 7  # a traffic island's: 26 m along it
    assert len(line_pieces(made((Kind.ROAD_BOUNDARY, SQUARE)), 4.0, corners=True)[0]) == 8


def test_several_elements_keep_their_kinds_and_do_not_run_into_each_other() -> None:
    ends, kind = line_pieces(
        made(
            (Kind.POLE, [(1, 1, 0), (1, 1, 5)]),
            (Kind.LANE_LINE, [(0, 0), (8, 0)], Style.DASHED),
            (Kind.LANE_LINE, [(0, 50), (8, 50)], Style.VIRTUAL),
            (Kind.CROSSING, SQUARE),
            (Kind.STOP_LINE, [(0, 9)]),
            (Kind.MARKING, [(2, 2), (2, 2)]),
            (Kind.LANE_LINE, [(100, 0), (100, 3)]),
        ),
        4.0,
    )
    assert kind.tolist() == [Kind.LANE_LINE] * 2 + [Kind.CROSSING] * 8 + [Kind.LANE_LINE]
    assert ends[-1, :, :2].tolist() == [[100.0, 0.0], [100.0, 3.0]]
    assert np.hypot(*(ends[:, 1] - ends[:, 0])[:, :2].T).max() <= 4.0


def test_nothing_gives_nothing() -> None:
    ends, kind = line_pieces(NO_ELEMENTS, 4.0)
    assert ends.shape == (0, 2, 3)
    assert len(kind) == 0


def test_heights_that_are_not_known_stay_so() -> None:
    ends, _ = line_pieces(made((Kind.LANE_LINE, [(0, 0, np.nan), (8, 0, np.nan)])), 4.0)
    assert np.isnan(ends[..., 2]).all()
    assert np.isfinite(ends[..., :2]).all()
