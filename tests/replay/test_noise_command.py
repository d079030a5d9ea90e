"""egoloc noise: what a run's decisions say, what its log says when filtered again, and bad input."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fusion.innovations import consistency
from fusion.result import Sensor
from fusion.run import run as fuse
from replay.cli import main
from replay.config import load_config
from replay.noise import read_decisions
from sensors.mcap.io import read_log

SCENARIO = "scenario:clean,duration_s=60"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log and its run."""
    folder = tmp_path_factory.mktemp("noise")
    assert main(["simulate", "clean", str(folder / "log.mcap"), "--duration-s", "60"]) == 0
    assert main(["replay", str(folder / "log.mcap"), "--out", str(folder / "run")]) == 0
    return folder


def test_a_table_says_what_the_filter_said(made: Path) -> None:
    """decisions.parquet keeps 32 bits of each innovation."""
    stored = consistency(read_decisions(made / "run" / "decisions.parquet"))
    fresh = consistency(fuse(read_log(made / "log.mcap")).decisions)
    assert len(stored) == len(fresh) == 8
    for a, b in zip(stored, fresh, strict=True):
        assert (a.sensor, a.axis, a.count) == (b.sensor, b.axis, b.count)
        assert a.factor == pytest.approx(b.factor, rel=1e-5)


def test_without_its_log_the_decisions_alone_are_judged(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gone, away = made / "log.mcap", tmp_path / "away.mcap"
    gone.rename(away)
    try:
        assert main(["noise", str(made / "run"), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert main(["noise", str(made / "run")]) == 0
    finally:
        away.rename(gone)
    printed = capsys.readouterr().out
    assert found["estimate"] is None
    assert found["missing"] == f"the log {gone} is not there: give it with --log"
    assert f"Note: no noise was looked for: {found['missing']}." in printed
    by_axis = {(each["sensor"], each["axis"]): each for each in found["innovations"]}
    assert 0.1 < by_axis["gnss_position", "horizontal"]["factor"] < 1.1  # the default expects more than is there
    assert by_axis["gnss_velocity", "vertical"]["factor"] == pytest.approx(1.0, abs=0.2)
    assert by_axis["pose_fix", "lateral"]["count"] > 500


def test_a_log_that_changed_is_not_taken_for_that_of_the_run(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = made / "log.mcap"
    whole = log.read_bytes()
    log.write_bytes(whole + b"\0")
    try:
        assert main(["noise", str(made / "run"), "--json"]) == 0
    finally:
        log.write_bytes(whole)
    assert json.loads(capsys.readouterr().out)["missing"] == f"the log {log} has changed since: give it with --log"


def test_a_simulated_drive_of_another_length_is_not_taken_for_that_of_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", SCENARIO, "--out", str(tmp_path / "run")]) == 0
    capsys.readouterr()
    assert main(["noise", str(tmp_path / "run"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["missing"] == (
        "scenario:clean,seed=2 is not the drive of this run: give it with --log"
    )


def test_its_log_is_filtered_for_the_noise_that_makes_it_likely(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """White noise as large as stated is found within what forty seconds can tell, and lines that a config takes."""
    capsys.readouterr()
    assert main(["noise", str(made / "run"), "--json", "--duration-s", "40"]) == 0
    found = json.loads(capsys.readouterr().out)
    for name in ("gnss.inflation", "gnss.velocity_inflation", "pose.inflation"):
        each = found["estimate"][name]
        assert each["low"] < 1.1
        assert each["high"] > 0.9
    assert found["estimate"]["gnss.velocity_inflation"]["value"] == pytest.approx(1.0, abs=0.15)
    assert found["runs"] > 9
    then = {(each["sensor"], each["axis"]): each for each in found["innovations_then"]}
    assert then["gnss_position", "horizontal"]["factor"] == pytest.approx(1.0, abs=0.2)
    assert then["gnss_position", "horizontal"]["count"] < 410
    (tmp_path / "found.toml").write_text(found["config_toml"])
    config = load_config(tmp_path / "found.toml")
    velocity, pose = found["estimate"]["gnss.velocity_inflation"], config.fusion.pose
    assert config.fusion.gnss.velocity_inflation == pytest.approx(velocity["value"], rel=0.01)
    assert pose.inflation == pytest.approx(found["estimate"]["pose.inflation"]["value"], rel=0.01)
    assert pose.white_share + pose.lasting_share == pytest.approx(1.0)  # what is found is one variance, divided
    assert not found["estimate"]["gnss.inflation"]["observed"]  # forty seconds are too short for that
    assert config.fusion.gnss.inflation == 1.0
    assert main(["noise", str(made / "run"), "--duration-s", "40"]) == 0
    printed = capsys.readouterr().out
    assert "Most likely noise" in printed
    assert found["config_toml"].splitlines()[0] in printed


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (lambda run: run / "nothing", (), "expected a run folder"),
        (lambda run: run, ("--duration-s", "0"), "--duration-s: expected more than 0, got 0"),
        (lambda run: run, ("--log", "nothing.mcap"), "nothing.mcap"),
    ],
)
def test_bad_input_ends_in_one_line(
    made: Path,
    spoil: Callable[[Path], Path],
    options: tuple[str, ...],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["noise", str(spoil(made / "run")), *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_run_without_all_decisions_is_refused(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "thin"
    assert main(["replay", str(made / "log.mcap"), "--out", str(out), "--decisions", "rejected"]) == 0
    capsys.readouterr()
    assert main(["noise", str(out)]) == 2
    assert "expected a run with all decisions" in capsys.readouterr().err


def test_decisions_of_every_kind_are_read(made: Path) -> None:
    read = read_decisions(made / "run" / "decisions.parquet")
    fresh = fuse(read_log(made / "log.mcap")).decisions
    np.testing.assert_array_equal(np.sort(read.sensor), np.sort(fresh.sensor))
    np.testing.assert_array_equal(np.bincount(read.reason), np.bincount(fresh.reason))
    assert set(np.unique(read.sensor)) >= {Sensor.GNSS_POSITION, Sensor.POSE_FIX, Sensor.WHEEL}
