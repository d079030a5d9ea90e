"""GeoJSON: names, rules, geometries, the way out and back, and files that are none."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.maps.builder import Builder
from sensors.maps.formats import read_map
from sensors.maps.geojson import read
from sensors.maps.geojson_out import write_geojson
from sensors.maps.placing import LOCAL
from sensors.maps.vector_map import Colour, Kind, Style, VectorMap

A, B, C = [8.4, 49.0], [8.4001, 49.0], [8.4001, 49.0001]
RING = [A, B, C, A]


def feature(geometry: Any, coordinates: Any, **properties: Any) -> dict[str, Any]:
    shape = {"type": geometry, "coordinates": coordinates}
    return {"type": "Feature", "geometry": shape, "properties": properties}


def collection(folder: Path, *features: Any, **more: Any) -> Path:
    path = folder / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features, **more}))
    return path


def test_our_names_say_what_a_feature_is(tmp_path: Path) -> None:
    line = feature("LineString", [A, [*B, 118.5]], kind="lane_line", style="dashed", colour="yellow", name="M7")
    found, left_out = read(collection(tmp_path, line, {**feature("Point", A, kind="pole"), "id": 12}))
    elements = found.elements
    assert elements.kind.tolist() == [Kind.LANE_LINE, Kind.POLE]
    assert (elements.style[0], elements.colour[0]) == (Style.DASHED, Colour.YELLOW)
    assert elements.name.tolist() == ["M7", "feature 12"]
    np.testing.assert_array_equal(elements.xyz[:, 2], (np.nan, 118.5, np.nan))
    assert np.hypot(*(elements.xyz[1] - elements.xyz[0])[:2]) == pytest.approx(7.31, abs=0.01)
    assert left_out == ()


def test_rules_give_a_gis_names_a_kind(tmp_path: Path) -> None:
    kerb, lamp = feature("LineString", [A, B], barrier="kerb"), feature("Point", A, highway="street_lamp")
    other = feature("Point", A, shop="street_lamp")
    rules = {"kerb": Kind.ROAD_BOUNDARY, "highway=street_lamp": Kind.POLE}
    found, left_out = read(collection(tmp_path, kerb, lamp, other), rules=rules)
    assert found.elements.kind.tolist() == [Kind.ROAD_BOUNDARY, Kind.POLE]
    assert [(item.reason, item.count) for item in left_out] == [
        ("features without the property kind, and no rule for it", 1)
    ]


@pytest.mark.parametrize(
    ("geometry", "coordinates", "kind", "sizes"),
    [
        ("Point", A, "sign", [1]),
        ("MultiPoint", [A, B], "pole", [1, 1]),
        ("LineString", [A, B, C], "stop_line", [3]),
        ("MultiLineString", [[A, B], [B, C]], "marking", [2, 2]),
        ("LineString", RING, "crossing", [4]),
        ("LineString", [[*A, 1.0], [*A, 4.0]], "pole", [2]),
        ("Polygon", [RING], "crossing", [4]),
        ("Polygon", [RING, RING[::-1]], "road_boundary", [4, 4]),
        ("MultiPolygon", [[RING], [RING]], "marking", [4, 4]),
    ],
)
def test_geometries_become_elements(
    tmp_path: Path, geometry: str, coordinates: Any, kind: str, sizes: list[int]
) -> None:
    found, left_out = read(collection(tmp_path, feature(geometry, coordinates, kind=kind)))
    assert np.diff(found.elements.first).tolist() == sizes
    assert set(found.elements.kind.tolist()) == {Kind[kind.upper()]}
    assert left_out == ()


@pytest.mark.parametrize(
    ("item", "reason"),
    [
        (feature("Point", A, kind="lane_line"), "lane_line: a point is none"),
        (feature("Polygon", [RING], kind="pole"), "pole: a ring is none"),
        (feature("LineString", [A, B], kind="crossing"), "crossing: a line is none"),
        (feature("Polygon", [[A, B, C, B]], kind="crossing"), "crossing: a ring that is not closed"),
        (feature("Polygon", [RING, RING], kind="crossing"), "crossing: holes in a ring: it is taken without"),
        (feature("Point", A, kind="tree"), "features of kind tree: not known"),
        (feature("Point", A, kind="sign", style="odd"), "style odd: not known, the element is taken without"),
        (
            {"type": "Feature", "geometry": None, "properties": {"kind": "pole"}},
            "pole: a feature without geometry is none",
        ),
    ],
)
def test_what_is_no_element_is_counted(tmp_path: Path, item: Any, reason: str) -> None:
    _, left_out = read(collection(tmp_path, feature("Point", A, kind="pole"), item))
    assert [(left.reason, left.count) for left in left_out] == [(reason, 1)]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<osm/>", "expected JSON"),
        ('{"type": "Topology"}', r"Invalid enum value 'Topology' - at `\$.type`"),
        ("[1, 2]", "Expected `object`, got `array`"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "a.geojson"
    path.write_text(content)
    with pytest.raises(EgolocError, match=message):
        read(path)


@pytest.mark.parametrize(
    ("item", "message"),
    [
        (
            feature("LineString", [A, ["8.4", 49.0]], kind="lane_line"),
            r"\$.features\[0\].geometry.coordinates\[1\]\[0\]",
        ),
        (feature("LineString", [A], kind="lane_line"), r"length >= 2 - at `\$.features\[0\].geometry.coordinates`"),
        (feature("LineString", [A, [float("nan"), 49.0]], kind="lane_line"), "expected JSON"),
        (feature("Circle", A, kind="pole"), r"'Circle' - at `\$.features\[0\].geometry.type`"),
        (
            feature("Point", [457000.0, 5428000.0], kind="pole", name="P"),
            r"P: expected longitude and latitude in degrees",
        ),
        (
            feature("MultiPoint", [A, [20.0, 49.0]], kind="pole"),
            "expected a map within one UTM zone, got one that is 11.6 deg",
        ),
        (feature("Point", [8.4, 89.0], kind="pole"), "UTM: expected a latitude within 84 deg"),
        (feature("Point", [*A, 1e300], kind="pole"), r"expected metres within 1e\+07, got 1e\+300"),
        (feature("Point", A), "no feature of 1 is an element: features without the property kind"),
    ],
)
def test_a_damaged_feature_is_one_line(tmp_path: Path, item: Any, message: str) -> None:
    path = collection(tmp_path, item)
    with pytest.raises(EgolocError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_only_wgs84_is_read(tmp_path: Path) -> None:
    item = feature("Point", A, kind="pole")
    named = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    assert len(read(collection(tmp_path, item, crs=named))[0].elements) == 1
    named["properties"] = {"name": "urn:ogc:def:crs:EPSG::25832"}
    with pytest.raises(EgolocError, match=r"\$.crs: expected WGS-84 .* got urn:ogc:def:crs:EPSG::25832"):
        read(collection(tmp_path, item, crs=named))


def test_another_zone_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="lies in UTM zone 32N, the map asked for is in zone 31N"):
        read(collection(tmp_path, feature("Point", A, kind="pole")), MapFrame("utm", zone=31))


def example(frame: MapFrame) -> VectorMap:
    """Every kind, with and without heights, 12 km from the frame's origin."""
    builder = Builder("example")
    far = np.array((9000.0, 8000.0, 40.0))
    ring = np.array([(0, 0, 1), (4, 0, 1), (4, 2, 1.5), (0, 2, 1), (0, 0, 1)]) + far
    builder.add(Kind.LANE_LINE, ring[:3], Style.DASHED, Colour.YELLOW, "line")
    builder.add(Kind.ROAD_BOUNDARY, ring, Style.CURB, name="loop")
    builder.add(Kind.STOP_LINE, ring[:2, :2], Style.SOLID, name="flat")
    builder.add(Kind.CROSSING, ring, Style.ZEBRA, name="crossing")
    builder.add(Kind.MARKING, ring[:, :2], Style.ARROW, Colour.WHITE, "arrow")
    builder.add(Kind.POLE, np.array([(1, 1, 0), (1, 1, 6)]) + far, name="pole")
    builder.add(
        Kind.SIGN, np.array([(0, 0, 2), (1, 0, 2), (1, 0, 3), (0, 0, 3), (0, 0, 2)]) + far, Style.LIGHT, name="l"
    )
    builder.add(Kind.SIGN, ring[:1, :2], name="sign")
    return builder.built(frame, road_km=1.25)


@pytest.mark.parametrize(
    "frame",
    [
        MapFrame("utm", (450e3, 5420e3, 100.0), 32),
        MapFrame("utm", (300e3, 7e6, 0.0), 19, True),
        MapFrame("enu", (49, 8, 110)),
    ],
)
def test_out_and_back_within_a_millimetre(tmp_path: Path, frame: MapFrame) -> None:
    before, path = example(frame), tmp_path / "out.geojson"
    write_geojson(before, path)
    after, left_out = read(path)
    assert left_out == ()
    assert (after.frame, after.road_km) == (before.frame, before.road_km)
    for column in ("kind", "style", "colour", "first", "name"):
        np.testing.assert_array_equal(getattr(after.elements, column), getattr(before.elements, column))
    np.testing.assert_allclose(after.elements.xyz, before.elements.xyz, atol=1e-3)


def test_outlines_run_counter_clockwise_in_the_file(tmp_path: Path) -> None:
    builder = Builder("example")
    builder.add(Kind.CROSSING, [(0, 0), (0, 2), (4, 2), (4, 0), (0, 0)])
    write_geojson(builder.built(MapFrame("utm", (457e3, 5428e3, 0.0), 32)), tmp_path / "a.geojson")
    ((ring,),) = (
        item["geometry"]["coordinates"] for item in json.loads((tmp_path / "a.geojson").read_text())["features"]
    )
    x, y = np.transpose(ring) - np.array(ring[0])[:, None]
    assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0


def test_a_local_map_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="without georeference"):
        write_geojson(example(LOCAL), tmp_path / "a.geojson")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="cannot be written: No such file"):
        write_geojson(example(MapFrame("utm", zone=32)), tmp_path / "none" / "a.geojson")


@pytest.mark.parametrize(
    "name",
    ["maps/lanelet2/mapping_example.osm", "maps/autoware/intersection.osm", "av2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"],
)
def test_real_maps_go_out_and_back_within_a_millimetre(data: Path, tmp_path: Path, name: str) -> None:
    before, _ = read_map(data / name)
    write_geojson(before, tmp_path / "out.geojson")
    after, left_out = read(tmp_path / "out.geojson")
    assert left_out == ()
    np.testing.assert_array_equal(after.elements.kind, before.elements.kind)
    for row in range(len(before.elements)):
        one, other = before.elements.vertices(row), after.elements.vertices(row)
        turned = np.abs(other - one)[:, :2].max() > 1e-3  # outlines are written counter-clockwise
        np.testing.assert_allclose(other[::-1] if turned else other, one, atol=1e-3)
