"""A match as a picture: which panels it has, and what stands where in them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from numpy.typing import NDArray
from PIL import Image as Pillow

from egovm.batch import SURFEL
from replay.match_drawing import COLOURS, Pictured, ends_at, estimated_offset
from replay.match_picture import draw_match, figure_of
from sensors.errors import EgolocError
from sensors.maps.vector_map import Kind
from tests.egovm.made_map import made
from tests.replay.matches import CAMERA, NO_WALL, Around, camera, frame, pictured

LEVELS = range(3)


def panels(seen: Pictured) -> dict[str, Any]:
    """Axes by title; those without one are left out."""
    found = {axes.get_title(loc="left"): axes for axes in figure_of(seen).get_axes()}
    return {name: axes for name, axes in found.items() if name}


def starting(found: dict[str, Any], *beginnings: str) -> list[Any]:
    return [axes for name, axes in found.items() for beginning in beginnings if name.startswith(beginning)]


@pytest.fixture(scope="module")
def whole() -> Pictured:
    return pictured(seen=frame(images=(camera(),)))


@pytest.fixture(scope="module")
def found(whole: Pictured) -> dict[str, Any]:
    return panels(whole)


def test_the_panels_of_a_whole_match(found: dict[str, Any]) -> None:
    sorts = ("Features", "Semantic map", "Share of the score", "Histogram")
    assert [len(starting(found, sort)) for sort in sorts] == [3, 3, 3, 3]
    assert {"Map at the initial pose", "Map at the estimated pose"} <= set(found)
    assert {"ahead, initial pose", "ahead, estimated pose"} <= set(found)
    assert len(starting(found, *sorts, "Map at", "ahead")) + 1 == len(found)  # and the points
    for axes in starting(found, "Features", "Semantic map", "Share", "Map at"):
        assert axes.get_aspect() == 1.0
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("left, m", "forward, m")
        right, left = sorted(axes.get_xlim())
        assert axes.get_xlim() == (left, right)  # left is left


def test_segments_are_drawn_where_they_lie(whole: Pictured, found: dict[str, Any]) -> None:
    for title, offset in (("initial", np.zeros(3)), ("estimated", estimated_offset(whole.match))):
        check_pieces(found[f"Map at the {title} pose"], whole, offset)


def check_pieces(axes: Any, seen: Pictured, offset: NDArray[np.float64]) -> None:
    pieces = seen.match.pieces
    drawn = {to_hex(c.get_color()[0]): c for c in axes.collections if isinstance(c, LineCollection)}
    ends = ends_at(pieces, offset)
    for kind in (Kind.LANE_LINE, Kind.STOP_LINE):
        expected = ends[pieces.type == kind][:, :, 1::-1]
        np.testing.assert_allclose(np.array(drawn[COLOURS[kind]].get_segments()), expected)
    marks = [c.get_offsets() for c in axes.collections if not isinstance(c, LineCollection)]
    for kind in (Kind.POLE, Kind.SIGN, SURFEL):
        expected = ends[pieces.type == kind][:, 0, 1::-1]
        assert len(expected)
        assert any(len(mark) == len(expected) and np.allclose(mark, expected) for mark in marks)


def test_a_histogram_is_drawn_to_scale(whole: Pictured, found: dict[str, Any]) -> None:
    (axes,) = starting(found, "Histogram 2")
    (shown,) = axes.get_images()
    left_begin, left_end, begin, end = shown.get_extent()
    mass = shown.get_array()
    step = (end - begin) / len(mass)
    assert step == pytest.approx(0.125)
    forward = begin + step * (np.arange(len(mass)) + 0.5)
    left = left_begin + step * (np.arange(len(mass)) + 0.5)
    assert left_end == pytest.approx(left[-1] + step / 2)
    offset = estimated_offset(whole.match)
    assert (mass.sum(axis=1) @ forward, mass.sum(axis=0) @ left) == pytest.approx(tuple(offset[:2]), abs=1e-5)


def test_what_there_is_not_is_left_out(tmp_path: Path) -> None:
    assert not starting(panels(pictured(semantics=False)), "Semantic map")
    blind = panels(pictured(seen=frame(points=0)))
    assert set(blind) == {"no points", "Map at the initial pose"}
    lost = pictured(around=Around(made(), NO_WALL))
    assert lost.match.reason == "no landmarks"
    assert "Map at the estimated pose: none" in panels(lost)
    draw_match(pictured(seen=frame(points=0)), tmp_path / "blind.png")
    assert (tmp_path / "blind.png").stat().st_size > 1000
    seeing = pictured(CAMERA, frame(points=0, images=(camera(),)), semantics=False)
    assert len(starting(panels(seeing), "no points", "Histogram", "Features")) == 7


def test_a_picture_is_written_whole_or_not_at_all(whole: Pictured, tmp_path: Path) -> None:
    draw_match(whole, tmp_path / "m.png")
    with Pillow.open(tmp_path / "m.png") as drawn:
        assert drawn.width > 2000
        seen = {tuple(colour) for colour in np.asarray(drawn.convert("RGB")).reshape(-1, 3)[::3].tolist()}
    for kind in (Kind.LANE_LINE, Kind.SIGN):
        assert tuple(int(COLOURS[kind][i : i + 2], 16) for i in (1, 3, 5)) in seen
    with pytest.raises(EgolocError, match=r"absent/m.png: cannot be written"):
        draw_match(pictured(seen=frame(points=0)), tmp_path / "absent/m.png")
    assert [path.name for path in tmp_path.iterdir()] == ["m.png"]
