"""Campaigns in this process: layout, failures, resuming, refusals."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from replay.campaign_folder import LOCK
from replay.cli import main
from replay.sources import BESIDE
from replay.store import StorageError
from tests.replay.fleet import CAMPAIGN_FILES, LOG_FILES, content, tiny

DRIVES = 4
DOCS = Path(__file__).parents[2] / "docs/campaigns.md"
NAMES = [f"tiny-{seed:06d}" for seed in range(DRIVES)]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> str:
    return tiny(tmp_path_factory.mktemp("scenario"), DRIVES)


@pytest.fixture(scope="module")
def campaign(logs: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign that nothing disturbed, not to be changed."""
    out = tmp_path_factory.mktemp("campaign") / "run"
    assert main(["replay", logs, "--out", str(out), "--workers", "1"]) == 0
    return out


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that must fail with exit code 2; its one line on standard error."""

    def refuse(*arguments: object) -> str:
        assert main([str(a) for a in arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith("egoloc: error: ")
        assert error.count("\n") == 1
        return error

    return refuse


def test_a_campaign_is_a_run_folder_per_log_and_the_metrics_of_all(campaign: Path) -> None:
    assert sorted(path.name for path in campaign.iterdir()) == sorted([*CAMPAIGN_FILES, *NAMES])
    assert [sorted(path.name for path in (campaign / name).iterdir()) for name in NAMES] == [LOG_FILES] * DRIVES
    whole = json.loads((campaign / "metrics.json").read_text())
    parts = [json.loads((campaign / name / "metrics.json").read_text()) for name in NAMES]
    assert whole["logs"] == {"total": DRIVES, "done": DRIVES, "failed": []}
    assert whole["epochs"] == sum(part["epochs"] for part in parts)
    assert whole["duration_s"] == pytest.approx(sum(part["duration_s"] for part in parts), rel=1e-12)
    manifest = json.loads((campaign / "manifest.json").read_text())
    assert manifest["kind"] == "campaign"
    assert [log["name"] for log in manifest["logs"]] == NAMES
    seeds = [json.loads((campaign / name / "manifest.json").read_text())["log"]["seed"] for name in NAMES]
    assert seeds == list(range(DRIVES))


def test_the_tables_of_all_logs_are_one_dataset(campaign: Path) -> None:
    table = pq.ParquetDataset([campaign / name / "states.parquet" for name in NAMES]).read(["log", "t_ns"])
    assert sorted(set(table["log"].to_pylist())) == NAMES
    assert pq.read_table(campaign / "segments.parquet")["log"].unique().to_pylist() == NAMES


def test_the_snippet_of_the_docs(campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    shutil.copytree(campaign, "runs/road-test")
    found: dict[str, Any] = {}
    exec(re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)[0], found)
    assert found["rows"].schema.names == ["log", "t_ns", "err_lon"]
    assert set(found["states"].to_table(columns=["log"])["log"].to_pylist()) == set(NAMES)


def test_a_log_alone_gives_the_same_run_folder(campaign: Path, logs: str, tmp_path: Path) -> None:
    alone = f"{logs.partition(',')[0]},seed=2"
    assert main(["replay", alone, "--out", str(tmp_path / "run")]) == 0
    assert content(tmp_path / "run") == content(campaign / NAMES[2])


def test_resuming_takes_what_is_finished_and_runs_the_rest(
    campaign: Path, logs: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(campaign, out)
    for name in ("metrics.json", "segments.parquet", "percentiles.parquet"):
        (out / name).unlink()
    shutil.rmtree(out / NAMES[0])  # never begun
    (out / f".{NAMES[1]}.99999999.tmp").mkdir()  # begun by a process that died
    (out / NAMES[1] / "segments.parquet").write_bytes(b"PAR1")  # damaged
    before = (out / NAMES[2] / "states.parquet").stat().st_mtime_ns
    assert main(["score", str(out / NAMES[3]), "--limits", "highway"]) == 0  # not what the campaign asks for
    assert main(["replay", logs, "--out", str(out), "--workers", "1", "--resume"]) == 0
    assert "Replayed 3 of 3 logs" in capsys.readouterr().err
    assert (out / NAMES[2] / "states.parquet").stat().st_mtime_ns == before
    assert content(out, command=True).keys() == content(campaign, command=True).keys()
    assert content(out) == content(campaign)

    assert main(["replay", logs, "--out", str(out), "--workers", "1", "--resume", "--json"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""  # nothing was replayed
    assert json.loads(printed.out) == json.loads((campaign / "metrics.json").read_text())


def test_resuming_goes_on_with_the_same_logs_and_settings_only(
    campaign: Path, logs: str, tmp_path: Path, refused: Callable[..., str]
) -> None:
    before = content(campaign, command=True)
    again = ("--out", campaign, "--workers", "1", "--resume")
    fewer = f"{logs.partition(',')[0]},drives={DRIVES - 1}"
    assert f"expected the logs that it was begun with ({DRIVES}, got {DRIVES - 1})" in refused("replay", fewer, *again)
    assert ",seed=0, got scenario:tiny,seed=1)" in refused("replay", f"{logs},seed=1", *again)
    assert "expected the configuration" in refused("replay", logs, *again, "--limits", "highway")
    kept = "expected the --states-hz and --decisions that it was begun with (all and all, got 1.0 and all)"
    assert kept in refused("replay", logs, *again, "--states-hz", "1")
    one = f"{logs.partition(',')[0]},seed=1"
    assert "expected the run of one log, got a campaign" in refused("replay", one, *again)
    assert "expected one of them" in refused("replay", logs, *again, "--overwrite")
    assert "exists already: expected --resume, --overwrite" in refused("replay", logs, "--out", campaign)
    assert content(campaign, command=True) == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    assert "expected the folder of a campaign" in refused("replay", logs, "--out", tmp_path / "mine", "--resume")
    assert "this is none or holds other files" in refused("replay", logs, "--out", tmp_path / "mine", "--overwrite")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_a_changed_log_runs_again(logs: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [tmp_path / f"{name}.mcap" for name in "ab"]
    for seed, path in enumerate(paths):
        assert main(["simulate", "clean", str(path), "--duration-s", "20", "--seed", str(seed)]) == 0
    command = ["replay", *map(str, paths), "--out", str(tmp_path / "run"), "--workers", "1"]
    assert main(command) == 0
    capsys.readouterr()
    assert main(["simulate", "clean", str(paths[1]), "--duration-s", "20", "--seed", "7", "--overwrite"]) == 0
    assert main([*command, "--resume"]) == 0
    assert "Replayed 1 of 1 logs" in capsys.readouterr().err
    assert main([*command[:4], str(tmp_path / "anew"), "--workers", "1"]) == 0
    assert content(tmp_path / "run") == content(tmp_path / "anew")


def test_overwriting_replaces_a_campaign(logs: str, campaign: Path, tmp_path: Path) -> None:
    shutil.copytree(campaign, tmp_path / "run")
    (tmp_path / "run" / NAMES[3] / "run.rrd").write_text("a recording does not protect a run")
    one = f"{logs.partition(',')[0]},drives=2,seed=0"
    assert main(["replay", one, "--out", str(tmp_path / "run"), "--workers", "1", "--overwrite"]) == 0
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == sorted([*CAMPAIGN_FILES, *NAMES[:2]])


def test_one_log_resumes_too(
    logs: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    log = f"{logs.partition(',')[0]},seed=1"
    command = ["replay", log, "--out", str(tmp_path / "run"), "--resume"]
    (tmp_path / ".run.99999999.tmp").mkdir()
    assert main(command) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    before = (tmp_path / "run/metrics.json").stat().st_mtime_ns
    capsys.readouterr()
    assert main(command) == 0
    assert "Fusion" in capsys.readouterr().out
    assert (tmp_path / "run/metrics.json").stat().st_mtime_ns == before
    assert "a run with other log" in refused("replay", f"{log[:-1]}2", *command[2:])
    assert "a run with other configuration" in refused(*command, "--limits", "highway")


def test_view_wants_one_of_the_logs(campaign: Path, refused: Callable[..., str]) -> None:
    error = refused("view", campaign, "--no-open")
    assert f"as in {campaign / NAMES[0]}; there are {', '.join(NAMES)}" in error
    assert main(["view", str(campaign / NAMES[1]), "--no-open", "--rrd", str(campaign.parent / "one.rrd")]) == 0
    assert (campaign.parent / "one.rrd").stat().st_size > 0


@pytest.mark.parametrize("moment", ["merge", "write_json"])
def test_ctrl_c_while_merging(
    moment: str,
    logs: str,
    campaign: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from replay import campaign as module

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module, moment, stop)
    command = ["replay", logs, "--out", str(tmp_path / "run"), "--workers", "1"]
    assert main(command) == 130
    counted, said = capsys.readouterr().err.splitlines()
    assert counted.startswith("Replayed 4 of 4 logs")
    assert said == "egoloc: interrupted: the same command with --resume goes on"
    assert not (tmp_path / "run/metrics.json").exists()
    monkeypatch.undo()
    assert main([*command, "--resume"]) == 0
    assert capsys.readouterr().err == ""  # nothing was replayed
    assert content(tmp_path / "run") == content(campaign)


def test_a_folder_that_is_taken_away_is_told(
    logs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from replay import campaign as module

    right = module.merge

    def taken(parts: Any) -> Any:
        whole = right(parts)
        shutil.rmtree(tmp_path / "run")
        return whole

    monkeypatch.setattr(module, "merge", taken)
    out = tmp_path / "run"
    assert main(["replay", logs, "--out", str(out), "--workers", "1"]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith(f"egoloc: error: {out}: cannot be written: No such file or directory; with that mended, ")
    assert not out.exists()


def test_two_at_once_are_refused(campaign: Path, logs: str, tmp_path: Path, refused: Callable[..., str]) -> None:
    import fcntl

    with (tmp_path / LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert "another egoloc replay is at work there" in refused("replay", logs, "--out", tmp_path, "--resume")
    assert [path.name for path in tmp_path.iterdir()] == [LOCK]


class TestFailures:
    def test_a_corrupt_log_does_not_stop_the_others(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        _among(12, tmp_path, capsys)

    @pytest.mark.slow
    def test_among_a_hundred(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        _among(100, tmp_path, capsys)

    def test_a_bug_leaves_its_traceback(
        self, logs: str, campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from replay import harness

        right = harness.replay_source

        def wrong(source: object, *args: object, **options: object) -> object:
            if getattr(source, "name", "") == NAMES[1]:
                raise ZeroDivisionError("1 / 0")
            return right(source, *args, **options)  # type: ignore[arg-type]

        monkeypatch.setattr(harness, "replay_source", wrong)
        command = ["replay", logs, "--out", str(tmp_path / "run"), "--workers", "1"]
        assert main(command) == 1
        text = (tmp_path / "run" / f"{NAMES[1]}.error.txt").read_text()
        assert text.startswith("Traceback")
        assert "ZeroDivisionError: 1 / 0" in text
        monkeypatch.undo()
        assert main([*command, "--resume"]) == 0
        assert content(tmp_path / "run") == content(campaign)

    def test_a_full_disk_stops_it_at_once(
        self,
        logs: str,
        campaign: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        from replay import harness

        right, begun = harness.replay_source, []

        def full(source: object, out: Path, *args: object, **options: object) -> object:
            begun.append(out.name)
            if len(begun) == 2:
                raise StorageError(f"{out}: cannot be written: No space left on device")
            return right(source, out, *args, **options)  # type: ignore[arg-type]

        monkeypatch.setattr(harness, "replay_source", full)
        command = ["replay", logs, "--out", str(tmp_path / "run"), "--workers", "1"]
        assert main(command) == 2
        counted, error = capsys.readouterr().err.splitlines()
        assert counted.startswith("Replayed 1 of 4 logs")
        assert error.endswith("No space left on device; with that mended, the same command with --resume goes on")
        assert begun == NAMES[:2]
        assert not (tmp_path / "run/metrics.json").exists()
        monkeypatch.undo()
        assert main([*command, "--resume"]) == 0
        assert content(tmp_path / "run") == content(campaign)

    def test_when_all_fail_there_are_no_metrics(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for name in "ab":
            (tmp_path / f"{name}.mcap").write_bytes(b"no log")
        logs = [str(tmp_path / f"{name}.mcap") for name in "ab"]
        assert main(["replay", *logs, "--out", str(tmp_path / "run"), "--workers", "1"]) == 1
        error = capsys.readouterr().err
        assert "2 of 2 logs failed" in error
        assert all(f"FAILED: {log}: " in error for log in logs)
        assert not (tmp_path / "run/metrics.json").exists()


def _among(count: int, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One of many logs is cut to pieces: it is told, and the others come out as without it."""
    good = folder / "good.mcap"
    assert main(["simulate", "clean", str(good), "--duration-s", "20"]) == 0
    paths = [folder / f"log-{number:03d}.mcap" for number in range(count)]
    for path in paths:
        shutil.copy(good, path)
    bad = paths[count // 2]
    bad.write_bytes(good.read_bytes()[:200])
    assert main(["replay", *map(str, paths), "--out", str(folder / "run"), "--workers", "2"]) == 1
    told = capsys.readouterr()
    assert f"1 of {count} logs failed" in told.err
    assert "Fusion" in told.out
    metrics = json.loads((folder / "run/metrics.json").read_text())
    assert metrics["logs"]["done"] == count - 1
    assert [entry["log"] for entry in metrics["logs"]["failed"]] == [bad.stem]
    assert str(bad) in metrics["logs"]["failed"][0]["error"]
    assert str(bad) in (folder / "run" / f"{bad.stem}.error.txt").read_text()
    assert not (folder / "run" / bad.stem).exists()
    one = json.loads((folder / "run" / paths[0].stem / "metrics.json").read_text())
    assert metrics["epochs"] == (count - 1) * one["epochs"]


class TestSources:
    def test_mistakes(self, tmp_path: Path, refused: Callable[..., str]) -> None:
        out = ("--out", tmp_path / "run")
        assert "expected an MCAP log, got a folder" in refused("replay", tmp_path, *out)
        assert "expected a .toml file or one of the scenarios" in refused("replay", "scenario:moon,drives=2", *out)
        assert "got 'speed=3'" in refused("replay", "scenario:clean,speed=3", *out)
        assert "expected the name or the TOML file of a scenario" in refused("replay", "scenario:,drives=2", *out)
        for drives in ("0", "-1", "x", "", "1e9"):
            said = f"drives: expected a number from 1 to 1,000,000, got '{drives}'"
            assert said in refused("replay", f"scenario:clean,drives={drives}", *out)
        assert "drives: expected one value, got '2' and '3'" in refused(
            "replay", "scenario:clean,drives=2,drives=3", *out
        )
        for km in ("far", "0", "-1", "nan", "inf", "1e7"):
            said = f"length_km: expected kilometres, more than 0 and at most 1,000,000, got '{km}'"
            assert said in refused("replay", f"scenario:clean,length_km={km}", *out)
        assert "duration_s: expected seconds, from 1 to a week" in refused(
            "replay", "scenario:clean,duration_s=1e6", *out
        )
        assert "--workers: expected 1 or more" in refused("replay", "scenario:clean", *out, "--workers", "0")
        assert "--workers and --ray" in refused("replay", "scenario:clean", *out, "--workers", "2", "--ray", "local")
        assert "expected a scenario with a network" in refused("replay", "scenario:clean,network=3", *out)
        twice = refused("replay", "scenario:clean,drives=2", "scenario:clean,duration_s=9,seed=3", *out)
        assert "got 'clean-000003' twice" in twice
        for name in (*BESIDE, LOCK, "a.error.txt", "run.rrd"):
            said = refused("replay", tmp_path / f"{name}.mcap", tmp_path / "a.mcap", *out)
            assert f"{name!r} cannot be the name of a run folder" in said
        assert list(tmp_path.iterdir()) == []
