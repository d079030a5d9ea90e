"""egoloc bench network: every row is there, and parts add up to the whole."""

import pytest

from egovm.bev_network import BevNetwork
from egovm.config import SMALL
from replay.bench.network import PARTS, run
from replay.cli import main


@pytest.mark.slow
def test_its_json_has_every_row() -> None:
    result = run(repeats=1, paper=False)
    assert set(result) == {"bench", "rows", "ratios", "conditions"}
    median = {(row["name"], row["metric"]): row["median"] for row in result["rows"]}
    assert len(median) == len(result["rows"])
    for mode in ("full", "visual", "lidar", "full all pairs"):
        assert median[f"small, {mode}, threads 1", "ms"] > 0.0
    for preset in ("small", "paper"):
        for metric in ("parameters", "multiply_adds"):
            parts = sum(median[f"{preset}: {part}", metric] for part in PARTS)
            assert parts == pytest.approx(median[preset, metric])
    assert median["small", "parameters"] == sum(p.numel() for p in BevNetwork(SMALL).parameters()) < 5e6
    assert median["small, training step", "peak_mb"] < 12_000
    assert result["ratios"]["fusion, all pairs / seen pairs"] > 0.0


def test_no_repeats_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "network", "--repeats", "0"]) == 2
    assert "--repeats: expected 1 or more, got 0" in capsys.readouterr().err
