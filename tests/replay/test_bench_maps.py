"""egoloc bench maps: every row is there, and its figures are of the map that it says."""

import pytest

from replay.bench.maps import run
from replay.cli import main


def test_its_json_has_every_row() -> None:
    result = run(repeats=1, km=2.0)
    assert set(result) == {"bench", "rows", "ratios", "conditions"}
    median = {(row["name"], row["metric"]): row["median"] for row in result["rows"]}
    assert len(median) == len(result["rows"])
    kinds = {name for name, metric in median if metric == "mb_per_km" and "," not in name}
    elements = {"lane_line", "road_boundary", "stop_line", "crossing", "marking", "pole", "sign"}
    assert kinds == {*elements, "surfel", "elements", "all"}
    columns = sum(value for (name, _), value in median.items() if name.startswith("all, "))
    assert columns == pytest.approx(median["all", "mb_per_km"], rel=0.02)
    assert median["query, cached", "ms"] < median["query, first", "ms"]
    facts = result["conditions"]
    assert median["surfel", "per_km"] == pytest.approx(facts["rows"]["surfel"] / facts["km"])
    assert facts["bytes"] / 1e6 / facts["km"] == pytest.approx(median["all", "mb_per_km"])


def test_a_map_of_no_length_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "maps", "--km", "0"]) == 2
    assert "--km: expected numbers above 0, got 0" in capsys.readouterr().err
