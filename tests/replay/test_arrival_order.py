"""Replays in arrival order: chosen by config or flag, told in the metrics, the same bytes whoever runs them."""

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from fusion.result import Reason
from replay.cli import main
from tests.replay.fleet import content, tiny

DRIVES = 2


def metrics_of(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "metrics.json").read_text())
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign in each order."""
    folder = tmp_path_factory.mktemp("orders")
    for order in ("stamp", "arrival"):
        out = ("--out", str(folder / order), "--workers", "1", "--order", order)
        assert main(["replay", tiny(folder, DRIVES), *out]) == 0
    return folder


def test_the_metrics_and_the_config_say_which_order_it_was(folder: Path) -> None:
    for order in ("stamp", "arrival"):
        assert metrics_of(folder / order)["order"] == order
        assert f'order = "{order}"' in (folder / order / "config.toml").read_text()
        for seed in range(DRIVES):
            assert metrics_of(folder / order / f"tiny-{seed:06d}")["order"] == order


def test_what_comes_late_costs_accuracy_and_nothing_else(folder: Path) -> None:
    """Fusion is scored by what was known; sensors are scored as before, and no measurement is lost."""
    stamp, arrival = metrics_of(folder / "stamp"), metrics_of(folder / "arrival")
    for sensor in ("gnss", "egovm"):
        assert arrival["methods"][sensor] == stamp["methods"][sensor]
    worse = arrival["methods"]["fusion"]["lat"]["mae"] / stamp["methods"]["fusion"]["lat"]["mae"]
    assert 1.0 < worse < 2.0
    assert arrival["methods"]["fusion"]["coverage"] == pytest.approx(stamp["methods"]["fusion"]["coverage"], abs=0.02)
    for seed in range(DRIVES):
        name = f"tiny-{seed:06d}"
        tables = [pq.read_table(folder / order / name / "decisions.parquet") for order in ("stamp", "arrival")]
        counts = [sorted(zip(t["sensor"].to_pylist(), t["row"].to_pylist(), strict=True)) for t in tables]
        measured = [[entry for entry in found if entry[1] >= 0] for found in counts]
        assert measured[0] == measured[1]
        assert Reason.LATE not in tables[1]["reason"].to_pylist()
        arrivals = tables[1]["arrival_ns"].to_numpy() - tables[1]["t_ns"].to_numpy()
        assert arrivals.max() > 100_000_000


def test_the_config_chooses_too_and_the_flag_goes_before_it(folder: Path, tmp_path: Path) -> None:
    config = tmp_path / "arrival.toml"
    config.write_text('[fusion]\norder = "arrival"\nhistory_s = 0.5\n')
    log = tiny(tmp_path, 1)
    assert main(["replay", log, "--out", str(tmp_path / "a"), "--config", str(config)]) == 0
    assert metrics_of(tmp_path / "a")["order"] == "arrival"
    assert metrics_of(tmp_path / "a")["methods"] == metrics_of(folder / "arrival" / "tiny-000000")["methods"]
    out = ("--out", str(tmp_path / "b"), "--config", str(config), "--order", "stamp")
    assert main(["replay", log, *out]) == 0
    assert metrics_of(tmp_path / "b")["methods"] == metrics_of(folder / "stamp" / "tiny-000000")["methods"]


def test_the_same_bytes_again_and_by_other_workers(folder: Path, tmp_path: Path) -> None:
    out = ("--out", str(tmp_path / "again"), "--workers", "2", "--order", "arrival")
    assert main(["replay", tiny(folder, DRIVES), *out]) == 0
    assert content(tmp_path / "again") == content(folder / "arrival")


def test_hidden_gnss(folder: Path, tmp_path: Path) -> None:
    out = ("--out", str(tmp_path / "run"), "--hide-gnss", "10:3", "--order", "arrival")
    assert main(["replay", tiny(tmp_path, 1), *out]) == 0
    found = metrics_of(tmp_path / "run")
    assert found["order"] == "arrival"
    assert found["hidden"]["stretches"] == 2
    assert found["hidden"]["end_horizontal_m"]["max"] < 0.5


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('order = "arival"', "fusion.order: expected one of stamp, arrival, got 'arival'"),
        ("history_s = 0.0", "fusion.history_s: expected `float` > 0.0, got 0.0"),
        ("history_s = 20.0", "fusion.history_s: expected `float` <= 10.0, got 20.0"),
    ],
)
def test_mistakes(text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "wrong.toml"
    config.write_text(f"[fusion]\n{text}\n")
    assert main(["replay", tiny(tmp_path, 1), "--out", str(tmp_path / "run"), "--config", str(config)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
