"""The run folder: whole or not at all, deterministic, and enough to score again."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from replay.config import HideGnss, RunConfig
from replay.harness import assemble
from replay.hiding import hide_gnss
from replay.scoring import score
from replay.store import Run, check_free, file_hash, load_run, new_folder, write_json, write_tables
from sensors.errors import EgolocError
from tests.replay.drives import decisions, drive

STATES = (
    "t_ns x y z roll pitch yaw ve vn vu lat_deg lon_deg height_m gyro_bias_x gyro_bias_y gyro_bias_z accel_bias_x "
    "accel_bias_y accel_bias_z pose_cov ref_x ref_y ref_z ref_yaw ref_speed ref_sigma_m ref_sigma_yaw excluded err_lon "
    "err_lat err_yaw sigma_lon sigma_lat sigma_yaw stretch"
)
DECISIONS = (
    "t_ns arrival_ns sensor row reason accepted innovation_0 innovation_1 innovation_2 innovation_sigma_0 "
    "innovation_sigma_1 innovation_sigma_2 nis threshold moved_m moved_yaw dof x y z yaw err_lon err_lat err_yaw status"
)


def made(*, hide: bool = False) -> Run:
    log, result = drive(200.0, state_error=(0.1, 0.0, 0.0), aligned_s=2.0)
    if not hide:
        return assemble(log, RunConfig(), result).run
    spec = HideGnss(60.0, 15.0)
    hidden = hide_gnss(log, spec)
    result = replace(result, decisions=decisions(hidden.log))
    return assemble(hidden.log, RunConfig(hide_gnss=spec), result, hidden).run


def save(folder: Path, run: Run) -> None:
    write_tables(folder, run)
    write_json(folder / "manifest.json", {"facts": run.facts})


@pytest.mark.parametrize("hide", [False, True])
def test_scoring_a_saved_run_gives_the_same_bytes(hide: bool, tmp_path: Path) -> None:
    run = made(hide=hide)
    save(tmp_path, run)
    again = load_run(tmp_path)
    limits = RunConfig().limits
    assert json.dumps(score(again, limits)) == json.dumps(score(run, limits))
    for table in ("states", "decisions"):
        for name, column in getattr(again, table).items():
            np.testing.assert_array_equal(column, getattr(run, table)[name])


def test_columns_and_types(tmp_path: Path) -> None:
    save(tmp_path, made())
    states, decisions = (pq.read_table(tmp_path / f"{name}.parquet") for name in ("states", "decisions"))
    assert states.column_names == STATES.split()
    assert decisions.column_names == DECISIONS.split()
    assert str(states.schema.field("pose_cov").type) == "fixed_size_list<element: double>[36]"
    assert set(decisions["sensor"].to_pylist()) == {"gnss_position", "pose_fix"}
    assert set(decisions["reason"].to_pylist()) == {"accepted"}
    assert str(states.schema.field("stretch").type) == "int32"
    assert decisions["accepted"].to_pylist() == [True] * 4000


def test_same_run_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        save(tmp_path / name, made())
    for file in ("states.parquet", "decisions.parquet", "manifest.json"):
        assert file_hash(tmp_path / "a" / file) == file_hash(tmp_path / "b" / file)


def test_a_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    def fail() -> None:
        with new_folder(tmp_path / "run") as folder:
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


def test_only_run_folders_are_overwritten(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(EgolocError, match="exists already: choose another --out or add --overwrite"):
        check_free(tmp_path)
    with pytest.raises(EgolocError, match="--overwrite replaces run folders only"):
        check_free(tmp_path, overwrite=True)
    with pytest.raises(EgolocError, match="--overwrite replaces run folders only"):
        check_free(tmp_path / "thesis.tex", overwrite=True)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda run: (run / "manifest.json").unlink(), "manifest.json: missing"),
        (lambda run: (run / "manifest.json").write_text("{"), "manifest.json: expected JSON"),
        (lambda run: (run / "manifest.json").write_text("{}"), "manifest.json: object missing required field `facts`"),
        (lambda run: (run / "states.parquet").unlink(), "states.parquet: missing"),
        (lambda run: (run / "decisions.parquet").write_bytes(b"PAR1"), "decisions.parquet: expected a Parquet file"),
    ],
)
def test_a_damaged_run_folder_is_named(damage, message: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    save(tmp_path, made())
    damage(tmp_path)
    with pytest.raises(EgolocError, match=message):
        load_run(tmp_path)


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="nowhere: expected a run folder"):
        load_run(tmp_path / "nowhere")


def test_file_hash(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(b"abc")
    assert file_hash(tmp_path / "f").startswith("ba7816bf8f01cfea414140de5dae2223")  # FIPS 180-2, B.1
