"""Scenarios written as logs: replayed, they are the drives that a campaign simulates; along a real trajectory too."""

import json
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from replay.cli import main
from tests.conftest import ROOT

NANOMETRES = 3e-9
"""What degrees of latitude and longitude in a GPSFix leave of a place; everything else in a log is exact."""


def metrics(log: str, run: Path) -> dict[str, Any]:
    assert main(["replay", log, "--out", str(run)]) == 0
    found: dict[str, Any] = json.loads((run / "metrics.json").read_text())
    return found


def figures(of: Any) -> list[Any]:
    """Everything in metrics, one after the other with its keys."""
    if isinstance(of, dict):
        return [entry for key, value in of.items() for entry in (key, *figures(value))]
    if isinstance(of, list):
        return [entry for value in of for entry in figures(value)]
    return [of]


def alike(ours: list[Any], theirs: list[Any]) -> None:
    for one, other in zip(ours, theirs, strict=True):
        assert one == (pytest.approx(other, rel=1e-8, abs=NANOMETRES) if isinstance(other, float) else other)


def test_a_written_drive_is_replayed_as_the_one_in_memory(tmp_path: Path) -> None:
    path = tmp_path / "road.mcap"
    assert main(["simulate", "road-test", str(path), "--length-km", "2", "--seed", "3"]) == 0
    assert main(["info", str(path)]) == 0
    both = (
        metrics(str(path), tmp_path / "written"),
        metrics("scenario:road-test,seed=3,length_km=2", tmp_path / "in_memory"),
    )
    estimates = [found.pop("estimates") for found in both]
    written, in_memory = map(figures, both)
    assert len(written) == len(in_memory) > 300
    alike(written, in_memory)
    assert len(estimates[0]) == len(estimates[1]) > 1
    for one, other in zip(*estimates, strict=True):  # that of a place's sigma is so much of an estimate's as well
        share = NANOMETRES / 0.01 * other["sigma"]
        assert one.pop("value") == pytest.approx(other.pop("value"), abs=share)
        alike(figures(one), figures(other))


def test_the_scenario_of_the_docs_along_the_boreas_drive_is_simulated_and_replayed(data: Path, tmp_path: Path) -> None:
    (given,) = (data / "boreas").glob("*_poses.csv")
    (snippet,) = re.findall(r'```toml\n(name = "boreas".*?)```', (ROOT / "docs/simulation.md").read_text(), re.DOTALL)
    scenario, path = tmp_path / "boreas.toml", tmp_path / "boreas.mcap"
    scenario.write_text(snippet)
    (tmp_path / given.name).symlink_to(given.resolve())
    assert main(["simulate", str(scenario), str(path), "--duration-s", "300"]) == 0
    found = metrics(str(path), tmp_path / "run")
    # the file's own positions, row by row, over the 300 s that are scored
    assert found["distance_m"] == pytest.approx(driven_m(given, 300.0), rel=0.005)
    assert found["methods"]["fusion"]["ar"] > 0.999
    assert set(found["slices"]["scene"]) == {"city"}


def driven_m(poses: Path, seconds: float) -> float:
    """Metres between the rows of a Boreas file's first seconds."""
    rows = [[float(field) for field in line.split(",")[:3]] for line in poses.read_text().splitlines()[1:]]
    inside = [(x, y) for t, x, y in rows if t <= rows[0][0] + seconds * 1e6]
    return sum(math.dist(one, other) for one, other in pairwise(inside))
