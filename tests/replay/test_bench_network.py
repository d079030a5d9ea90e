"""egoloc bench network: every row is there, and parts add up to the whole."""

import pytest

from egovm.config import SMALL
from egovm.network import EgoVM
from replay.bench.network import PARTS, TIMED, run
from replay.cli import main


@pytest.mark.slow
def test_its_json_has_every_row() -> None:
    result = run(repeats=1, paper=False)
    assert set(result) == {"bench", "rows", "ratios", "conditions"}
    median = {(row["name"], row["metric"]): row["median"] for row in result["rows"]}
    assert len(median) == len(result["rows"])
    for turn in ("small, full", "small, visual", "small, lidar", "small-lidar", "small, full float32"):
        parts = sum(median.get((f"{turn}, threads 1: {part}", "ms"), 0.0) for part in TIMED)
        assert 0.5 * median[f"{turn}, threads 1", "ms"] < parts < median[f"{turn}, threads 1", "ms"]
    for preset in ("small-lidar", "small", "paper"):
        for metric in ("parameters", "multiply_adds"):
            parts = sum(median.get((f"{preset}: {part}", metric), 0.0) for part in PARTS)
            assert parts == pytest.approx(median[preset, metric])
    assert median["small", "parameters"] == sum(p.numel() for p in EgoVM(SMALL).parameters()) < 5e6
    assert median["small, training step", "peak_mb"] < 12_000
    assert all(value > 0.0 for value in result["ratios"].values())


def test_no_repeats_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "network", "--repeats", "0"]) == 2
    assert "--repeats: expected 1 or more, got 0" in capsys.readouterr().err
