"""The run folder: whole or not at all, deterministic, and enough to score again."""

import errno
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from replay import tables as tables_module
from replay.config import LIMITS, HideGnss, RunConfig
from replay.harness import replay_source, score_run
from replay.run_columns import load_columns
from replay.store import Keep, StorageError, check_free, clear_leftovers, file_hash, new_folder
from replay.tables import Tables, stored_batches
from sensors.errors import EgolocError
from sensors.records import Log, Tags
from tests.replay.assembling import Assembled, assemble
from tests.replay.cutting import Memory, equal, joined
from tests.replay.drives import START_NS, drive

S = 1_000_000_000
STATES = (
    "t_ns x y z roll pitch yaw ve vn vu lat_deg lon_deg height_m gyro_bias_x gyro_bias_y gyro_bias_z accel_bias_x "
    "accel_bias_y accel_bias_z health health_cause "
    "gnss_position_level gnss_velocity_level gnss_yaw_level pose_fix_level "
    "wheel_level pose_cov ref_x ref_y ref_z ref_yaw ref_speed ref_sigma_m ref_sigma_yaw excluded err_lon "
    "err_lat err_yaw sigma_lon sigma_lat sigma_yaw stretch scene mode log"
)
DECISIONS = (
    "t_ns arrival_ns sensor row reason accepted innovation_0 innovation_1 innovation_2 innovation_sigma_0 "
    "innovation_sigma_1 innovation_sigma_2 nis threshold moved_m moved_yaw weight dof x y z yaw err_lon err_lat "
    "err_yaw status scene mode log"
)
RUN_FILES = [
    *("config.toml", "decisions.parquet", "manifest.json", "metrics.json"),
    *("percentiles.parquet", "segments.parquet", "states.parquet"),
]


@pytest.fixture(scope="module")
def log(short_log: Log) -> Log:
    assert short_log.imu is not None
    at = short_log.imu.t_ns[[0, 2000, 4000]]
    return replace(short_log, scene=Tags(at, at, np.array(["city", "canyon,night", "city"])), mode=None)


@pytest.fixture(scope="module")
def run(log: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, not to be changed."""
    out = tmp_path_factory.mktemp("runs") / "run"
    replay_source(Memory(log), out, RunConfig())
    return out


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


class TestFolder:
    def test_all_files_and_nothing_else(self, run: Path) -> None:
        assert sorted(p.name for p in run.iterdir()) == RUN_FILES
        assert [p.name for p in run.parent.iterdir()] == ["run"]
        manifest = json.loads((run / "manifest.json").read_text())
        assert manifest["name"] == "drive"
        assert manifest["log"] == {"path": "drive"}
        assert manifest["keep"] == {"states_hz": None, "decisions": "all"}

    def test_the_same_bytes_again_however_the_drive_is_cut(self, log: Log, run: Path, tmp_path: Path) -> None:
        for length_s in (300.0, 7.0):
            out = tmp_path / f"cut_{length_s:g}"
            replay_source(Memory(log, length_s=length_s), out, RunConfig())
            assert content(out) == content(run)

    def test_kilometres_are_told_piece_by_piece(self, log: Log, tmp_path: Path) -> None:
        told: list[float] = []
        metrics = replay_source(Memory(log, length_s=10.0), tmp_path / "run", RunConfig(), progress=told.append)
        assert len(told) == 8  # 7 pieces and the end
        assert told == sorted(told)
        assert told[-1] == pytest.approx(metrics["distance_m"] / 1000.0, rel=0.05)

    @pytest.mark.parametrize(
        ("error", "said"),
        [
            (EgolocError("drive: chunk 7 is damaged"), "drive: chunk 7 is damaged"),
            (OSError(errno.EIO, os.strerror(errno.EIO)), "drive: cannot be read: Input/output error"),
        ],
    )
    def test_a_drive_that_ends_badly_leaves_nothing(
        self, error: Exception, said: str, log: Log, tmp_path: Path
    ) -> None:
        @dataclass(frozen=True)
        class Torn(Memory):
            def pieces(self, config: RunConfig) -> Iterator[Log]:
                for number, piece in enumerate(super().pieces(config)):
                    if number == 3:
                        raise error
                    yield piece

        with pytest.raises(EgolocError, match=said) as caught:
            replay_source(Torn(log, length_s=5.0), tmp_path / "deep" / "run", RunConfig())
        assert not isinstance(caught.value, StorageError)
        assert list(tmp_path.iterdir()) == []

    def test_what_shows_only_at_the_end_leaves_nothing(self, log: Log, tmp_path: Path) -> None:
        for changed, said in (
            (replace(log, imu=None), "drive: expected IMU samples .* found none"),
            (replace(log, gnss=None, pose_fixes=None), "drive: expected GNSS fixes or pose fixes, found neither"),
            (Log(), "drive: expected IMU samples .* found none"),
        ):
            with pytest.raises(EgolocError, match=said):
                replay_source(Memory(changed, length_s=5.0), tmp_path / "run", RunConfig())
        with pytest.raises(EgolocError, match="drive: --hide-gnss: expected at least 75 s of GNSS and IMU"):
            replay_source(Memory(log), tmp_path / "run", RunConfig(hide_gnss=HideGnss(60.0, 15.0)))
        assert list(tmp_path.iterdir()) == []

    def test_a_full_disk_is_told_from_a_bad_log(
        self, log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def full(*_: object) -> None:
            raise OSError(errno.ENOSPC, "wrapped by Arrow")

        monkeypatch.setattr(tables_module.Table, "_write_group", full)
        with pytest.raises(StorageError, match="run: cannot be written: No space left on device"):
            replay_source(Memory(log), tmp_path / "run", RunConfig())
        assert list(tmp_path.iterdir()) == []

    def test_a_log_that_holds_no_frame_takes_that_of_its_first_fix(self, log: Log, tmp_path: Path) -> None:
        assert log.gnss is not None
        late = log.gnss[log.gnss.t_ns > log.gnss.t_ns[0] + 12 * S]
        bare = replace(log, gnss=late, pose_fixes=None, reference=None, map_frame=None)
        metrics = replay_source(Memory(bare, length_s=5.0), tmp_path / "run", RunConfig())
        assert metrics["decisions"]["gnss_position"]["accepted"] > 300
        assert "zone = 32" in (tmp_path / "run" / "config.toml").read_text()
        with pytest.raises(EgolocError, match="drive: a reference in map coordinates: expected a map frame"):
            replay_source(Memory(replace(bare, reference=log.reference)), tmp_path / "again", RunConfig())


class TestTables:
    def test_columns_and_types(self, run: Path, log: Log) -> None:
        states, decisions = (pq.read_table(run / f"{name}.parquet") for name in ("states", "decisions"))
        assert states.column_names == STATES.split()
        assert decisions.column_names == DECISIONS.split()
        assert str(states.schema.field("pose_cov").type) == "fixed_size_list<element: double>[36]"
        assert str(states.schema.field("stretch").type) == "int32"
        assert {"gnss_position", "pose_fix", "wheel"} < set(decisions["sensor"].to_pylist())
        assert set(states["scene"].to_pylist()) == {"city", "canyon,night"}
        assert set(states["mode"].to_pylist()) == {""}
        assert set(states["health"].to_pylist()) == {"initializing", "healthy"}
        assert set(states["health_cause"].to_pylist()) == {"none"}
        assert set(states["gnss_yaw_level"].to_pylist()) == {"absent"}
        assert {"absent", "good"} == set(states["pose_fix_level"].to_pylist())
        assert set(decisions["log"].to_pylist()) == {"drive"}

    def test_tables_of_several_logs_are_one_dataset(self, log: Log, tmp_path: Path) -> None:
        assert log.scene is not None
        other = replace(log, scene=replace(log.scene, text=np.array(["tunnel"] * 3)))
        for name, given in (("a", log), ("b", other)):
            replay_source(Memory(given, name=name), tmp_path / name, RunConfig())
        for table in ("states", "decisions"):
            files = [str(tmp_path / name / f"{table}.parquet") for name in ("a", "b")]
            rows = pyarrow.dataset.dataset(files).to_table(columns=["log", "scene"]).unify_dictionaries()
            scenes = rows.group_by("log").aggregate([("scene", "distinct")])
            found = {row["log"]: set(row["scene_distinct"]) for row in scenes.to_pylist()}
            assert found == {"a": {"city", "canyon,night"}, "b": {"tunnel"}}

    def test_rows_come_back_as_they_were_written(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        made = made_up(RunConfig())
        monkeypatch.setattr(tables_module, "ROWS", 700)
        with Tables(tmp_path, "drive", Keep()) as tables:
            for batch in made.batches:
                tables.add(batch)
        assert pq.ParquetFile(tmp_path / "states.parquet").num_row_groups == 3
        again = joined(list(stored_batches(tmp_path)))
        for found, wanted in zip(again, (made.states, made.decisions), strict=True):
            assert equal(found, {name: wanted[name].astype(column.dtype) for name, column in found.items()}) == []

    @pytest.mark.parametrize(
        ("keep", "states_hz", "kept"),
        [
            (Keep(states_hz=1.0), 1.0, None),
            (Keep(states_hz=0.0, decisions="none"), 0.0, ()),
            (Keep(decisions="rejected"), None, (False,)),
        ],
    )
    def test_thinned_tables(
        self, keep: Keep, states_hz: float | None, kept: tuple[bool, ...] | None, log: Log, run: Path, tmp_path: Path
    ) -> None:
        out = tmp_path / "run"
        replay_source(Memory(log), out, RunConfig(), keep=keep)
        for name in ("metrics.json", "segments.parquet", "percentiles.parquet", "config.toml"):
            assert (out / name).read_bytes() == (run / name).read_bytes(), "everything is scored first"
        whole, states = (pq.read_table(folder / "states.parquet") for folder in (run, out))
        wanted = [
            t for t in whole["t_ns"].to_pylist() if states_hz is None or (states_hz and t % round(S / states_hz) == 0)
        ]
        assert states["t_ns"].to_pylist() == wanted
        assert states.schema == whole.schema
        whole, decisions = (pq.read_table(folder / "decisions.parquet") for folder in (run, out))
        accepted = [a for a in whole["accepted"].to_pylist() if kept is None or a in kept]
        assert decisions["accepted"].to_pylist() == accepted
        assert decisions.schema == whole.schema
        manifest = json.loads((out / "manifest.json").read_text())
        assert manifest["keep"] == {"states_hz": keep.states_hz, "decisions": keep.decisions}
        with pytest.raises(EgolocError, match="cannot be scored again, its tables were thinned"):
            score_run(out, LIMITS["paper"])

    def test_a_viewer_reads_them(self, run: Path) -> None:
        columns = load_columns(run)
        assert len(columns.states["t_ns"]) == 601
        assert set(columns.sensors) >= {"gnss_position", "pose_fix", "wheel"}


class TestScoringAgain:
    def test_the_same_limits_give_the_same_bytes(self, run: Path, log: Log, tmp_path: Path) -> None:
        out = tmp_path / "renamed"
        replay_source(Memory(log), out, RunConfig())
        score_run(out, LIMITS["highway"])
        assert json.loads((out / "metrics.json").read_text())["limits"]["lon_m"] == 1.4
        score_run(out, LIMITS["paper"])
        assert content(out) == content(run)

    @pytest.mark.parametrize("hide", [False, True])
    def test_row_groups_change_no_digit(self, hide: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        config = RunConfig(hide_gnss=HideGnss(60.0, 15.0) if hide else None)
        made = made_up(config)
        monkeypatch.setattr(tables_module, "ROWS", 500)
        with Tables(tmp_path, "drive", Keep()) as tables:
            for batch in made.batches:
                tables.add(batch)
        (tmp_path / "manifest.json").write_text(json.dumps({"facts": made.facts, "name": "drive"}))
        assert score_run(tmp_path, config.limits) == made.metrics

    @pytest.mark.parametrize(
        ("damage", "message"),
        [
            (lambda run: (run / "manifest.json").unlink(), "manifest.json: missing"),
            (lambda run: (run / "manifest.json").write_text("{"), "manifest.json: expected JSON"),
            (
                lambda run: (run / "manifest.json").write_text("{}"),
                "manifest.json: object missing required field `facts`",
            ),
            (lambda run: (run / "states.parquet").unlink(), "states.parquet: missing"),
            (
                lambda run: (run / "decisions.parquet").write_bytes(b"PAR1"),
                "decisions.parquet: expected a Parquet file",
            ),
        ],
    )
    def test_a_damaged_run_folder_is_named(self, damage: Any, message: str, run: Path, tmp_path: Path) -> None:
        for name, data in content(run).items():
            (tmp_path / name).write_bytes(data)
        damage(tmp_path)
        with pytest.raises(EgolocError, match=message):
            score_run(tmp_path, LIMITS["paper"])

    def test_no_folder(self, tmp_path: Path) -> None:
        with pytest.raises(EgolocError, match="nowhere: expected a run folder"):
            score_run(tmp_path / "nowhere", LIMITS["paper"])


def made_up(config: RunConfig) -> Assembled:
    """A result whose errors are known, in a city and then in a tunnel."""
    log, result = drive(200.0, state_error=(0.1, 0.0, 0.0), aligned_s=2.0)
    at = START_NS + np.array([30, 90]) * S
    return assemble(replace(log, scene=Tags(at, at, np.array(["city", "tunnel"]))), config, result)


def test_a_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    def fail() -> None:
        with new_folder(tmp_path / "deep" / "run") as folder:
            (folder / "metrics.json").write_text("{}")
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_a_failure_keeps_the_run_that_was_there(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with new_folder(out) as folder:
        (folder / "metrics.json").write_text("old")
    with pytest.raises(RuntimeError), new_folder(out, overwrite=True):
        raise RuntimeError
    assert (out / "metrics.json").read_text() == "old"
    with new_folder(out, overwrite=True) as folder:
        (folder / "metrics.json").write_text("new")
    assert (out / "metrics.json").read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_only_what_a_dead_process_left_of_a_run_is_cleared(tmp_path: Path) -> None:
    for name in (".run.12.tmp", ".run.13.old", ".run.b.12.tmp", ".run.tmp", "run", "run.12.tmp"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "states.parquet").write_bytes(b"PAR1")
    clear_leftovers(tmp_path / "run")
    assert sorted(p.name for p in tmp_path.iterdir()) == [".run.b.12.tmp", ".run.tmp", "run", "run.12.tmp"]


def test_only_run_folders_are_overwritten(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(EgolocError, match="exists already: choose another --out or add --overwrite"):
        check_free(tmp_path)
    with pytest.raises(EgolocError, match="--overwrite replaces run folders only"):
        check_free(tmp_path, overwrite=True)
    with pytest.raises(EgolocError, match="--overwrite replaces run folders only"):
        check_free(tmp_path / "thesis.tex", overwrite=True)


def test_file_hash(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(b"abc")
    assert file_hash(tmp_path / "f").startswith("ba7816bf8f01cfea414140de5dae2223")  # FIPS 180-2, B.1
