"""The table of formats: guessing, reading by name, and what it refuses."""

import json
from pathlib import Path

import pytest

from sensors.errors import EgolocError
from sensors.maps.formats import FORMATS, guessed, read_map
from sensors.maps.vector_map import Kind

from .osm_text import node, osm, way


@pytest.mark.parametrize(
    ("name", "content", "format"),
    [
        ("map.osm", "", "lanelet2"),
        ("town.XODR", "", "opendrive"),
        ("town.geojson", "", "geojson"),
        ("map.xml", '<?xml version="1.0"?>\n<osm version="0.6">', "lanelet2"),
        ("map.xml", '<?xml version="1.0"?><OpenDRIVE>', "opendrive"),
        ("map.json", '{"type": "FeatureCollection"', "geojson"),
        ("map.json", '{"pedestrian_crossings": {', "argoverse2"),
        ("log_map_archive_x____PIT_city_1.json", "", "argoverse2"),
    ],
)
def test_a_file_looks_like_its_format(tmp_path: Path, name: str, content: str, format: str) -> None:
    (tmp_path / name).write_text(content)
    assert guessed(tmp_path / name) == format
    assert format in FORMATS


def test_a_map_is_read_by_its_look_and_by_name(tmp_path: Path) -> None:
    path = osm(tmp_path / "a.osm", node(1, 0, 0), node(2, 5, 0), way(3, [1, 2], "curbstone"))
    assert len(read_map(path)[0].elements) == 1
    assert len(read_map(path, "lanelet2")[0].elements) == 1
    with pytest.raises(EgolocError, match="expected JSON"):
        read_map(path, "geojson")


def test_rules_are_geojsons(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    lamp = {"type": "Feature", "geometry": {"type": "Point", "coordinates": [8.4, 49]}, "properties": {"art": "Mast"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [lamp]}))
    assert read_map(path, rules={"Mast": Kind.POLE})[0].elements.kind.tolist() == [Kind.POLE]
    with pytest.raises(EgolocError, match="rules: only geojson has rules"):
        read_map(osm(tmp_path / "a.osm", node(1, 0, 0)), rules={"Mast": Kind.POLE})


def test_what_is_not_known_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(EgolocError, match=r"looks like no known map: say which format it is \(lanelet2, "):
        read_map(tmp_path / "a.txt")
    with pytest.raises(EgolocError, match="format shape: expected one of lanelet2, "):
        read_map(tmp_path / "a.txt", "shape")
    with pytest.raises(EgolocError, match="no such file or folder"):
        read_map(tmp_path / "b.osm")
