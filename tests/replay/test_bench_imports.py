"""egoloc bench imports: figures of a map whose every number is known."""

from pathlib import Path

import pytest

from replay.bench.imports import run
from replay.cli import main
from sensors.geodesy import MapFrame
from sensors.maps.builder import Builder
from sensors.maps.geojson_out import write_geojson
from sensors.maps.vector_map import Kind


def test_its_rows_are_of_the_map(tmp_path: Path) -> None:
    builder = Builder("street")
    builder.add(Kind.LANE_LINE, [[0.0, 0.0], [1000.0, 0.004]])
    builder.add(Kind.LANE_LINE, [[0.0, 3.5, 110.0], [1000.0, 3.5, 110.002]])
    builder.add(Kind.LANE_LINE, [[0.0, 3.5, 110.0], [1000.0, 3.5, 110.002]])
    source = tmp_path / "street.geojson"
    write_geojson(builder.built(MapFrame("utm", (455_000.0, 5_427_000.0, 0.0), 32), road_km=2.0), source)
    result = run([source], repeats=2)
    median = {row["metric"]: row["median"] for row in result["rows"]}
    assert (median["elements"], median["left_out"], median["km"]) == (3, 0, 2.0)
    assert median["s_per_km"] == pytest.approx(median["s"] / 2.0)
    assert 0.2 < median["greatest_change_cm"] <= 0.51
    assert result["conditions"]["formats"] == {"street.geojson": "geojson"}


def test_no_source_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "imports"]) == 2
    assert "--sources: expected 1 or more" in capsys.readouterr().err
