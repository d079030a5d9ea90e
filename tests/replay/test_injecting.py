"""--inject: faults in runs and campaigns, stored with them, taken up again with --resume, and never passed over."""

import json
import tomllib
from pathlib import Path

import pytest

from replay.cli import main

DRIVE = "scenario:clean,duration_s=30"
SPEC = "pose-covariance-nan:medium@12+5"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A replayed run with two faults, not to be changed."""
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(["replay", DRIVE, "--inject", SPEC, "--inject", "wheel-dropout:mild@15", "--out", str(out)]) == 0
    return out


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("egoloc: error: ")
    assert error.count("\n") == 1
    return error


def test_faults_stand_in_the_run_folder(run: Path) -> None:
    specs = [SPEC, "wheel-dropout:mild@15+2"]
    assert tomllib.loads((run / "config.toml").read_text())["inject"] == specs
    assert json.loads((run / "manifest.json").read_text())["inject"] == specs
    metrics = json.loads((run / "metrics.json").read_text())
    assert [warning["text"] for warning in metrics["warnings"]] == [
        "Fault injected, from 12 s on for 5 s: pose-covariance-nan: every second fix has a covariance without numbers.",
        "Fault injected, from 15 s on for 2 s: wheel-dropout: nothing for 2 s.",
    ]
    assert {warning["kind"] for warning in metrics["warnings"]} == {"injected"}
    (left_out,) = metrics["left_out"]
    assert left_out == {
        "source": "pose_fixes",
        "reason": "pose.covariance of x, y, yaw is not finite",
        "count": left_out["count"],
    }
    assert 20 <= left_out["count"] <= 30


def test_scored_again_it_still_says_so(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "metrics.json").read_text()
    assert main(["score", str(run)]) == 0
    assert (run / "metrics.json").read_text() == before
    assert "WARNING: Fault injected" in capsys.readouterr().out


def test_resuming_needs_the_same_faults(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    again = ["replay", DRIVE, "--out", str(run), "--resume"]
    assert main([*again, "--inject", f"{SPEC}, wheel-dropout:mild@15+2"]) == 0
    assert "other configuration" in refused(capsys, *again, "--inject", SPEC)
    assert "other configuration" in refused(capsys, *again)


def test_the_config_of_a_run_replays_it_bit_for_bit(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    assert main(["replay", DRIVE, "--config", str(run / "config.toml"), "--out", str(out)]) == 0
    for name in ("states.parquet", "decisions.parquet", "metrics.json", "config.toml"):
        assert (out / name).read_bytes() == (run / name).read_bytes()


def test_the_reference_is_not_touched(run: Path, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    out = tmp_path / "plain"
    assert main(["replay", DRIVE, "--out", str(out)]) == 0
    columns = ["t_ns", "ref_x", "ref_y", "ref_yaw"]
    assert pq.read_table(out / "states.parquet", columns=columns).equals(
        pq.read_table(run / "states.parquet", columns=columns)
    )
    assert json.loads((out / "metrics.json").read_text())["warnings"] == []


def test_a_campaign_has_them_in_every_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "campaign"
    command = ["replay", f"{DRIVE},drives=2", "--inject", SPEC, "--out", str(out), "--workers", "1"]
    assert main(command) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["warning_counts"] == {"injected": 2}
    assert json.loads((out / "manifest.json").read_text())["inject"] == [SPEC]
    for log in ("clean-000002", "clean-000003"):
        assert json.loads((out / log / "manifest.json").read_text())["inject"] == [SPEC]
    assert main([*command, "--resume"]) == 0
    assert "expected the configuration that it was begun with" in refused(
        capsys, *command[:2], "--out", out, "--workers", "1", "--resume"
    )


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--inject", "gnss-jmp"], "--inject: expected one of the faults gnss-jump, "),
        (["--inject", "gnss-jump@500"], "expected gnss in that time of the drive, found none"),
        (["--inject", "gnss-jump", "--hide-gnss", "10:2"], "expected no fault of GNSS with --hide-gnss"),
    ],
)
def test_mistakes_cost_a_line_and_leave_nothing(
    options: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert expected in refused(capsys, "replay", DRIVE, *options, "--out", out)
    assert not out.exists()


def test_a_mistake_in_the_config_names_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.toml"
    path.write_text('inject = ["gnss-jump:huge"]\n')
    error = refused(capsys, "replay", DRIVE, "--config", path, "--out", tmp_path / "run")
    assert f"{path}: inject: gnss-jump: expected one of the severities mild, medium, severe" in error


def test_hidden_gnss_goes_with_faults_of_others(tmp_path: Path) -> None:
    out = tmp_path / "run"
    given = ["replay", DRIVE, "--hide-gnss", "10:2", "--inject", "imu-dropout:mild@21", "--out", str(out)]
    assert main(given) == 0
    assert json.loads((out / "metrics.json").read_text())["hidden"]["stretches"] == 2
