"""Bad configs, output folders and run folders through the command line: one clear line, and nothing half-written."""

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from replay.cli import main
from replay.store import file_hash
from sensors.mcap.io import write_log
from sensors.records import Log
from tests.replay.spoiling import SECOND, both, logged, moved, write


@pytest.fixture(scope="module")
def log(short_log: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "drive.mcap"
    write_log(path, short_log)
    return path


@pytest.fixture(scope="module")
def run(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, not to be changed."""
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(["replay", str(log), "--out", str(out)]) == 0
    return out


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """A function that runs a command that must fail, and gives its one line."""

    def run_it(*arguments: object) -> str:
        assert main([str(a) for a in arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith("egoloc: error: ")
        assert error.count("\n") == 1
        return error

    return run_it


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[fusion.gates]\nprobabilty = 0.9", 'fusion.gates: unknown key "probabilty"; did you mean "probability"?'),
        ("[fusion.gates]\nprobability = 2", "fusion.gates.probability: expected `float` < 1.0, got 2"),
        ("[fusion]\noutput_hz = 0", "fusion.output_hz: expected `float` >= 0.1, got 0"),
        ("[fusion]\noutput_hz = -1", "fusion.output_hz: expected `float` >= 0.1, got -1"),
        ("[fusion]\noutput_hz = 1e9", "fusion.output_hz: expected `float` <= 1000.0, got 1000000000.0"),
        ("[fusion]\noutput_hz = nan", "fusion.output_hz: expected `float` >= 0.1, got nan"),
        ('[fusion]\noutput_hz = "fast"', "fusion.output_hz: expected `float`, got `str`"),
        ("[fusion.motion]\nlateral_sigma = -1", "fusion.motion.lateral_sigma: expected `float` > 0.0, got -1"),
        ("[fusion.pose]\nmax_sigma_yaw_deg = 0", "fusion.pose.max_sigma_yaw_deg: expected `float` > 0.0, got 0"),
        ("[fusion.imu]\nmax_gap_s = inf", "fusion.imu.max_gap_s: expected `float` <= 1000000000.0, got inf"),
        ("[fusion.gnss]\nmin_status = 9", "fusion.gnss.min_status: expected `int` <= 4, got 9"),
        ("[vehicle]\ngnss_lever_arm = [nan, 0, 0]", "vehicle.gnss_lever_arm[0]: expected `float` >= -1000.0, got nan"),
        ("[vehicle]\ngnss_delay_s = 1e6", "vehicle.gnss_delay_s: expected `float` <= 60.0, got 1000000.0"),
        ("[vehicle.imu]\nbias_time_constant_s = 0", "vehicle.imu.bias_time_constant_s: expected `float` > 0.0, got 0"),
        ("[limits]\nlon_m = inf", "limits.lon_m: expected `float` <= 1000000000.0, got inf"),
        ('[map_frame]\nkind = "utm"\nzone = 32\norigin = [nan, 0, 0]', "map_frame: map frame: origin: expected finite"),
        ("[topics]\nradar = '/x'", "topics.radar: no such sensor, expected one of imu, gnss,"),
        ("[hide_gnss]\nevery_s = 1e-9\nlength_s = 1e-10", "hide_gnss: expected a LENGTH of at least 0.1 s, got 1e-10"),
        ('vehicle = "a\\u0000b"', "expected TOML: embedded null byte"),
    ],
)
def test_configs(text: str, message: str, log: Path, tmp_path: Path, refused: Any) -> None:
    config = tmp_path / "mine.toml"
    config.write_text(text)
    error = refused("replay", log, "--out", tmp_path / "run", "--config", config)
    assert message in error
    assert str(tmp_path) in error, "the file is named"
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("text", ["60", "60:0", "10:15", "a:b", "5:-1", "nan:nan", "inf:1", "1e-5:1e-6", "20:5:3", ""])
def test_hidden_stretches(text: str, log: Path, tmp_path: Path, refused: Any) -> None:
    assert "--hide-gnss: expected " in refused("replay", log, "--out", tmp_path / "run", f"--hide-gnss={text}")
    assert list(tmp_path.iterdir()) == []


class TestOutputs:
    def test_what_is_there_already(self, log: Path, run: Path, tmp_path: Path, refused: Any) -> None:
        before = file_hash(log)
        (tmp_path / "file").write_text("mine")
        (tmp_path / "link").symlink_to(run)
        for out in (tmp_path / "file", tmp_path / "link", run, log, "."):
            assert "exists already" in refused("replay", log, "--out", out)
        for out in (tmp_path / "file", tmp_path / "link", log):
            assert "replaces run folders only" in refused("replay", log, "--out", out, "--overwrite")
        assert f"{tmp_path / 'file'} is a file" in refused("replay", log, "--out", tmp_path / "file" / "run")
        assert file_hash(log) == before
        assert (tmp_path / "file").read_text() == "mine"
        assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "link"]

    def test_several_logs(self, log: Path, run: Path, tmp_path: Path, refused: Any) -> None:
        other = tmp_path / "other" / "drive.mcap"
        other.parent.mkdir()
        shutil.copy(log, other)
        assert "different names, got 'drive' twice" in refused("replay", log, other, "--out", tmp_path / "runs")
        assert "is a run folder" in refused("replay", log, other.rename(tmp_path / "b.mcap"), "--out", run)
        assert sorted(p.name for p in tmp_path.iterdir()) == ["b.mcap", "other"]

    @pytest.fixture
    def mounted(self, tmp_path: Path) -> Iterator[Callable[[str], Path]]:
        """A function that mounts a small file system with options."""
        folders = []

        def mount(options: str) -> Path:
            folder = tmp_path / "disk"
            folder.mkdir()
            command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
            try:
                subprocess.run(command, check=True, capture_output=True)
            except (OSError, subprocess.CalledProcessError):
                pytest.skip("this user cannot mount a small disk")
            folders.append(folder)
            return folder

        yield mount
        for folder in folders:
            subprocess.run(["umount", str(folder)], check=True)

    def test_a_full_disk(self, log: Path, mounted: Any, refused: Any) -> None:
        disk = mounted("size=300k")
        full = "cannot be written: No space left on device"
        assert f"{disk / 'run'}: {full}" in refused("replay", log, "--out", disk / "run")
        assert f"{disk / 'a.mcap'}: {full}" in refused("simulate", "demo", disk / "a.mcap", "--duration-s", 20)
        assert list(disk.iterdir()) == []

    def test_a_read_only_disk(self, log: Path, run: Path, mounted: Any, refused: Any) -> None:
        disk = mounted("ro")
        assert f"no permission to write in {disk}" in refused("replay", log, "--out", disk / "deep" / "run")
        assert f"{disk / 'a.mcap'}: cannot" in refused("simulate", "demo", disk / "a.mcap", "--duration-s", 5)
        assert f"{disk / 'a.rrd'}: cannot" in refused("view", run, "--no-open", "--rrd", disk / "a.rrd")

    def test_a_recording_never_replaces_a_log(self, log: Path, run: Path, tmp_path: Path, refused: Any) -> None:
        before = file_hash(log)
        assert "expected a file name that ends in .rrd" in refused("view", run, "--no-open", "--rrd", log)
        assert "source itself" in refused("convert", "rosbag", log, log, "--overwrite")
        assert file_hash(log) == before


def edited(name: str, change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """Change a JSON file of a run."""

    def damage(run: Path) -> None:
        content = json.loads((run / name).read_text())
        change(content)
        (run / name).write_text(json.dumps(content))

    return damage


def column(name: str, table: str, values: Callable[[pa.Table], pa.Array | None]) -> Callable[[Path], None]:
    """Replace a column of a table of a run (None: without it)."""

    def damage(run: Path) -> None:
        path = run / f"{table}.parquet"
        content = pq.read_table(path)
        new, at = values(content), content.column_names.index(name)
        pq.write_table(content.remove_column(at) if new is None else content.set_column(at, name, new), path)

    return damage


def flipped(run: Path) -> None:
    data = bytearray((run / "states.parquet").read_bytes())
    data[1000] ^= 1
    (run / "states.parquet").write_bytes(data)


@pytest.mark.parametrize(
    ("command", "damage", "message"),
    [
        ("score", lambda run: (run / "manifest.json").unlink(), "manifest.json: missing: expected a run folder"),
        ("score", lambda run: (run / "manifest.json").write_bytes(b"\xff"), "manifest.json: expected JSON"),
        ("score", edited("manifest.json", lambda c: c.update(facts={})), "manifest.json: facts: object missing"),
        ("score", edited("manifest.json", lambda c: c["facts"].update(period_ns=0)), "facts.period_ns: expected `int`"),
        ("score", lambda run: (run / "config.toml").write_text("[limits"), "config.toml: expected TOML"),
        ("score", lambda run: (run / "states.parquet").write_bytes(b"PAR1"), "states.parquet: expected a Parquet file"),
        ("score", flipped, "states.parquet: expected a Parquet file: could not verify page integrity"),
        ("view", flipped, "states.parquet: expected a Parquet file: could not verify page integrity"),
        (
            "score",
            column("t_ns", "states", lambda t: None),
            "expected the columns of a run, without: t_ns",
        ),
        (
            "score",
            column("t_ns", "states", lambda t: pa.nulls(len(t), pa.int64())),
            "column t_ns: expected stamps",
        ),
        (
            "score",
            column("err_lon", "decisions", lambda t: pa.array(["x"] * len(t))),
            "err_lon: expected numbers",
        ),
        (
            "view",
            column("err_lon", "decisions", lambda t: pa.array(["x"] * len(t))),
            "err_lon: expected numbers",
        ),
        ("score", column("sensor", "decisions", lambda t: pa.array(["radar"] * len(t))), "unknown name 'radar'"),
        ("view", column("reason", "decisions", lambda t: pa.array(["?"] * len(t))), "column reason: unknown name '?'"),
        ("view", lambda run: (run / "metrics.json").write_text("[]"), "metrics.json: expected an object, got list"),
        ("view", edited("metrics.json", lambda c: c.update(methods=3)), "metrics.json: methods: expected `object`"),
        (
            "view",
            edited("metrics.json", lambda c: c["limits"].update(lon_m="x")),
            "metrics.json: limits[...]: exp",
        ),
        ("view", edited("manifest.json", lambda c: c.update(log="x")), "manifest.json: log: expected `object`"),
    ],
)
def test_damaged_runs(command: str, damage: Any, message: str, run: Path, tmp_path: Path, refused: Any) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    damage(copy)
    before = {p.name: file_hash(p) for p in copy.iterdir()}
    assert message in refused(command, copy, *(["--no-open"] if command == "view" else []))
    assert {p.name: file_hash(p) for p in copy.iterdir()} == before


def test_what_is_no_run(log: Path, run: Path, tmp_path: Path, refused: Any) -> None:
    for folder in (tmp_path / "nowhere", log, tmp_path):
        assert "expected a run folder" in refused("score", folder)
        assert "expected a run folder" in refused("view", folder, "--no-open")
    assert "expected a run folder" in refused("view", run, tmp_path, "--no-open")
    assert list(tmp_path.iterdir()) == []


def test_two_runs_of_different_days(short_log: Log, run: Path, tmp_path: Path, refused: Any) -> None:
    day = 86_400 * SECOND
    write(tmp_path / "late.mcap", short_log, {"*": both(moved(day), logged(lambda t: t + day))})
    assert main(["replay", str(tmp_path / "late.mcap"), "--out", str(tmp_path / "late")]) == 0
    assert "they do not overlap" in refused("view", run, tmp_path / "late", "--no-open")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["late", "late.mcap"]
    assert not list(run.parent.glob("*.rrd"))
