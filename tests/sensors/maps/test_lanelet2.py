"""Lanelet2: each rule on a small file, and damaged files."""

from pathlib import Path

import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, map_from_llh
from sensors.maps.lanelet2 import read
from sensors.maps.placing import LOCAL
from sensors.maps.vector_map import Colour, Elements, Kind, Style
from sensors.records import LeftOut

from .osm_text import lanelet, local, node, osm, relation, tags, way

SQUARE = [node(1, 0, 0), node(2, 10, 0), node(3, 10, 5), node(4, 0, 5)]


def counts(left_out: tuple[LeftOut, ...]) -> dict[str, int]:
    return {item.reason: item.count for item in left_out}


def taken(elements: Elements) -> list[tuple[Kind, Style, str]]:
    columns = zip(elements.kind, elements.style, elements.name, strict=True)
    return [(Kind(kind), Style(style), str(name)) for kind, style, name in columns]


@pytest.mark.parametrize(
    ("type", "subtype", "kind", "style"),
    [
        ("line_thin", "solid", Kind.LANE_LINE, Style.SOLID),
        ("line_thick", "dashed", Kind.LANE_LINE, Style.DASHED),
        ("line_thin", "solid_solid", Kind.LANE_LINE, Style.DOUBLE_SOLID),
        ("line_thin", "solid_dashed", Kind.LANE_LINE, Style.SOLID_DASHED),
        ("line_thin", "dashed_solid", Kind.LANE_LINE, Style.DASHED_SOLID),
        ("line_thin", "", Kind.LANE_LINE, Style.UNKNOWN),
        ("virtual", "solid", Kind.LANE_LINE, Style.VIRTUAL),
        ("bike_marking", "", Kind.LANE_LINE, Style.DASHED),
        ("road_border", "", Kind.ROAD_BOUNDARY, Style.ROAD_EDGE),
        ("curbstone", "high", Kind.ROAD_BOUNDARY, Style.CURB),
        ("guard_rail", "", Kind.ROAD_BOUNDARY, Style.BARRIER),
        ("wall", "", Kind.ROAD_BOUNDARY, Style.BARRIER),
        ("fence", "", Kind.ROAD_BOUNDARY, Style.BARRIER),
        ("stop_line", "", Kind.STOP_LINE, Style.UNKNOWN),
        ("stop_line", "solid", Kind.STOP_LINE, Style.SOLID),
        ("pedestrian_marking", "", Kind.MARKING, Style.UNKNOWN),
        ("zebra_marking", "", Kind.MARKING, Style.ZEBRA),
        ("arrow", "straight_left", Kind.MARKING, Style.ARROW),
        ("symbol", "30", Kind.MARKING, Style.UNKNOWN),
        ("traffic_sign", "de205", Kind.SIGN, Style.UNKNOWN),
        ("traffic_light", "red_yellow_green", Kind.SIGN, Style.LIGHT),
        ("pole", "", Kind.POLE, Style.UNKNOWN),
    ],
)
def test_type_and_subtype_say_kind_and_style(tmp_path: Path, type: str, subtype: str, kind: Kind, style: Style) -> None:
    found, left_out = read(osm(tmp_path / "a.osm", *SQUARE, way(9, [1, 2], type, subtype)))
    assert taken(found.elements) == [(kind, style, "way 9")]
    assert left_out == ()


def test_lat_lon_lie_in_the_utm_frame_of_the_place_and_missing_heights_stay_unknown(tmp_path: Path) -> None:
    path = osm(tmp_path / "a.osm", node(1, 0, 0, 120.5), node(2, 10, 0), way(9, [1, 2], "line_thin", "solid"))
    found, _ = read(path)
    assert (found.frame.kind, found.frame.zone, found.frame.south) == ("utm", 32, False)
    expected = map_from_llh(found.frame, np.radians([[49.0, 8.4, 0.0]]))[0, :2]
    np.testing.assert_allclose(found.elements.xyz[0, :2], expected, atol=1e-4)
    assert found.elements.xyz[0, 2] == 120.5
    assert np.isnan(found.elements.xyz[1, 2])


def test_a_frame_asked_for_is_used(tmp_path: Path) -> None:
    frame = MapFrame("enu", (49.0, 8.4, 100.0))
    found, _ = read(osm(tmp_path / "a.osm", node(1, 0, 0, 103.0), node(2, 10, 0), way(9, [1, 2], "line_thin")), frame)
    assert found.frame == frame
    np.testing.assert_allclose(found.elements.xyz[0], (0.0, 0.0, 3.0), atol=1e-3)
    np.testing.assert_allclose(found.elements.xyz[1, :2], (10.0, 0.0), atol=0.05)


def both(key: int, x: float, y: float, far: float = 0.0) -> str:
    return node(key, x + far, y, 1.0, local_x=f"{x + 5000.0}", local_y=f"{y - 300.0}")


def test_lat_lon_win_where_local_coordinates_show_the_same_shape(tmp_path: Path) -> None:
    nodes = [both(1, 0, 0), both(2, 10, 0), both(3, 10, 50)]
    found, left_out = read(osm(tmp_path / "a.osm", *nodes, way(9, [1, 2, 3], "line_thin", "solid")))
    assert found.frame.kind == "utm"
    assert left_out == ()


def test_local_coordinates_win_where_lat_lon_are_anything(tmp_path: Path) -> None:
    nodes = [both(1, 0, 0), both(2, 10, 0, far=7.0), both(3, 10, 50, far=-20.0)]
    found, left_out = read(osm(tmp_path / "a.osm", *nodes, way(9, [1, 2, 3], "line_thin", "solid")))
    assert found.frame == LOCAL
    np.testing.assert_allclose(found.elements.xyz[2], (5010.0, -250.0, 1.0))
    assert counts(left_out) == {"latitudes and longitudes that do not fit local_x and local_y": 3}


def test_a_local_map_cannot_be_brought_into_a_frame(tmp_path: Path) -> None:
    path = osm(tmp_path / "a.osm", local(1, 0, 0), local(2, 10, 0), way(9, [1, 2], "line_thin"))
    assert read(path)[0].frame == LOCAL
    with pytest.raises(EgolocError, match="without georeference"):
        read(path, MapFrame("utm", zone=32))


def test_a_face_stands_on_its_lower_edge(tmp_path: Path) -> None:
    nodes = [local(1, 0, 0, 5.0), local(2, 1, 0, 5.0)]
    found, _ = read(osm(tmp_path / "a.osm", *nodes, way(9, [1, 2], "traffic_light", height="0.5")))
    ring = [(0, 0, 5), (1, 0, 5), (1, 0, 5.5), (0, 0, 5.5), (0, 0, 5)]
    np.testing.assert_allclose(found.elements.vertices(0), ring)


def test_a_face_without_height_is_its_centre(tmp_path: Path) -> None:
    found, _ = read(osm(tmp_path / "a.osm", local(1, 0, 0, 5), local(2, 1, 0, 5), way(9, [1, 2], "traffic_sign")))
    np.testing.assert_allclose(found.elements.vertices(0), [(0.5, 0.0, 5.0)])


def test_poles_have_foot_and_top_and_posts_of_a_rail_are_no_poles(tmp_path: Path) -> None:
    nodes = [local(1, 0, 0, 8.0), local(2, 0, 0, 2.0), local(3, 9, 0)]
    post = '<node id="4" lat="" lon="">' + tags({"local_x": "5", "local_y": "0", "type": "pole"}) + "</node>"
    alone = post.replace('id="4"', 'id="5"')
    rail = way(10, [3, 4], "guard_rail")
    found, left_out = read(osm(tmp_path / "a.osm", *nodes, post, alone, way(9, [1, 2], "pole"), rail))
    assert taken(found.elements)[::2] == [
        (Kind.POLE, Style.UNKNOWN, "way 9"),
        (Kind.POLE, Style.UNKNOWN, "node 5"),
    ]
    np.testing.assert_allclose(found.elements.vertices(0)[:, 2], (2.0, 8.0))
    assert counts(left_out) == {"posts of a barrier: parts of its line": 1}


@pytest.mark.parametrize("right", [[4, 3], [3, 4]])
def test_a_crosswalk_is_the_ring_of_its_sides_once(tmp_path: Path, right: list[int]) -> None:
    sides = way(8, [1, 2], "pedestrian_marking"), way(9, right, "virtual")
    found, left_out = read(osm(tmp_path / "a.osm", *SQUARE, *sides, lanelet(20, 8, 9, "crosswalk")))
    assert taken(found.elements) == [(Kind.CROSSING, Style.UNKNOWN, "lanelet 20")]
    ring = found.elements.vertices(0)[:, :2]
    x, y = (ring - ring[0]).T
    assert abs(0.5 * (x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) == pytest.approx(50.0, rel=0.01)
    assert (ring[0] == ring[-1]).all()
    assert left_out == ()


def test_a_crosswalk_polygon_replaces_the_lanelet(tmp_path: Path) -> None:
    sides = way(8, [1, 2], "curbstone"), way(9, [4, 3], "virtual")
    outline = way(10, [1, 2, 3, 4], "crosswalk_polygon")
    members = [("way", 10, "crosswalk_polygon"), ("relation", 20, "refers")]
    rule = relation(21, members, type="regulatory_element", subtype="crosswalk")
    path = osm(tmp_path / "a.osm", *SQUARE, *sides, outline, lanelet(20, 8, 9, "crosswalk"), rule)
    found, left_out = read(path)
    assert [(kind, name) for kind, _, name in taken(found.elements)] == [
        (Kind.ROAD_BOUNDARY, "way 8"),
        (Kind.CROSSING, "way 10"),
    ]
    assert len(found.elements.vertices(1)) == 5
    assert counts(left_out)["crosswalk lanelets: their crosswalk_polygon is taken"] == 1


def test_shared_ways_come_once_untyped_bounds_are_lane_lines_and_lanes_side_by_side_are_one_road(
    tmp_path: Path,
) -> None:
    nodes = [node(key, 100 * (key % 2), 3 * (key // 2)) for key in range(2, 10)]
    ways = [way(20, [2, 3], "road_border"), way(21, [4, 5]), way(22, [6, 7], "line_thin", "solid"), way(23, [8, 9])]
    lanes = [lanelet(30, 21, 20), lanelet(31, 22, 21), lanelet(32, 22, 21, "bicycle_lane")]
    found, left_out = read(osm(tmp_path / "a.osm", *nodes, *ways, *lanes))
    assert [name for _, _, name in taken(found.elements)] == ["way 20", "way 21", "way 22"]
    assert taken(found.elements)[1][:2] == (Kind.LANE_LINE, Style.UNKNOWN)
    assert found.road_km == pytest.approx(0.1, rel=2e-3)
    assert counts(left_out) == {"ways without a type that bound no lanelet": 1}


def test_centre_lines_dash_ends_deleted_and_unknown_things_are_counted(tmp_path: Path) -> None:
    nodes = [*SQUARE, node(5, 1, 1, type="begin"), node(6, 2, 1, type="hydrant")]
    ways = [way(8, [1, 2], "line_thin", "wavy", color="mauve"), way(9, [4, 3], "line_thin", "solid", color="yellow")]
    more = [way(10, [1, 3], "line_thin", "solid"), way(11, [1, 2], "bench"), way(12, [1], "stop_line")]
    gone = '<way id="13" action="delete"><nd ref="99"/></way>'
    area = relation(31, [("way", 9, "outer")], type="multipolygon", subtype="parking")
    found, left_out = read(osm(tmp_path / "a.osm", *nodes, *ways, *more, gone, lanelet(30, 8, 9, centre=10), area))
    assert [name for _, _, name in taken(found.elements)] == ["way 8", "way 9"]
    assert found.elements.colour.tolist() == [Colour.UNKNOWN, Colour.YELLOW]
    assert sum(counts(left_out).values()) == 9
    reasons = " | ".join(counts(left_out))
    for word in (
        "wavy",
        "colours",
        "centre lines",
        "bench",
        "fewer than two",
        "deleted",
        "parking",
        "hydrant",
        "dashes",
    ):
        assert word in reasons


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ([*SQUARE, way(9, [1, 77], "line_thin")], r"line 7: <way>: way 9: expected its node 77"),
        ([*SQUARE, lanelet(20, 8, 9)], r"relation 20: expected its way 8"),
        ([node(1, float("nan"), 0), way(9, [1, 1], "line_thin")], r"line 3: <node>: lon: expected a finite number"),
        ([*SQUARE, SQUARE[0]], r"line 7: <node>: expected an id of its own, got 1"),
        (
            [local(1, 0, 0), '<node id="2" lat="" lon=""/>', way(9, [1, 2], "line_thin")],
            r"node 2: expected lat and lon",
        ),
        ([*SQUARE, way(9, [1, 2])], r"expected ways with a Lanelet2 type"),
        ([*SQUARE, way(8, [1, 2], "x"), relation(20, [("way", 8, "left")], type="lanelet")], r"1 left and 0 right"),
        ([*SQUARE, way(9, [1, 2], "pole", height="tall")], r"way 9: height: expected metres, got 'tall'"),
        (
            ['<node id="1" lat="95" lon="8"/>', way(9, [1, 1], "line_thin")],
            r"latitude and longitude in degrees, got 95",
        ),
    ],
)
def test_a_damaged_file_is_one_line(tmp_path: Path, elements: list[str], message: str) -> None:
    path = osm(tmp_path / "a.osm", *elements)
    with pytest.raises(EgolocError, match=message) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (MapFrame("utm", zone=33), r"lies in UTM zone 32N, the map asked for is in zone 33N"),
        (MapFrame("utm", zone=32, south=True), r"the map asked for is in zone 32S"),
        (MapFrame("enu", (35.0, 139.0, 0.0)), r"another place's: \d+ km from its datum"),
    ],
)
def test_another_places_frame_is_refused(tmp_path: Path, frame: MapFrame, message: str) -> None:
    with pytest.raises(EgolocError, match=message):
        read(osm(tmp_path / "a.osm", *SQUARE, way(9, [1, 2], "line_thin")), frame)


def test_an_entity_bomb_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.osm"
    bomb = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 9))
    path.write_text(f'<?xml version="1.0"?><!DOCTYPE osm [<!ENTITY e0 "ha">{bomb}]><osm>&e8;</osm>')
    with pytest.raises(EgolocError, match="document type"):
        read(path)


def test_latitudes_that_are_no_place_leave_the_local_coordinates(tmp_path: Path) -> None:
    nodes = [local(1, 0, 0), local(2, 10, 0)]
    junk = [
        text.replace('lat="" lon=""', f'lat="{lat}" lon="8.4"') for text, lat in zip(nodes, (49.0, 54.0), strict=True)
    ]
    far = [
        text.replace('lat="" lon=""', f'lat="49.0" lon="{lon}"') for text, lon in zip(nodes, (8.4, 16.4), strict=True)
    ]
    for each in (junk, far):
        found, left_out = read(osm(tmp_path / "a.osm", *each, way(9, [1, 2], "line_thin")))
        assert found.frame == LOCAL
        np.testing.assert_allclose(found.elements.xyz[:, 0], [0.0, 10.0])
        assert {row.reason for row in left_out} == {"latitudes and longitudes that do not fit local_x and local_y"}
