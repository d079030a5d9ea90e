"""egoloc map import and export, run on files: what they write, what they say, and what they refuse."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from replay.cli import main
from sensors.geodesy import MapFrame
from sensors.maps.builder import Builder
from sensors.maps.formats import read_map
from sensors.maps.geojson_out import write_geojson
from sensors.maps.map_file import open_map
from sensors.maps.quantized import cm_from_m
from sensors.maps.store import write_map
from sensors.maps.vector_map import Elements, Kind, Style
from sensors.mcap.io import write_log
from sensors.records import Log

FRAME = MapFrame("utm", (455_000.0, 5_427_000.0, 0.0), 32)
REAL = [
    "maps/lanelet2/mapping_example.osm",
    "maps/autoware/2km_test.osm",
    "maps/autoware/cargo_transport_map.osm",
    "maps/autoware/intersection.osm",
    "maps/autoware/vm_03_left_hand.osm",
    "maps/opendrive/fabriksgatan.xodr",
    "maps/opendrive/multi_intersections.xodr",
    "maps/opendrive/soderleden.xodr",
    "av2/3b3570b4-7b0b-3268-a571-b0889dbf40b6",
    "av2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede",
]


def street(path: Path, shift: float = 0.0, kind: str = "lane_line") -> Path:
    """A GeoJSON map: a line of 100 m, a pole at its end."""
    builder = Builder("street")
    builder.add(Kind.LANE_LINE, [[shift, 0.0, 110.0], [shift + 100.0, 0.0, 110.5]], Style.DASHED, name="line")
    builder.add(Kind.POLE, [[shift + 100.0, 4.0, 110.0], [shift + 100.0, 4.0, 114.0]], name="pole")
    write_geojson(builder.built(FRAME, road_km=0.1), path)
    path.write_text(path.read_text().replace('"lane_line"', f'"{kind}"'))
    return path


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line that a mistake prints."""
    assert main([str(argument) for argument in arguments]) == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.count("\n") == 1
    return error


@pytest.mark.parametrize("name", REAL)
def test_a_real_map_comes_back_to_the_centimetre(data: Path, tmp_path: Path, name: str) -> None:
    target = tmp_path / "map.parquet"
    assert main(["map", "import", "auto", str(data / name), str(target)]) == 0
    found, _ = read_map(data / name)
    with open_map(target) as opened:
        back = opened.whole()
    assert (back.frame, back.road_km) == (found.frame, found.road_km)
    assert sorted(back.elements.name) == sorted(found.elements.name)
    rows = {(n, k, s): i for i, (n, k, s) in enumerate(_keys(found.elements))}
    order = [rows[key] for key in _keys(back.elements)]
    np.testing.assert_allclose(back.elements.xyz, found.elements.chosen(np.array(order)).xyz, rtol=0, atol=0.0051)


def _keys(elements: Elements) -> list[tuple[str, int, bytes]]:
    """Name, kind, rounded first vertex and count of vertices of each element: names alone are not unique."""
    first = 0.0 + cm_from_m(elements.xyz[elements.first[:-1], :2])
    return [
        (str(n), int(k), xy.tobytes() + bytes([count % 256]))
        for n, k, xy, count in zip(elements.name, elements.kind, first, np.diff(elements.first), strict=True)
    ]


def test_overlapping_maps_become_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sources = [street(tmp_path / "a.geojson"), street(tmp_path / "b.geojson", 500.0), street(tmp_path / "c.geojson")]
    target = tmp_path / "map.parquet"
    assert main(["map", "import", "geojson", *map(str, sources), str(target), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["elements"] == {"lane_line": 2, "pole": 2}
    assert said["km"] == pytest.approx(0.2)
    assert [(row["count"], row["source"][:1]) for row in said["left_out"]] == [(2, "c")]
    with open_map(target) as opened:
        whole = opened.whole()
    assert [name[:1] for name in whole.sources] == ["a", "b", "c"]
    assert set(whole.elements.source) == {0, 1}


def test_a_frame_is_asked_for_as_text_or_as_a_file_that_has_one(tmp_path: Path) -> None:
    source, first = street(tmp_path / "a.geojson"), tmp_path / "first.parquet"
    assert main(["map", "import", "geojson", str(source), str(first), "--frame", "utm:32N:450000,5420000"]) == 0
    write_log(tmp_path / "log.mcap", Log(map_frame=FRAME))
    for frame, origin in ((first, 450_000.0), (tmp_path / "log.mcap", 455_000.0)):
        target = tmp_path / f"as_{frame.name}.parquet"
        assert main(["map", "import", "geojson", str(source), str(target), "--frame", str(frame)]) == 0
        with open_map(target) as opened:
            assert opened.frame.origin[0] == origin
            np.testing.assert_allclose(opened.whole().elements.xyz[0, 0], 455_000.0 - origin, atol=0.0051)


def test_rules_give_a_gis_its_own_names(tmp_path: Path) -> None:
    source = street(tmp_path / "a.geojson", kind="fahrbahnmarkierung")
    rules = tmp_path / "rules.toml"
    rules.write_text('[kinds]\n"kind=fahrbahnmarkierung" = "lane_line"\n')
    target = tmp_path / "map.parquet"
    assert main(["map", "import", "geojson", str(source), str(target), "--rules", str(rules)]) == 0
    with open_map(target) as opened:
        assert opened.facts.counts["lane_line"] == 1


def test_export_is_read_back(tmp_path: Path) -> None:
    source, target, back = street(tmp_path / "a.geojson"), tmp_path / "map.parquet", tmp_path / "b.geojson"
    assert main(["map", "import", "geojson", str(source), str(target)]) == 0
    assert main(["map", "export", str(target), str(back)]) == 0
    (before, _), (after, _) = read_map(source), read_map(back)
    np.testing.assert_allclose(after.elements.xyz, before.elements.xyz, rtol=0, atol=0.0061)


def _text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def _gigabyte(path: Path) -> Path:
    with path.open("wb") as handle:
        handle.truncate(1 << 30)
    return path


OWN = '{"type":"FeatureCollection","features":[],"egoloc":{"frame":{"kind":"utm","zone":32},"road_km":%d}}'
BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a.osm": (lambda p: _text(p, "<!DOCTYPE a [<!ENTITY b 'c'>]><osm/>"), "without document type or entities"),
    "b.osm": (lambda p: _text(p, '<osm><way id="1"><nd ref="7"/><tag k="type" v="line_thin"/></way></osm>'), "node 7"),
    "c.osm": (lambda p: _text(p, '<osm><node id="1" lat="nan" lon="8"/></osm>'), "lat"),
    "d.xodr": (lambda p: _text(p, '<OpenDRIVE><road id="1" length="1e999"/></OpenDRIVE>'), "at least one element"),
    "e.geojson": (lambda p: _text(p, '{"type": "FeatureCollection", "features": [{"type": "Future"}]}'), "Future"),
    "g.osm": (_gigabyte, "MB"),
    "h.geojson": (_gigabyte, "MB"),
    "k.geojson": (lambda p: _text(p, OWN % -5), "road_km"),
    "i.bin": (lambda p: _text(p, "nothing"), "looks like no known map"),
    "j.osm": (lambda p: p, "no such file"),
}


@pytest.mark.parametrize("name", sorted(BAD))
def test_bad_maps_are_refused_in_one_line_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    make, expected = BAD[name]
    source, target = make(tmp_path / name), tmp_path / "out" / "map.parquet"
    error = refusal(capsys, "map", "import", "auto", source, target)
    assert name in error
    assert expected in error
    assert not target.parent.exists()


def test_bad_requests_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = street(tmp_path / "a.geojson"), tmp_path / "map.parquet"
    rules = _text(tmp_path / "rules.toml", '[kinds]\ntree = "elephant"\n')
    for more, expected in (
        (["--frame", "utm:61N"], "zone: expected 1..60"),
        (["--frame", "utm:40N"], "lies in UTM zone 32N, the map asked for is in zone 40N"),
        (["--frame", "enu:1,2,x"], "expected utm:ZONE"),
        (["--frame", "here"], "expected utm:ZONE"),
        (["--rules", rules], "rules.toml: kinds: expected one of lane_line"),
        (["--rules", tmp_path / "none.toml"], "none.toml: cannot be read"),
        (["--tile-m", "0"], "tile_m: expected 1..100000"),
    ):
        assert expected in refusal(capsys, "map", "import", "geojson", source, target, *more)
    assert not target.exists()
    assert "no such" in refusal(capsys, "map", "import", "geojson", tmp_path / "none.geojson", target)
    assert "format shapefile: expected one of" in refusal(capsys, "map", "import", "shapefile", source, target)
    assert "expected SRC... and DEST" in refusal(capsys, "map", "import", "geojson", source)
    assert "the source itself" in refusal(capsys, "map", "import", "geojson", source, source)
    target.write_text("precious")
    assert "exists already" in refusal(capsys, "map", "import", "geojson", source, target)
    assert target.read_text() == "precious"
    assert "expected a map of egoloc" in refusal(capsys, "map", "export", target, tmp_path / "out.geojson")


def test_a_log_without_a_frame_gives_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, log = street(tmp_path / "a.geojson"), tmp_path / "log.mcap"
    write_log(log, Log())
    error = refusal(capsys, "map", "import", "geojson", source, tmp_path / "map.parquet", "--frame", log)
    assert "log.mcap: expected a log with a map frame" in error


def test_maps_of_different_planes_do_not_become_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = street(tmp_path / "a.geojson")
    lane = '<lane id="-1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane>'
    line = '<geometry s="0" x="0" y="0" hdg="0" length="9"><line/></geometry>'
    road = f"""<OpenDRIVE><road id="1" junction="-1" length="9"><planView>{line}</planView>
        <lanes><laneSection s="0"><right>{lane}</right></laneSection></lanes></road>
        </OpenDRIVE>"""
    other = _text(tmp_path / "b.xodr", road)
    error = refusal(capsys, "map", "import", "auto", one, other, tmp_path / "map.parquet")
    assert "b.xodr: has only local coordinates" in error
    assert main(["map", "import", "auto", str(other), str(other), str(tmp_path / "twice.parquet")]) == 0
    capsys.readouterr()
    error = refusal(capsys, "map", "import", "auto", other, one, tmp_path / "map.parquet")
    assert "a.geojson: the map asked for is another place's" in error


def test_check_lists_errors_and_says_so_by_its_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, sound = street(tmp_path / "a.geojson"), tmp_path / "sound.parquet"
    builder = Builder("street")
    for name in ("one", "two"):
        builder.add(Kind.LANE_LINE, [[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]], name=name)
    write_map(builder.built(FRAME), tmp_path / "twice.parquet")
    assert main(["map", "import", "geojson", str(source), str(sound)]) == 0
    assert main(["map", "check", str(sound)]) == 0
    assert "0 errors, 0 notices in 2 elements" in capsys.readouterr().out
    assert main(["map", "check", str(tmp_path / "twice.parquet")]) == 1
    assert "one (lane_line) and two (lane_line) at 0.00, 0.00" in capsys.readouterr().out
    assert main(["map", "check", str(tmp_path / "twice.parquet"), "--json"]) == 1
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert (finding["check"], finding["error"]) == ("duplicate", True)
    assert "none.parquet" in refusal(capsys, "map", "check", tmp_path / "none.parquet")


def test_devices_are_no_maps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = refusal(capsys, "map", "import", "geojson", "/dev/zero", tmp_path / "map.parquet")
    assert "/dev/zero: no such file or folder" in error
