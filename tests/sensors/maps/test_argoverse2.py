"""Argoverse 2 maps: each rule on a small file, the real logs against a count of their own, and damaged files."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map
from sensors.maps.argoverse2 import CITIES, read
from sensors.maps.placing import LOCAL
from sensors.maps.vector_map import Colour, Floats, Kind, Style

NAME = "log_map_archive_x____MIA_city_1.json"
Point = tuple[float, ...]


def points(*at: Point) -> list[dict[str, float]]:
    return [dict(zip("xyz", point, strict=False)) for point in at]


def lane(
    key: int, left: tuple[Point, ...], right: tuple[Point, ...], marks: tuple[str, str] = ("NONE", "NONE")
) -> dict[str, Any]:
    return {
        "id": key,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": points(*left),
        "right_lane_boundary": points(*right),
        "left_lane_mark_type": marks[0],
        "right_lane_mark_type": marks[1],
    }


def archive(
    folder: Path,
    *lanes: dict[str, Any],
    areas: tuple[tuple[Point, ...], ...] = (),
    crossings: tuple[dict[str, Any], ...] = (),
    name: str = NAME,
) -> Path:
    content = {
        "lane_segments": {str(one["id"]): one for one in lanes},
        "pedestrian_crossings": {str(one["id"]): one for one in crossings},
        "drivable_areas": {str(i): {"id": i, "area_boundary": points(*area)} for i, area in enumerate(areas)},
    }
    (folder / name).write_text(json.dumps(content))
    return folder / name


NORTH, MIDDLE, SOUTH = (((0.0, y, 1.0), (100.0, y, 1.0)) for y in (4.0, 0.0, -4.0))


@pytest.mark.parametrize(
    ("mark", "left", "right", "colour"),
    [
        ("SOLID_WHITE", Style.SOLID, Style.SOLID, Colour.WHITE),
        ("DASHED_YELLOW", Style.DASHED, Style.DASHED, Colour.YELLOW),
        ("SOLID_BLUE", Style.SOLID, Style.SOLID, Colour.BLUE),
        ("DOUBLE_SOLID_YELLOW", Style.DOUBLE_SOLID, Style.DOUBLE_SOLID, Colour.YELLOW),
        ("DOUBLE_DASH_WHITE", Style.DOUBLE_DASHED, Style.DOUBLE_DASHED, Colour.WHITE),
        ("SOLID_DASH_YELLOW", Style.DASHED_SOLID, Style.SOLID_DASHED, Colour.YELLOW),
        ("DASH_SOLID_WHITE", Style.SOLID_DASHED, Style.DASHED_SOLID, Colour.WHITE),
        ("NONE", Style.VIRTUAL, Style.VIRTUAL, Colour.UNKNOWN),
        ("UNKNOWN", Style.UNKNOWN, Style.UNKNOWN, Colour.UNKNOWN),
    ],
)
def test_mark_types_are_styles_told_from_the_lane_outwards(
    tmp_path: Path, mark: str, left: Style, right: Style, colour: Colour
) -> None:
    found, left_out = read(archive(tmp_path, lane(1, NORTH, SOUTH, (mark, mark))))
    assert found.elements.style.tolist() == [left, right]
    assert found.elements.colour.tolist() == [colour, colour]
    assert left_out == ()


def test_a_shared_boundary_comes_once_with_its_paint_also_against_the_lane(tmp_path: Path) -> None:
    here = lane(1, NORTH, MIDDLE, ("SOLID_WHITE", "SOLID_DASH_YELLOW"))
    same_way = lane(2, MIDDLE, SOUTH, ("DASH_SOLID_YELLOW", "NONE"))
    found, left_out = read(archive(tmp_path, here, same_way))
    assert found.elements.style.tolist() == [Style.SOLID, Style.SOLID_DASHED, Style.VIRTUAL]
    assert left_out == ()
    oncoming = lane(2, MIDDLE[::-1], NORTH[::-1], ("SOLID_DASH_YELLOW", "SOLID_WHITE"))
    found, _ = read(archive(tmp_path, oncoming))
    # seen along +x, this lane lies left of its left boundary's line: the solid one is there
    assert found.elements.style[0] == Style.SOLID_DASHED
    assert found.elements.vertices(0)[0, 0] == 0.0


def test_lanes_side_by_side_are_one_road_and_bicycle_lanes_are_none(tmp_path: Path) -> None:
    bicycles = lane(3, SOUTH, ((0.0, -6.0, 1.0), (100.0, -6.0, 1.0)))
    bicycles["lane_type"] = "BIKE"
    found, _ = read(archive(tmp_path, lane(1, NORTH, MIDDLE), lane(2, SOUTH[::-1], MIDDLE[::-1]), bicycles))
    assert found.road_km == pytest.approx(0.1, abs=1e-12)


def test_painted_wins_where_two_lanes_disagree_and_unknown_marks_are_counted(tmp_path: Path) -> None:
    one, other = lane(1, NORTH, MIDDLE, ("WAVY_PINK", "NONE")), lane(2, MIDDLE, SOUTH, ("SOLID_WHITE", "NONE"))
    found, left_out = read(archive(tmp_path, one, other))
    assert found.elements.style.tolist() == [Style.UNKNOWN, Style.SOLID, Style.VIRTUAL]
    assert {item.reason.split(":")[0]: item.count for item in left_out} == {
        "mark types WAVY_PINK": 1,
        "paint that one of a boundary's two lanes names otherwise": 1,
    }


@pytest.mark.parametrize("turn", [1, -1])
def test_a_crossing_is_the_ring_of_its_edges(tmp_path: Path, turn: int) -> None:
    edges = points((0, 0, 1), (10, 0, 1)), points((0, 3, 1), (10, 3, 1))[::turn]
    crossing = {"id": 7, "edge1": edges[0], "edge2": edges[1]}
    found, _ = read(archive(tmp_path, lane(1, NORTH, SOUTH), crossings=(crossing,)))
    ring = found.elements.vertices(int(np.argmax(found.elements.kind == Kind.CROSSING)))
    np.testing.assert_array_equal(ring[:, :2], [(0, 0), (10, 0), (10, 3), (0, 3), (0, 0)])


def boundary_m(found: Floats) -> float:
    return float(np.hypot(*np.diff(found[:, :2], axis=0).T).sum())


@pytest.mark.parametrize("begin", [90.0, 100.0, 100.05])
def test_areas_that_overlap_or_adjoin_have_no_edge_across_the_road(tmp_path: Path, begin: float) -> None:
    areas = [((a, -5.0), (b, -5.0), (b, 5.0), (a, 5.0)) for a, b in ((0.0, 100.0), (begin, 200.0))]
    found, left_out = read(archive(tmp_path, lane(1, NORTH, SOUTH), areas=tuple(areas)))
    parts = [found.elements.vertices(row) for row in np.flatnonzero(found.elements.kind == Kind.ROAD_BOUNDARY)]
    assert sum(map(boundary_m, parts)) == pytest.approx(420.0, abs=0.2)
    edges = np.concatenate([0.5 * (part[1:] + part[:-1]) for part in parts])
    across = (np.abs(edges[:, 1]) < 4.9) & (edges[:, 0] > 1.0) & (edges[:, 0] < 199.0)
    assert not across.any()
    assert left_out[0].count == 2


def test_an_area_alone_stays_a_closed_ring(tmp_path: Path) -> None:
    area = ((0.0, -5.0, 1.0), (100.0, -5.0, 1.0), (100.0, 5.0, 1.0))
    found, left_out = read(archive(tmp_path, lane(1, NORTH, SOUTH), areas=(area,)))
    np.testing.assert_array_equal(found.elements.vertices(2), [*area, area[0]])
    assert left_out == ()


def test_missing_heights_come_from_the_ground_raster(tmp_path: Path) -> None:
    raster = np.full((20, 30), np.nan, np.float16)
    raster[4, 6] = 17.5
    np.save(tmp_path / "x_ground_height_surface____MIA.npy", raster)
    (tmp_path / "x___img_Sim2_city.json").write_text('{"R": [1, 0, 0, 1], "t": [-100, -200], "s": 2.0}')
    left = ((103.2, 202.1), (150.0, 202.0))
    found, _ = read(archive(tmp_path, lane(1, left, ((103.2, 198.0, 3.0), (150.0, 198.0, 4.0)))))
    np.testing.assert_array_equal(found.elements.xyz[:, 2], (17.5, np.nan, 3.0, 4.0))


def test_a_city_has_a_place_and_any_other_file_is_local(tmp_path: Path) -> None:
    found, _ = read(archive(tmp_path, lane(1, NORTH, SOUTH)))
    zone, lat, lon = CITIES["MIA"]
    origin = np.degrees(llh_from_map(found.frame, np.zeros((1, 3))))[0]
    assert found.frame.zone == zone
    np.testing.assert_allclose(origin[:2], (lat, lon), atol=1e-9)
    moved, _ = read(archive(tmp_path, lane(1, NORTH, SOUTH)), MapFrame("utm", (580e3, 2850e3, -5.0), 17))
    shift = moved.elements.xyz - found.elements.xyz
    np.testing.assert_allclose(shift, np.tile((560.00879, 959.99989, 6.0 - 1.0), (4, 1)), atol=1e-4)
    path = archive(tmp_path, lane(1, NORTH, SOUTH), name="log_map_archive_y.json")
    assert read(path)[0].frame == LOCAL
    with pytest.raises(EgolocError, match="unknown city: has only local coordinates"):
        read(path, MapFrame("utm", zone=17))


def test_another_citys_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="lies in UTM zone 17N, the map asked for is in zone 18N"):
        read(archive(tmp_path, lane(1, NORTH, SOUTH)), MapFrame("utm", zone=18))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '"x": 0.0',
            '"x": "zero"',
            r"Expected `float`, got `str` - at `\$.lane_segments\[...\].left_lane_boundary\[0\].x`",
        ),
        ('"x": 0.0', '"x": NaN', "expected JSON: "),
        ('"x": 0.0', '"x": 1e999', "out of range|expected JSON"),
        ('"lane_segments"', '"lanes"', "missing required field `lane_segments`"),
        (
            '"left_lane_boundary": [',
            '"left_lane_boundary": [], "old": [',
            "lane 1 left: expected two points or more, got 0",
        ),
        ("{", "<osm>", "expected JSON"),
    ],
)
def test_a_damaged_file_is_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = archive(tmp_path, lane(1, NORTH, SOUTH))
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(EgolocError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_folder_without_one_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match=r"expected one log_map_archive_\*.json .*, got 0"):
        read(tmp_path)


@pytest.fixture(params=["3b3570b4-7b0b-3268-a571-b0889dbf40b6", "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"])
def log(request: pytest.FixtureRequest, data: Path) -> Path:
    return data / "av2" / str(request.param)


def raw(log: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(next(log.glob("map/log_map_archive_*.json")).read_text())
    return content


def test_real_logs_come_in_without_loss(log: Path) -> None:
    found, left_out = read(log)
    content = raw(log)
    marks: dict[frozenset[Point], set[str]] = {}
    for segment in content["lane_segments"].values():
        for side in ("left", "right"):
            key = frozenset((point["x"], point["y"]) for point in segment[f"{side}_lane_boundary"])
            marks.setdefault(key, set()).add(segment[f"{side}_lane_mark_type"])
    assert all(len(names) == 1 for names in marks.values())
    expected = Counter(names.pop() for names in marks.values())
    styles = {"NONE": Style.VIRTUAL, "SOLID": Style.SOLID, "DASHED": Style.DASHED}
    lines = found.elements.chosen(found.elements.kind == Kind.LANE_LINE)
    got = Counter(zip(lines.style.tolist(), lines.colour.tolist(), strict=True))
    for mark, count in expected.items():
        style, _, colour = mark.partition("_")
        assert got.pop((styles[style], Colour[colour or "UNKNOWN"])) == count
    assert not got
    assert (found.elements.kind == Kind.CROSSING).sum() == len(content["pedestrian_crossings"])
    assert [item.reason.split(":")[0] for item in left_out] == ["drivable areas"]


def test_heights_of_real_logs_lie_on_their_ground_raster(log: Path, tmp_path: Path) -> None:
    found, _ = read(log)
    for source in (log / "map").iterdir():
        text = source.read_bytes()
        if source.name.startswith("log_map_archive_"):
            content = raw(log)
            for segment in content["lane_segments"].values():
                for point in segment["left_lane_boundary"] + segment["right_lane_boundary"]:
                    del point["z"]
            text = json.dumps(content).encode()
        (tmp_path / source.name).write_bytes(text)
    filled, _ = read(tmp_path)
    lines = filled.elements.kind.repeat(np.diff(filled.elements.first)) == Kind.LANE_LINE
    difference = (filled.elements.xyz - found.elements.xyz)[lines, 2]
    assert np.isfinite(difference).mean() > 0.95
    assert np.nanpercentile(np.abs(difference), 95) < 0.3


def test_no_boundary_runs_across_a_lane_between_areas_of_the_miami_log(data: Path) -> None:
    log = data / "av2/3b3570b4-7b0b-3268-a571-b0889dbf40b6"
    found, _ = read(log)
    edges = [found.elements.vertices(row) for row in np.flatnonzero(found.elements.kind == Kind.ROAD_BOUNDARY)]
    for segment in raw(log)["lane_segments"].values():
        middle = 0.5 * sum(_resampled(segment[f"{side}_lane_boundary"]) for side in ("left", "right"))
        a, b = middle[:-1, None], middle[1:, None]
        for edge in edges:
            p, q = edge[None, :-1, :2], edge[None, 1:, :2]
            apart = np.sign(_cross(q - p, a - p)) * np.sign(_cross(q - p, b - p)) < 0
            across = np.sign(_cross(b - a, p - a)) * np.sign(_cross(b - a, q - a)) < 0
            assert not (apart & across).any(), segment["id"]


def _resampled(line: list[dict[str, float]]) -> Floats:
    """(20, 2) points at even distances."""
    xy = np.array([(point["x"], point["y"]) for point in line])
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))))
    return np.column_stack([np.interp(np.linspace(0.0, along[-1], 20), along, column) for column in xy.T])


def _cross(u: Floats, v: Floats) -> Floats:
    result: Floats = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return result
