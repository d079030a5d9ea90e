"""OpenDRIVE files as a whole: the real ones, georeferences and frames, and bad input."""

from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from pyproj import Transformer

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map
from sensors.maps import opendrive
from sensors.maps.builder import Builder
from sensors.maps.opendrive_road import read_road
from sensors.maps.vector_map import Kind, Style
from tests.sensors.maps.xodr import LINE, RIGHT, counts, imported, road, section, written

UTM = "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs"
REAL = ("fabriksgatan", "multi_intersections", "soderleden")


@pytest.mark.parametrize("name", REAL)
def test_a_real_file_loses_no_known_kind(data: Path, name: str) -> None:
    """Counted over the XML by itself: paint, lights, signs, stop lines, crossings, arrows; kilometres."""
    path = data / f"maps/opendrive/{name}.xodr"
    root = ElementTree.parse(path).getroot()
    expected: Counter[Kind] = Counter()
    expected[Kind.LANE_LINE] = sum(mark.get("type") != "none" for mark in root.iter("roadMark"))
    kinds = {"294": Kind.STOP_LINE, "1000003": Kind.CROSSING, "-1": Kind.MARKING}
    for signal in root.iter("signal"):
        expected[kinds.get(signal.get("type", ""), Kind.SIGN)] += 1
        expected[Kind.POLE] += signal.get("dynamic") == "yes"
    vector_map, left_out = opendrive.read(path)
    found = Counter(Kind(kind) for kind in vector_map.elements.kind)
    edges = found.pop(Kind.ROAD_BOUNDARY)
    assert found == +expected
    outside = [e for e in root.iter("road") if e.get("junction") == "-1"]
    sides = 2 * sum(len(e.findall("lanes/laneSection")) for e in outside)
    inside = [e for e in root.iter("road") if e.get("junction") != "-1"]
    walks = sum(e.find("lanes//lane[@type='sidewalk']") is not None for e in inside)
    assert edges == sides + walks
    driven = [e for e in outside if e.find("lanes//lane[@type='driving']") is not None]
    assert vector_map.road_km == pytest.approx(sum(float(e.get("length", "nan")) for e in driven) / 1e3, abs=1e-6)
    assert not [row for row in left_out if row.reason.startswith(("signals", "objects", "road marks", "crossings"))]


@pytest.mark.parametrize("name", REAL)
def test_pieces_of_real_roads_end_where_the_next_begin(data: Path, name: str) -> None:
    """The file's own places and headings, computed by the tool that drew it: lines, arcs, spirals, paramPoly3."""
    roads = ElementTree.parse(data / f"maps/opendrive/{name}.xodr").getroot().iter("road")
    joints = 0
    for element in roads:
        read = read_road(element, Builder("test"))
        assert read is not None
        plan = read.surface.plan
        before = plan.at(plan.s[1:] - 1e-9)
        np.testing.assert_allclose(before[:, :2], np.column_stack((plan.x, plan.y))[1:], atol=2e-3)
        np.testing.assert_allclose(np.cos(before[:, 2] - plan.heading[1:]), 1.0, atol=1e-6)
        joints += len(before)
    assert joints > 5


def test_a_real_file_joins_up(data: Path) -> None:
    """Roads that follow each other have edges that meet: an error of heading or width would open them."""
    vector_map, _ = opendrive.read(data / "maps/opendrive/multi_intersections.xodr")
    elements = vector_map.elements.chosen(vector_map.elements.style == Style.CURB)
    ends = np.array([elements.vertices(row)[end, :2] for row in range(len(elements)) for end in (0, -1)])
    apart = np.linalg.norm(ends[:, None] - ends[None], axis=2) + 1e9 * np.eye(len(ends))
    assert (apart.min(axis=1) < 0.05).sum() > 0.9 * len(ends)


def test_a_georeference_of_utm_keeps_its_zone(tmp_path: Path) -> None:
    geometry = LINE.replace('x="0" y="0"', 'x="500300" y="5400200"')
    header = f"<geoReference><![CDATA[{UTM}]]></geoReference>"
    vector_map, _ = imported(tmp_path, road(section(RIGHT), geometry), header=header)
    assert vector_map.frame == MapFrame("utm", (500000.0, 5400000.0, 0.0), 32)
    np.testing.assert_allclose(vector_map.elements.vertices(0), [[300, 196.5, 0], [400, 196.5, 0]], atol=1e-4)


def test_a_local_projection_and_an_offset_come_to_the_earth(tmp_path: Path) -> None:
    proj = "+proj=tmerc +lat_0=49 +lon_0=8 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +geoidgrids=egm96_15.gtx"
    offset = '<offset x="1000" y="2000" z="100" hdg="1.5707963267948966"/>'
    header = f"<geoReference><![CDATA[{proj}]]></geoReference>{offset}"
    vector_map, left_out = imported(tmp_path, road(section(RIGHT)), header=header)
    assert vector_map.frame.zone == 32
    assert left_out["geoids of the georeference: heights stay above the geoid"] == 1
    lat, lon, height = np.degrees(llh_from_map(vector_map.frame, vector_map.elements.vertices(0))).T
    to_local = Transformer.from_crs("EPSG:4326", proj.replace("+geoidgrids=egm96_15.gtx", ""), always_xy=True)
    x, y = to_local.transform(lon, lat)
    np.testing.assert_allclose(x, [1003.5, 1003.5], atol=1e-3)
    np.testing.assert_allclose(y, [2000, 2100], atol=1e-3)
    np.testing.assert_allclose(np.radians(height), 100.0)


def test_a_map_comes_into_a_frame_or_is_refused(tmp_path: Path) -> None:
    geometry = LINE.replace('x="0" y="0"', 'x="500300" y="5400200"')
    path = written(tmp_path, road(section(RIGHT), geometry), header=f"<geoReference>{UTM}</geoReference>")
    own, _ = opendrive.read(path)
    datum = np.degrees(llh_from_map(own.frame, [[300.0, 196.5, 0.0]]))[0]
    plane, _ = opendrive.read(path, MapFrame("enu", (float(datum[0]), float(datum[1]), 0.0)))
    np.testing.assert_allclose(plane.elements.vertices(0)[0], [0, 0, 0], atol=1e-6)
    assert np.linalg.norm(plane.elements.vertices(0)[1]) == pytest.approx(100.0 / 0.9996, abs=1e-3)
    with pytest.raises(EgolocError, match=r"map\.xodr: lies in UTM zone 32N, the map asked for is in zone 33N"):
        opendrive.read(path, MapFrame("utm", zone=33))
    with pytest.raises(EgolocError, match=r"the map asked for is another place's: \d+ km from its datum"):
        opendrive.read(path, MapFrame("enu", (10.0, 20.0, 0.0)))
    bare = written(tmp_path, road(section(RIGHT)))
    with pytest.raises(EgolocError, match="without georeference: cannot be brought into a map frame"):
        opendrive.read(bare, MapFrame("utm", zone=32))


def test_a_file_keeps_the_zone_that_it_is_written_in(tmp_path: Path) -> None:
    """0.2 deg beyond the zone's edge the file's own zone goes on; 3 deg beyond, the place's own is taken."""
    for x, zone in ((742_500.0, 32), (950_000.0, 33)):
        geometry = LINE.replace('x="0" y="0"', f'x="{x}" y="5400200"')
        path = written(tmp_path, road(section(RIGHT), geometry), header=f"<geoReference>{UTM}</geoReference>")
        assert opendrive.read(path)[0].frame.zone == zone


def test_roads_of_junctions_are_no_kilometres(tmp_path: Path) -> None:
    inside = road(section(RIGHT), attributes='id="2" junction="9"')
    walk = road(section(RIGHT.replace("driving", "sidewalk")), attributes='id="3" junction="-1"')
    empty = road(section(RIGHT), geometry="", attributes='id="4" junction="-1"')
    vector_map, left_out = imported(tmp_path, road(section(RIGHT)), inside, walk, empty)
    assert vector_map.road_km == pytest.approx(0.1)
    assert left_out["roads without length"] == 1
    assert left_out["open sides of roads within junctions: no edge is there"] == 2


def test_pieces_without_length_are_counted(tmp_path: Path) -> None:
    zero = '<geometry s="100" x="100" y="0" hdg="0" length="0"><line/></geometry>'
    vector_map, left_out = imported(tmp_path, road(section(RIGHT) + section(RIGHT, 100.0), LINE + zero))
    assert vector_map.road_km == pytest.approx(0.1)
    assert left_out["pieces of a reference line without length"] == 1
    assert left_out["lane sections without length"] == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('x="0"', 'x="nan"', r"line 4: <geometry>: x: expected a finite number, got 'nan'"),
        ('y="0"', 'y="3e7"', r"road 1 lane -1 s 0\.0: expected coordinates within 20000 km, got \["),
        ('y="0"', 'y="3e13"', "line 4: <geometry>: y: expected a finite number, got '3e13'"),
        ('hdg="0" ', "", "line 4: <geometry>: expected the attribute hdg"),
        ('length="100"><line', 'length="-5"><line', r"line 4: <geometry>: length: expected 0\.\.1000000 m, got -5"),
        (
            'length="100"><line',
            'length="1e9"><line',
            r"line 4: <geometry>: length: expected 0\.\.1000000 m, got 1e\+09",
        ),
        ("<line/>", "<helix/>", "line 4: <helix>: expected line, arc, spiral, poly3 or paramPoly3"),
        ("<line/>", "", "line 4: <geometry>: expected line, arc, spiral, poly3 or paramPoly3 in it, got nothing"),
        ("<line/>", '<arc curvature="inf"/>', r"line 4: <arc>: curvature: expected a finite number, got 'inf'"),
        ("<line/>", '<arc curvature="9"/>', r"line 4: <arc>: expected a curve that turns ten times at most, got 143"),
        ("<line/>", '<spiral curvStart="0"/>', "line 4: <spiral>: expected the attribute curvEnd"),
        (
            "<line/>",
            '<paramPoly3 pRange="x"/>',
            "line 4: <paramPoly3>: pRange: expected arcLength or normalized, got 'x'",
        ),
        ('a="3.5"', 'a="wide"', r"line 5: <width>: a: expected a finite number, got 'wide'"),
        ('id="-1"', 'id="1"', r"line 5: <lane>: id: expected a whole number that fits <right>, got '1'"),
        ('id="-1"', 'id="-1.5"', r"line 5: <lane>: id: expected a whole number"),
        ("</OpenDRIVE>", '<road id="1"/></OpenDRIVE', "line 6: expected well-formed XML"),
        ("OpenDRIVE>", "osm>", "line 1: <osm>: expected an OpenDRIVE map"),
        (
            "<header>",
            "<header><geoReference>rubbish</geoReference>",
            "georeference: expected a PROJ string or WKT, got 'rub",
        ),
        (
            "<header>",
            "<header><geoReference>+proj=longlat +datum=WGS84</geoReference>",
            r"georeference: expected a projection in metres, got '\+proj=longlat",
        ),
        ("<OpenDRIVE>", "<!DOCTYPE a [<!ENTITY b 'c'>]><OpenDRIVE>", "line 1: expected a map without document type"),
    ],
)
def test_bad_input_is_one_line_that_names_the_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = written(tmp_path, road(section(RIGHT)))
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(EgolocError, match=rf"map\.xodr: {message}") as raised:
        opendrive.read(path)
    assert "\n" not in str(raised.value)


def test_two_roads_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="<road>: id: expected another one for each road, got '1' again"):
        imported(tmp_path, road(section(RIGHT)), road(section(RIGHT)))


def test_a_repetition_of_millions_is_refused(tmp_path: Path) -> None:
    repeat = '<repeat s="0" length="90" distance="1e-5" tStart="0" tEnd="0"/>'
    pole = f'<objects><object id="1" type="pole" s="0" t="0">{repeat}</object></objects>'
    with pytest.raises(EgolocError, match="<repeat>: expected at most 100000 objects in length and distance"):
        imported(tmp_path, road(section(RIGHT), more=pole))


def test_a_map_without_roads_is_empty(tmp_path: Path) -> None:
    path = written(tmp_path, header=f"<geoReference>{UTM}</geoReference>")
    vector_map, left_out = opendrive.read(path)
    assert (len(vector_map.elements), vector_map.road_km, counts(left_out)) == (0, 0.0, {})


def test_a_broken_reference_line_is_refused_and_a_small_gap_told(tmp_path: Path) -> None:
    pieces = (
        LINE.replace('length="100"', 'length="10"')
        + '<geometry s="{s}" x="{x}" y="0" hdg="0" length="10"><line/></geometry>'
    )
    with pytest.raises(EgolocError, match=r"expected pieces that join, the one at s 50 begins 460 m from the end"):
        imported(tmp_path, road(section(RIGHT), pieces.format(s=50, x=510)))
    _, left_out = imported(tmp_path, road(section(RIGHT), pieces.format(s=10, x=10.2)))
    assert left_out["gaps of up to 1 m between pieces of reference lines"] == 1
    assert left_out["lengths of roads that differ from their reference lines': the lines' are taken"] == 1


def test_coordinates_outside_of_the_zone_that_a_file_names_are_told(tmp_path: Path) -> None:
    path = written(tmp_path, road(section(RIGHT)), header=f"<geoReference>{UTM}</geoReference>")
    vector_map, left_out = opendrive.read(path)
    assert vector_map.frame.zone == 31
    assert any(row.reason.startswith("zones: the georeference names 32, the coordinates lie in 31") for row in left_out)


def test_road_marks_that_are_not_known_are_told(tmp_path: Path) -> None:
    lane = RIGHT.replace('type="solid" color="white"', 'type="foo" color="pink"')
    _, left_out = imported(tmp_path, road(section(lane)))
    assert left_out["types of road marks that are not known: the line is taken without style"] == 1
    assert left_out["colours that are not known: the line is taken without"] == 1
