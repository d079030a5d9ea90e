"""egoloc score: a run or a campaign again from its tables."""

import json
from pathlib import Path

import pytest

from replay.batch import Job
from replay.campaign import backend_of, run_campaign
from replay.cli import main
from replay.config import RunConfig
from replay.sources import parse
from replay.store import Keep
from replay.sums import read_segments
from tests.replay.fleet import tiny

SCORED = ("metrics.json", "segments.parquet", "percentiles.parquet")


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives of half a minute."""
    folder = tmp_path_factory.mktemp("campaign")
    return replayed(folder, Keep())


def replayed(folder: Path, keep: Keep) -> Path:
    sources = parse(tiny(folder, 2))
    run_campaign(sources, folder / "run", Job(RunConfig(), keep), backend_of(len(sources), 1))
    return folder / "run"


def scores(run: Path) -> dict[str, bytes]:
    found = sorted(path for path in run.rglob("*") if path.name in SCORED)
    return {str(path.relative_to(run)): path.read_bytes() for path in found}


def test_the_same_limits_give_the_same_bytes(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = scores(campaign)
    assert len(before) == 9
    assert main(["score", str(campaign), "--limits", "highway"]) == 0
    other = scores(campaign)
    assert all(other[name] != before[name] for name in before if not name.endswith("percentiles.parquet"))
    capsys.readouterr()
    assert main(["score", str(campaign), "--json"]) == 0
    assert scores(campaign) == before
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(before["metrics.json"])
    assert printed["logs"] == {"total": 2, "done": 2, "failed": []}


def test_one_log_of_it_is_a_run(campaign: Path) -> None:
    log = next(path for path in sorted(campaign.iterdir()) if path.is_dir())
    before = scores(campaign)
    assert main(["score", str(log)]) == 0
    assert scores(campaign) == before
    _, segments = read_segments(log)
    assert segments.texts["log"] == (log.name,)


def test_thinned_tables_are_refused_and_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = replayed(tmp_path, Keep(states_hz=1.0))
    before = scores(run)
    capsys.readouterr()
    assert main(["score", str(run)]) == 2
    error = capsys.readouterr().err
    assert "cannot be scored again" in error
    assert error.count("\n") == 1
    assert scores(run) == before


def test_a_campaign_that_is_not_finished(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "manifest.json").write_text('{"kind": "campaign", "logs": []}')
    assert main(["score", str(tmp_path)]) == 2
    assert "the campaign is not finished: go on with egoloc replay --resume" in capsys.readouterr().err
