"""The command line, run on real small files."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from replay.cli import COMMANDS, main
from replay.commands.benchmarks import BENCHMARKS
from replay.store import file_hash
from sensors.mcap.io import write_log
from sensors.records import Log
from sensors.simulate.drive import simulate
from sensors.simulate.scenarios import load
from tests.replay.fleet import LOG_FILES

DURATION_S = 60.0


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(DURATION_S, 3, load("clean"))


@pytest.fixture(scope="module")
def drive(log: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "drive.mcap"
    write_log(path, log)
    return path


@pytest.fixture(scope="module")
def run(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A replayed run, not to be changed."""
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(["replay", str(drive), "--out", str(out)]) == 0
    return out


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must fail with one line on standard error and exit code 2; that line."""
    assert main([str(a) for a in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("egoloc: error: ")
    assert error.count("\n") == 1
    return error


class TestReplay:
    def test_a_run_folder_is_written_and_the_table_printed(
        self, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = tmp_path / "deep" / "run"
        assert main(["replay", str(drive), "--out", str(out)]) == 0
        text = capsys.readouterr().out
        assert [word in text for word in ("GNSS-RTK", "EgoVM", "Fusion", "Scored: ")] == [True] * 4
        assert sorted(p.name for p in out.iterdir()) == LOG_FILES
        metrics = json.loads((out / "metrics.json").read_text())
        assert metrics["methods"]["fusion"]["ar"] > 0.95
        assert metrics["duration_s"] == pytest.approx(DURATION_S, abs=0.2)
        assert metrics["methods"]["fusion"]["lat"]["mae"] < metrics["methods"]["egovm"]["lat"]["mae"] + 0.05
        manifest = json.loads((out / "manifest.json").read_text())
        assert manifest["log"]["sha256"] == file_hash(drive)
        assert manifest["command"][:2] == ["egoloc", "replay"]

    def test_the_same_log_and_config_give_the_same_bytes(self, drive: Path, run: Path, tmp_path: Path) -> None:
        config = run / "config.toml"  # complete: with the vehicle and the map frame of the log
        assert main(["replay", str(drive), "--out", str(tmp_path / "again"), "--config", str(config)]) == 0
        for name in LOG_FILES:
            if name != "manifest.json":  # holds the command
                assert (tmp_path / "again" / name).read_bytes() == (run / name).read_bytes(), name

    def test_json_is_metrics_json(self, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        out = tmp_path / "run"
        assert main(["replay", str(drive), "--out", str(out), "--json", "--limits", "highway"]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed == json.loads((out / "metrics.json").read_text())
        assert printed["limits"] == {"lon_m": 1.4, "lat_m": 0.57, "yaw_deg": 1.5}

    def test_several_logs_get_a_folder_each(
        self, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        other = tmp_path / "other.mcap"
        shutil.copy(drive, other)
        assert main(["replay", str(drive), str(other), "--out", str(tmp_path / "runs"), "--json"]) == 0
        whole = json.loads(capsys.readouterr().out)
        parts = [json.loads((tmp_path / "runs" / name / "metrics.json").read_text()) for name in ("drive", "other")]
        assert whole["logs"] == {"total": 2, "done": 2, "failed": []}
        assert parts[0] == parts[1]
        assert whole["epochs"] == 2 * parts[0]["epochs"]
        fusion, once = whole["methods"]["fusion"], parts[0]["methods"]["fusion"]
        assert (fusion["ar"], fusion["lat"]["rmse"]) == (once["ar"], once["lat"]["rmse"])
        assert "different names, got 'other' twice" in refused(
            capsys, "replay", other, other, "--out", tmp_path / "twice"
        )

    def test_an_existing_folder_is_kept_unless_told(
        self, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        out = tmp_path / "run"
        out.mkdir()
        (out / "notes.txt").write_text("mine")
        assert f"{out}: exists already" in refused(capsys, "replay", drive, "--out", out)
        assert "--overwrite replaces run folders only" in refused(capsys, "replay", drive, "--out", out, "--overwrite")
        assert (out / "notes.txt").read_text() == "mine"
        (out / "notes.txt").unlink()
        assert main(["replay", str(drive), "--out", str(out), "--overwrite"]) == 0
        assert sorted(p.name for p in out.iterdir()) == LOG_FILES

    def test_an_unknown_config_key(self, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        config = tmp_path / "mine.toml"
        config.write_text("[fusion.gates]\nprobabilty = 0.99")
        error = refused(capsys, "replay", drive, "--out", tmp_path / "run", "--config", config)
        assert 'mine.toml: fusion.gates: unknown key "probabilty"; did you mean "probability"?' in error
        assert not (tmp_path / "run").exists()

    def test_mistakes(self, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        out = ("--out", tmp_path / "run")
        assert "expected one of paper, highway, local-street" in refused(capsys, "replay", drive, *out, "--limits", "x")
        assert "expected EVERY:LENGTH in seconds" in refused(capsys, "replay", drive, *out, "--hide-gnss", "60")
        assert "no.mcap" in refused(capsys, "replay", tmp_path / "no.mcap", *out)
        assert "no.toml" in refused(capsys, "replay", drive, *out, "--config", tmp_path / "no.toml")
        assert "expected at least one log" in refused(capsys, "replay", *out)
        assert list(tmp_path.iterdir()) == []

    def test_foreign_files(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for name, content in (("empty.mcap", b""), ("photo.mcap", b"\x89PNG\r\n\x1a\n" * 100)):
            path = tmp_path / name
            path.write_bytes(content)
            assert name in refused(capsys, "replay", path, "--out", tmp_path / "run")
        assert str(tmp_path) in refused(capsys, "replay", tmp_path, "--out", tmp_path / "run")

    def test_no_imu(self, log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        write_log(tmp_path / "still.mcap", replace(log, imu=None))
        assert "IMU" in refused(capsys, "replay", tmp_path / "still.mcap", "--out", tmp_path / "run")

    def test_without_reference_nothing_is_claimed(
        self, log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        write_log(tmp_path / "log.mcap", replace(log, reference=None))
        assert main(["replay", str(tmp_path / "log.mcap"), "--out", str(tmp_path / "run")]) == 0
        assert "Not evaluated: the log has no reference" in capsys.readouterr().out
        metrics = json.loads((tmp_path / "run/metrics.json").read_text())
        assert metrics["methods"]["fusion"]["ar"] is None

    def test_hidden_gnss_on_a_log_of_imu_and_gnss(
        self, log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        bare = Log(imu=log.imu, gnss=log.gnss, gnss_velocity=log.gnss_velocity, vehicle=log.vehicle)
        write_log(tmp_path / "log.mcap", bare)
        arguments = ["replay", str(tmp_path / "log.mcap"), "--out", str(tmp_path / "run"), "--hide-gnss", "20:5"]
        assert main(arguments) == 0
        text = capsys.readouterr().out
        assert "Horizontal error at the end of 2 stretches of 5 s" in text
        metrics = json.loads((tmp_path / "run/metrics.json").read_text())
        assert [s["start_s"] for s in metrics["hidden"]["per_stretch"]] == pytest.approx([20.0, 40.0], abs=0.2)
        assert 0 < metrics["hidden"]["end_horizontal_m"]["max"] < 2.0
        assert all(4.8 <= s["since_gnss_s"] <= 5.2 for s in metrics["hidden"]["per_stretch"])
        assert set(metrics["methods"]) == {"fusion"}
        decisions = pq.read_table(tmp_path / "run/decisions.parquet", columns=["t_ns", "sensor"]).to_pydict()
        start = json.loads((tmp_path / "run/manifest.json").read_text())["facts"]["start_ns"]
        gnss = [t for t, s in zip(decisions["t_ns"], decisions["sensor"], strict=True) if s.startswith("gnss")]
        assert not any(20.3 < (t - start) * 1e-9 < 24.7 for t in gnss)
        assert "leave out --reference" in refused(
            capsys, *arguments[:3], str(tmp_path / "b"), *arguments[4:], "--reference", tmp_path / "x.txt"
        )

    def test_a_reference_from_a_file(self, log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert log.reference is not None
        tum = tmp_path / "truth.tum"
        rows = zip(log.reference.t_ns, log.reference.p_map, log.reference.q_map_body, strict=True)
        tum.write_text("".join(f"{t // 10**9}.{t % 10**9:09d} {' '.join(map(str, (*p, *q)))}\n" for t, p, q in rows))
        write_log(tmp_path / "log.mcap", replace(log, reference=None))
        arguments = ["replay", str(tmp_path / "log.mcap"), "--reference", str(tum)]
        assert main([*arguments, "--out", str(tmp_path / "run"), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["reference"] == {"kind": "odometry", "source": "truth.tum", "heading": "attitude"}
        assert found["methods"]["fusion"]["ar"] > 0.95
        assert found["methods"]["fusion"]["yaw"]["mae"] < 0.2

        write_log(tmp_path / "log.mcap", Log(imu=log.imu, gnss=log.gnss))  # its map frame is anyone's guess
        error = refused(capsys, *arguments, "--out", tmp_path / "b")
        assert "a reference in map coordinates: expected a map frame" in error


class TestScore:
    def test_the_same_limits_give_the_same_bytes(self, run: Path, tmp_path: Path) -> None:
        copy = tmp_path / "run"
        shutil.copytree(run, copy)
        before = (copy / "metrics.json").read_bytes()
        assert main(["score", str(copy), "--limits", "local-street"]) == 0
        assert (copy / "metrics.json").read_bytes() != before
        assert main(["score", str(copy)]) == 0
        assert (copy / "metrics.json").read_bytes() == before

    def test_mistakes(self, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert "expected one of paper" in refused(capsys, "score", run, "--limits", "none")
        assert "expected a run folder" in refused(capsys, "score", tmp_path / "nowhere")


class TestLogs:
    def test_info(self, drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["info", str(drive)]) == 0
        text = capsys.readouterr().out
        assert "PoseWithCovarianceStamped" in text
        assert "A replay is scored against its reference." in text
        assert main(["info", str(drive), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["sensors"]["imu"]["count"] == round(DURATION_S * 100) + 1
        assert found["duration_s"] == pytest.approx(DURATION_S)
        assert {sensor for topic in found["topics"] for sensor in topic["sensors"]} >= {"imu", "gnss", "reference"}

    def test_info_says_why_a_log_cannot_be_replayed(
        self, log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        write_log(tmp_path / "log.mcap", replace(log, imu=None))
        assert main(["info", str(tmp_path / "log.mcap")]) == 0
        assert "It cannot be replayed: expected IMU samples" in capsys.readouterr().out
        assert "no.mcap" in refused(capsys, "info", tmp_path / "no.mcap")

    def test_simulate_is_seeded_and_never_overwrites_unasked(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        paths = [tmp_path / f"{name}.mcap" for name in "abc"]
        for path, seed in zip(paths, (1, 1, 2), strict=True):
            assert main(["simulate", "demo", str(path), "--duration-s", "5", "--seed", str(seed)]) == 0
        assert "imu" in capsys.readouterr().out
        assert file_hash(paths[0]) == file_hash(paths[1]) != file_hash(paths[2])
        assert "exists already" in refused(capsys, "simulate", "demo", paths[0])
        assert "expected a .toml file or one of the scenarios" in refused(
            capsys, "simulate", "moon", tmp_path / "d.mcap"
        )

    def test_simulate_goes_so_far(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        path = tmp_path / "log.mcap"
        assert main(["simulate", "clean", str(path), "--length-km", "0.2", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["sensors"]["imu"]["count"] > 1000
        assert main(["replay", str(path), "--out", str(tmp_path / "run"), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["distance_m"] == pytest.approx(200.0, abs=20.0)
        assert "--length-km: expected more than 0" in refused(
            capsys, "simulate", "clean", tmp_path / "b.mcap", "--length-km", "0"
        )

    def test_convert_mistakes(self, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert "expected one of rtklib" in refused(capsys, "convert", "csv", tmp_path, tmp_path / "x.mcap")
        assert "no such file" in refused(capsys, "convert", "rtklib", tmp_path / "none", tmp_path / "x.mcap")
        assert "exists already" in refused(capsys, "convert", "rtklib", tmp_path, drive)


def test_view_writes_a_recording_into_the_run(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    for out in (a, b):
        assert main(["replay", str(drive), "--out", str(out), "--hide-gnss", "20:5"]) == 0
    assert main(["view", str(a), "--no-open"]) == 0
    assert f"Recording: {a / 'run.rrd'}" in capsys.readouterr().out
    assert main(["view", str(a), str(b), "--no-open"]) == 0
    assert (tmp_path / "a_and_b.rrd").is_file()
    assert "expected a run folder" in refused(capsys, "view", tmp_path / "nowhere", "--no-open")
    assert main(["replay", str(drive), "--out", str(a), "--overwrite"]) == 0  # recordings do not protect a run


@pytest.mark.slow
def test_the_demo_replaces_its_own_output_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "runs" / "demo"
    for _ in range(2):
        assert main(["demo", "--out", str(out)]) == 0
    assert "Fusion" in capsys.readouterr().out
    assert json.loads((out / "metrics.json").read_text())["methods"]["fusion"]["ar"] > 0.99
    assert main(["replay", str(tmp_path / "runs/demo.mcap"), "--out", str(tmp_path / "mine")]) == 0
    assert "exists already" in refused(capsys, "demo", "--out", tmp_path / "mine")


@pytest.mark.slow
def test_the_demo_of_a_campaign_stands_beside_the_paper(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):  # the second replaces the first
        assert main(["demo", "--campaign", "--out", str(tmp_path / "run")]) == 0
    printed = capsys.readouterr().out
    assert "EgoVM paper, Table 5" in printed
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["logs"] == {"total": 10, "done": 10, "failed": []}
    assert metrics["distance_m"] == pytest.approx(200_000, rel=0.01)
    assert "expected --campaign with it" in refused(capsys, "demo", "--workers", "2")


@pytest.mark.parametrize(
    "command", [[], *([name] for name in COMMANDS), ["bench"], *(["bench", name] for name in BENCHMARKS)]
)
def test_help(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([*command, "--help"])
    assert stopped.value.code == 0
    assert "usage: egoloc" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments", [["fly"], ["replay", "a.mcap"], ["replay", "a.mcap", "--out", "x", "--limit", "y"]]
)
def test_usage_errors_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert capsys.readouterr().err


@pytest.mark.parametrize(
    "option",
    ["filter --repeats", "live --repeats", "live --hours", "replay --hours", "mcap --repeats", "gates --drives"],
)
def test_a_benchmark_of_nothing_is_refused(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, "bench", *option.split(), "0")
    assert option.split()[1] in said
    assert said.endswith(", got 0\n")


def test_an_interrupt_is_no_traceback(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sensors.simulate.scenarios.load", interrupt)
    assert main(["simulate", "demo", "never.mcap"]) == 130
    assert capsys.readouterr().err == "egoloc: interrupted\n"


def test_estimates_are_told_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """--estimate switches states on; what the drive shows stands in the notes and, scored again, in metrics.json."""
    out = tmp_path / "run"
    arguments = ["replay", "scenario:clean,duration_s=40", "--estimate", "lever-arm,delays", "--out", str(out)]
    assert main(arguments) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Estimated: wheel scale" in printed
    assert "GNSS delay" in printed
    found = {each["name"]: each for each in json.loads((out / "metrics.json").read_text())["estimates"]}
    assert {"wheel_scale", "gnss_arm_x", "gnss_arm_z", "gnss_delay", "pose_delay"} <= set(found)
    assert not {"mounting_yaw", "gyro_scale"} & set(found)
    delay = found["gnss_delay"]
    assert abs(delay["value"]) < 3.0 * delay["sigma"] < delay["prior_sigma"] == 0.05
    assert delay["excited"] is True
    assert "lever_arm = true" in (out / "config.toml").read_text()
    before = (out / "metrics.json").read_text()
    assert main(["score", str(out)]) == 0
    assert (out / "metrics.json").read_text() == before


def test_nothing_else_can_be_estimated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["replay", "scenario:clean,duration_s=40", "--estimate", "arm", "--out", str(tmp_path / "run")]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert "--estimate: expected any of lever-arm, mounting, gyro, delays, gnss-delay, pose-delay, got 'arm'" in error
