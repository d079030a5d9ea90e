"""egoloc map info: figures, tables, pictures, and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from PIL import Image

import replay.map_info as map_info_module
from replay.cli import main
from replay.map_drawing import round_length
from replay.map_info import kind_bytes
from sensors.geodesy import MapFrame, llh_from_map, utm_frame
from sensors.maps.builder import Builder
from sensors.maps.formats import read_map
from sensors.maps.map_file import open_map
from sensors.maps.store import bytes_by_kind, write_map
from sensors.maps.vector_map import Kind, VectorMap
from sensors.mcap.io import read_log, write_log
from sensors.records import Log, Trajectory
from sensors.simulate.city_map import city_map

UTM = MapFrame("utm", (455_000.0, 5_427_000.0, 0.0), 32)
REAL = {
    "maps/lanelet2/mapping_example.osm": 0.5,
    "maps/opendrive/multi_intersections.xodr": 1.0,
    "av2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede": 0.2,
}
"""Real maps, and the most that may be degenerate: without poles, signs or stop lines a road has no length."""


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("city") / "city.parquet"
    write_map(city_map(2.0, 4), path)
    return path


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two lines and nothing else, a pole in the middle."""
    builder = Builder("a road")
    for y in (0.0, 3.5):
        builder.add(Kind.LANE_LINE, [(0.0, y), (1000.0, y)])
    builder.add(Kind.POLE, [(500.0, 8.0, 0.0), (500.0, 8.0, 4.0)])
    path = tmp_path_factory.mktemp("road") / "road.parquet"
    write_map(builder.built(UTM), path)
    return path


def found(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> Any:
    assert main(["map", "info", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main(["map", "info", *map(str, arguments)]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    return printed.err


def test_its_json_is_what_programs_read(capsys: pytest.CaptureFixture[str], city: Path) -> None:
    info = found(capsys, city)
    with open_map(city) as opened:
        whole = opened.whole()
        facts = opened.facts
    assert facts.road_km is not None
    assert info["km"] == pytest.approx(facts.road_km)
    assert info["elements"] == facts.counts
    assert info["bytes"] == city.stat().st_size
    assert info["mb_per_km"] == pytest.approx(city.stat().st_size / 1e6 / info["km"])
    weights = {kind: size / 1e6 / info["km"] for kind, size in bytes_by_kind(whole).items()}
    assert info["mb_per_km_by_type"] == pytest.approx(weights)
    assert info["frame"] == {"kind": "utm", "origin": [455_000.0, 5_427_000.0, 0.0], "zone": 32, "south": False}
    assert info["sources"] == ["city map of seed 4"]
    predicted = info["localizability"]
    assert set(predicted["sigma"]) == {"lon_m", "lat_m", "yaw_deg"}
    for row in predicted["sigma"].values():
        assert 0.0 < row["p50"] <= row["p95"] <= row["max"]
    assert predicted["route_km"] == pytest.approx(predicted["poses"] * 0.005)
    assert predicted["degenerate"]["any"] <= 0.02
    assert predicted["degenerate_beyond"] == pytest.approx({"lon_m": 0.2, "lat_m": 0.1, "yaw_deg": 1 / 3})


def test_a_plain_road_is_degenerate_but_near_its_pole(capsys: pytest.CaptureFixture[str], road: Path) -> None:
    info = found(capsys, road)
    assert (info["km"], info["km_source"]) == (1.0, "lines")
    predicted = info["localizability"]
    # the pole is seen from 40 m; the ends of two lines together have a sigma of 0.23 m
    assert predicted["degenerate"]["lon"] == pytest.approx((1000.0 - 80.0) / 1000.0, abs=0.006)
    assert predicted["degenerate"]["lat"] == predicted["degenerate"]["yaw"] == 0.0
    stretches = predicted["stretches"]
    assert [row["axis"] for row in stretches] == ["lon", "lon"]
    assert sum(row["length_m"] for row in stretches) == pytest.approx(1000.0 * predicted["degenerate"]["lon"])
    assert sorted(round(row["x"], -2) for row in stretches) == [200.0, 800.0]
    for row in stretches:
        assert row["sigma_max_m"] == pytest.approx(3.0**0.5)
        assert row["weakest_deg"] == pytest.approx(0.0, abs=0.1)
        lat, lon, _ = np.degrees(llh_from_map(UTM, [[row["x"], row["y"], 0.0]])[0])
        assert (row["lat_deg"], row["lon_deg"]) == pytest.approx((lat, lon), abs=1e-9)
    assert found(capsys, road, "--limits", "highway")["localizability"]["degenerate_beyond"]["lon_m"] > 0.4


@pytest.mark.parametrize("name", REAL)
def test_real_maps(capsys: pytest.CaptureFixture[str], data: Path, tmp_path: Path, name: str) -> None:
    vector_map, _ = read_map(data / name)
    write_map(vector_map, tmp_path / "a.parquet")
    info = found(capsys, tmp_path / "a.parquet")
    assert info["km"] == pytest.approx(vector_map.road_km)
    assert sum(info["elements"].values()) == len(vector_map.elements)
    assert info["mb_per_km"] < 0.1
    predicted = info["localizability"]
    assert 0.5 < predicted["route_km"] / info["km"] < 1.5
    assert predicted["degenerate"]["lon"] < REAL[name]
    assert predicted["degenerate"]["lat"] < 0.05


def test_the_table_says_it_in_words(capsys: pytest.CaptureFixture[str], road: Path) -> None:
    assert main(["map", "info", str(road)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "1.00 km of road" in lines[0]
    assert "UTM zone 32N" in lines[0]
    rows = {line.split("  ")[0]: line.split() for line in lines if line}
    assert rows["lane line"][2] == "2"
    assert rows["longitudinal, m"][-2] == rows["longitudinal, m"][-2].strip()
    assert float(rows["longitudinal, m"][4]) == pytest.approx(3.0**0.5, abs=1e-3)
    assert any("the map does not say" in line for line in lines)


def test_a_given_route_is_judged(capsys: pytest.CaptureFixture[str], road: Path, tmp_path: Path) -> None:
    rows = "\n".join(f"{i},{i * 1.0},1.75" for i in range(200, 301))
    (tmp_path / "drive.csv").write_text(f"t_s,x,y\n{rows}\n")
    info = found(capsys, road, "--route", tmp_path / "drive.csv")
    predicted = info["localizability"]
    assert predicted["poses"] == 20
    assert predicted["degenerate"]["lon"] == 1.0
    assert info["km"] is info["mb_per_km"] is info["km_source"] is None
    assert set(info["mb_per_km_by_type"].values()) == {None}
    assert main(["map", "info", str(road), "--route", str(tmp_path / "drive.csv")]) == 0
    assert "MB/km is not known" in capsys.readouterr().out


def _log(path: Path, frame: MapFrame | None, xy: np.ndarray[Any, Any]) -> Path:
    t = np.arange(len(xy)) * 10**8
    p = np.column_stack((xy, np.zeros(len(xy))))
    q = np.tile((0.0, 0.0, 0.0, 1.0), (len(xy), 1))
    write_log(path, Log(reference=Trajectory(t, t, p, q), map_frame=frame))
    return path


def test_a_logs_reference_is_a_route(capsys: pytest.CaptureFixture[str], road: Path, tmp_path: Path) -> None:
    xy = np.column_stack((np.linspace(450.3, 550.3, 101), np.full(101, 1.75)))
    info = found(capsys, road, "--route", _log(tmp_path / "a.mcap", UTM, xy))
    assert info["localizability"]["degenerate"]["lon"] < 0.3
    shifted = replace_origin(UTM, 454_000.0)
    again = found(capsys, road, "--route", _log(tmp_path / "b.mcap", shifted, xy + np.array([1000.0, 0.0])))
    for axis, row in info["localizability"]["sigma"].items():
        assert again["localizability"]["sigma"][axis] == pytest.approx(row)


def replace_origin(frame: MapFrame, east: float) -> MapFrame:
    return MapFrame(frame.kind, (east, *frame.origin[1:]), frame.zone, frame.south)


def test_bad_routes_are_one_line(capsys: pytest.CaptureFixture[str], road: Path, tmp_path: Path) -> None:
    xy = np.column_stack((np.linspace(450.3, 550.3, 101), np.full(101, 1.75)))
    elsewhere = _log(tmp_path / "a.mcap", utm_frame(np.radians([43.7, -79.4, 0.0])), xy)
    assert "in the frame of" in refused(capsys, road, "--route", elsewhere)
    local = _log(tmp_path / "b.mcap", MapFrame("enu"), xy)
    assert "local one without a datum" in refused(capsys, road, "--route", local)
    simulated = tmp_path / "c.mcap"
    assert main(["simulate", "static", str(simulated), "--duration-s", "30"]) == 0
    capsys.readouterr()
    with_reference = read_log(simulated)
    write_log(tmp_path / "d.mcap", replace(with_reference, reference=None))
    assert "d.mcap: expected a log with a reference" in refused(capsys, road, "--route", tmp_path / "d.mcap")
    assert "smoothed.parquet of a run" in refused(capsys, road, "--route", road)
    (tmp_path / "nan.csv").write_text("t_s,x,y\n0,nan,nan\n1,nan,2\n")
    assert "nan.csv: no usable row" in refused(capsys, road, "--route", tmp_path / "nan.csv")
    (tmp_path / "far.csv").write_text("t_s,x,y\n" + "\n".join(f"{i},{i + 9e5},0" for i in range(50)))
    assert "comes no nearer to the map than 899.0 km" in refused(capsys, road, "--route", tmp_path / "far.csv")
    (tmp_path / "still.csv").write_text("t_s,x,y\n" + "\n".join(f"{i},5,0" for i in range(50)))
    assert "expected a route of 10 m or more, got 0.0 m" in refused(capsys, road, "--route", tmp_path / "still.csv")
    assert "no.csv" in refused(capsys, road, "--route", tmp_path / "no.csv")


def test_bad_maps_are_one_line(capsys: pytest.CaptureFixture[str], city: Path, tmp_path: Path) -> None:
    assert "cannot be read" in refused(capsys, tmp_path / "no.parquet")
    (tmp_path / "text.parquet").write_text("hello")
    assert "expected a map of egoloc" in refused(capsys, tmp_path / "text.parquet")
    whole = city.read_bytes()
    (tmp_path / "cut.parquet").write_bytes(whole[: len(whole) // 2])
    assert "expected a map of egoloc" in refused(capsys, tmp_path / "cut.parquet")
    (tmp_path / "hit.parquet").write_bytes(whole[:2000] + bytes(200) + whole[2200:])
    message = refused(capsys, tmp_path / "hit.parquet", "--png", tmp_path / "hit.png", "--rrd", tmp_path / "hit.rrd")
    assert "tile 0: damaged" in message
    assert not list(tmp_path.glob("*hit.png*"))
    assert not list(tmp_path.glob("*hit.rrd*"))


def test_an_empty_map_has_nothing_to_say_or_draw(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    write_map(VectorMap(UTM), tmp_path / "empty.parquet")
    info = found(capsys, tmp_path / "empty.parquet")
    assert info["km"] is info["localizability"] is None
    assert sum(info["elements"].values()) == 0
    assert main(["map", "info", str(tmp_path / "empty.parquet")]) == 0
    assert "Localizability is not predicted" in capsys.readouterr().out
    for option in ("--png", "--rrd"):
        name = tmp_path / f"a{option.replace('--', '.')}"
        assert "empty.parquet is empty" in refused(capsys, tmp_path / "empty.parquet", option, name)
        assert [path.name for path in tmp_path.iterdir()] == ["empty.parquet"]


def test_the_picture_shows_where_it_degenerates(capsys: pytest.CaptureFixture[str], road: Path, tmp_path: Path) -> None:
    assert main(["map", "info", str(road), "--png", str(tmp_path / "a.png")]) == 0
    pixels = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    assert pixels.shape[0] > 900
    red = (pixels - (179, 17, 38) == 0).all(axis=2) | (np.abs(pixels - (165, 0, 38)).max(axis=2) < 20)
    upper = red[: pixels.shape[0] // 2]
    rows = np.flatnonzero(upper.sum(axis=1) > 300)
    assert len(rows)  # the route, red over most of its width, but for its ends and the pole in its middle
    columns = np.flatnonzero(upper[rows[len(rows) // 2]])
    assert np.diff(columns).max() > 40
    before = (tmp_path / "a.png").read_bytes()
    assert main(["map", "info", str(road), "--png", str(tmp_path / "a.png")]) == 0
    assert (tmp_path / "a.png").read_bytes() == before
    capsys.readouterr()


def test_the_recording_holds_map_and_route(capsys: pytest.CaptureFixture[str], city: Path, tmp_path: Path) -> None:
    assert main(["map", "info", str(city), "--rrd", str(tmp_path / "a.rrd")]) == 0
    capsys.readouterr()
    chunks = rr.chunk.RrdReader(tmp_path / "a.rrd").stream().to_chunks()
    paths = {chunk.entity_path for chunk in chunks}
    kinds = {"lane_line", "road_boundary", "stop_line", "crossing", "marking", "pole", "sign"}
    assert {f"/map/{kind}/lines" for kind in kinds} <= paths
    assert {"/map/surfel", "/predicted/lon", "/predicted/lat", "/predicted/yaw", "/summary"} <= paths


def test_targets_are_pictures_and_recordings(capsys: pytest.CaptureFixture[str], road: Path, tmp_path: Path) -> None:
    before = road.read_bytes()
    assert "--png: expected a file name that ends in .png" in refused(capsys, road, "--png", road)
    assert "--rrd: expected a file name that ends in .rrd" in refused(capsys, road, "--rrd", road)
    assert road.read_bytes() == before
    assert "cannot be written" in refused(capsys, road, "--png", tmp_path / "no" / "a.png")
    assert "cannot be written" in refused(capsys, road, "--rrd", tmp_path / "no" / "a.rrd")
    assert "--limits: expected one of" in refused(capsys, road, "--limits", "loose")


def test_large_maps_are_weighed_by_samples(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    write_map(city_map(8.0, 3), tmp_path / "a.parquet")
    with open_map(tmp_path / "a.parquet") as opened:
        whole, how = kind_bytes(opened)
        assert how == "whole"
        monkeypatch.setattr(map_info_module, "WHOLE_ROWS", 1000)
        sampled, how = kind_bytes(opened)
        assert how == "samples"
    assert sampled["surfel"] == pytest.approx(whole["surfel"], rel=0.15)
    assert sampled.keys() == whole.keys()


def test_a_scale_bar_is_of_a_round_length() -> None:
    assert [round_length(most) for most in (1.0, 1.9, 2.0, 9.9, 45.0, 1234.0)] == [1.0, 1.0, 2.0, 5.0, 20.0, 1000.0]
