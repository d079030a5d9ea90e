"""Recordings of run folders: what is in them, how much, and what is said of folders that are none."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rerun as rr

from replay.blueprint import grid_spacing
from replay.run_columns import gaps, load_columns, spans, strips, thin
from replay.viewer import open_viewer, write_recording
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError

MakeRun = Callable[..., Path]
FILES = ("states.parquet", "decisions.parquet", "metrics.json", "manifest.json", "config.toml")
ONE_RUN = {
    "/summary",
    "/health",
    "/gnss_status",
    "/update/gnss_position",
    "/update/pose_fix",
    "/update/non_holonomic",
    "/threshold/lon/upper",
    "/threshold/lat/lower",
    "/threshold/gate",
    *(f"/run/{view}/track/{name}" for view in ("far", "near") for name in ("reference", "GNSS", "EgoVM", "fused")),
    *(f"/run/{view}/vehicle" for view in ("far", "near")),
    *(f"/run/error/{axis}/{name}" for axis in ("lon", "lat") for name in ("solution", "sigma", "GNSS", "EgoVM")),
    *(f"/run/error/yaw/{name}" for name in ("solution", "sigma", "EgoVM")),
    *(f"/run/bias/{kind}/{axis}" for kind in ("gyro", "accel") for axis in "xyz"),
    "/run/gate_ratio/gnss_position",
    "/run/nis/pose_fix/accepted",
    "/run/nis/pose_fix/rejected",
    "/run/nis/pose_fix/threshold",
    "/run/innovation/pose_fix/2/sigma",
    "/run/motion/speed/solution",
}


def chunks(rrd: Path, path: str) -> list[pa.RecordBatch]:
    """The chunks of one entity, as record batches."""
    found = rr.chunk.RrdReader(rrd).stream().to_chunks()
    return [chunk.to_record_batch() for chunk in found if str(chunk.entity_path) == path]


def entities(rrd: Path) -> set[str]:
    """Entity paths of a recording."""
    return {str(chunk.entity_path) for chunk in rr.chunk.RrdReader(rrd).stream().to_chunks()}


def column(rrd: Path, path: str, ending: str) -> list[object]:
    """All values of the columns of an entity whose name ends so, lists opened."""
    values: list[object] = []
    for batch in chunks(rrd, path):
        for name in batch.schema.names:
            if name.endswith(ending):
                values += [item for row in batch.column(name).to_pylist() for item in (row or [])]
    return values


def stamps(rrd: Path, path: str, timeline: str = "utc") -> list[int]:
    """Index values of an entity, ns."""
    batches = [batch for batch in chunks(rrd, path) if timeline in batch.schema.names]
    return [int(t) for batch in batches for t in batch.column(timeline).cast(pa.int64()).to_pylist()]


def test_a_recording_holds_every_part_of_a_run(make_run: MakeRun) -> None:
    run = make_run()
    rrd = write_recording(run)
    assert rrd == run / "run.rrd"
    assert ONE_RUN - entities(rrd) == set()
    assert sorted(p.name for p in run.iterdir() if p.suffix == ".part" or p.name.startswith(".")) == []


def test_what_is_drawn_is_what_the_tables_say(make_run: MakeRun) -> None:
    run = make_run(duration_s=15.0)
    rrd = write_recording(run)
    table = pq.read_table(run / "states.parquet")
    error = np.degrees(table["err_yaw"].to_numpy())
    assert np.allclose(column(rrd, "/run/error/yaw/solution", "Scalars:scalars"), error, rtol=1e-12)
    assert stamps(rrd, "/run/error/yaw/solution") == table["t_ns"].to_pylist()
    elapsed = stamps(rrd, "/run/error/yaw/solution", "drive")
    assert elapsed[0] == 0
    assert elapsed[-1] == table["t_ns"][-1].as_py() - table["t_ns"][0].as_py()
    variances = column(rrd, "/run/error/lat/sigma_3", "Measurements:variances")
    assert np.allclose(variances, (3 * table["sigma_lat"].to_numpy()) ** 2)


def test_a_smoothed_run_has_a_track_and_errors_more(make_run: MakeRun) -> None:
    run = make_run()
    plain = entities(write_recording(run))
    table = pq.read_table(run / "states.parquet")
    pq.write_table(table.slice(100), run / "smoothed.parquet")
    rrd = write_recording(run)
    errors = {f"/run/error/{axis}/smoothed" for axis in ("lon", "lat", "yaw")}
    assert entities(rrd) - plain == errors | {"/run/far/track/smoothed", "/run/near/track/smoothed"}
    drawn = column(rrd, "/run/error/lat/smoothed", "Scalars:scalars")
    error, shown = table["err_lat"].to_numpy()[100:], np.array(drawn, np.float64)
    assert np.allclose(shown[np.isfinite(shown)], error[np.isfinite(error)], rtol=1e-12)


def test_the_map_is_centred_before_it_loses_precision(make_run: MakeRun) -> None:
    run = make_run(duration_s=15.0)
    table = pq.read_table(run / "states.parquet")
    far = table.set_column(table.column_names.index("y"), "y", pa.array(table["y"].to_numpy() + 5_000_000.123))
    pq.write_table(far, run / "states.parquet")
    decisions = pq.read_table(run / "decisions.parquet")
    moved = decisions.set_column(
        decisions.column_names.index("y"), "y", pa.array(decisions["y"].to_numpy() + 5_000_000.123)
    )
    pq.write_table(moved, run / "decisions.parquet")
    places = np.array(column(write_recording(run), "/run/near/vehicle", "Points3D:positions"))
    truth = far["y"].to_numpy()
    assert np.abs(np.diff(places[:, 1]) - np.diff(truth)).max() < 1e-4


def test_rows_are_thinned_to_20_hz(make_run: MakeRun) -> None:
    rrd = write_recording(make_run(hz=100.0, duration_s=15.0))
    assert len(stamps(rrd, "/run/error/lat/solution")) == 300
    assert len(stamps(rrd, "/run/near/vehicle")) == 300


def test_no_line_crosses_a_pause(make_run: MakeRun) -> None:
    rrd = write_recording(make_run())
    values = np.array(column(rrd, "/run/error/lon/solution", "Scalars:scalars"))
    t = np.array(stamps(rrd, "/run/error/lon/solution"))
    assert np.isnan(values).sum() == 1  # the reference is missing once
    where = int(np.flatnonzero(np.isnan(values))[0])
    assert t[where + 1] - t[where] > 4 * NS_PER_S
    assert len(column(rrd, "/run/far/track/GNSS", "LineStrips3D:strips")) == 2  # GNSS is lost once


def test_lanes_change_where_the_run_changes(make_run: MakeRun) -> None:
    rrd = write_recording(make_run())
    assert column(rrd, "/health", "StateChange:state") == ["healthy", "dead reckoning", "recovered", "-"]
    t = np.array(stamps(rrd, "/health"))
    assert np.allclose((t - t[0]) * 1e-9, [0.0, 30.0, 45.0, 60.0])
    assert column(rrd, "/gnss_status", "StateChange:state") == ["RTK float", "RTK fixed", "-", "RTK fixed", "-"]
    assert column(rrd, "/update/gnss_position", "StateChange:state") == ["status", "accepted", "-", "accepted", "-"]
    states = column(rrd, "/update/pose_fix", "StateChange:state")
    assert states == ["accepted", "chi_square", "accepted", "-"]
    t = np.array(stamps(rrd, "/update/pose_fix"))
    assert np.allclose((t - t[0]) * 1e-9, [0.0, 45.0, 45.2, 60.0])


def test_what_the_gates_left_out_is_apart(make_run: MakeRun) -> None:
    rrd = write_recording(make_run())
    assert column(rrd, "/run/nis/pose_fix/rejected", "Scalars:scalars") == [80.0, 80.0]
    assert len(stamps(rrd, "/run/nis/pose_fix/accepted")) == 598
    assert column(rrd, "/run/nis/pose_fix/threshold", "Scalars:scalars") == [21.1, 21.1]


def test_limits_are_lines_over_the_whole_drive(make_run: MakeRun) -> None:
    rrd = write_recording(make_run())
    assert column(rrd, "/threshold/lat/lower", "Scalars:scalars") == [-0.3, -0.3]
    drive = stamps(rrd, "/threshold/lat/lower", "drive")
    assert drive[0] == 0
    assert drive[1] == max(stamps(rrd, "/run/error/lat/solution", "drive"))


def test_two_runs_lie_on_one_timeline(make_run: MakeRun) -> None:
    a, b = make_run("first"), make_run("second", seed=2, inflation=9.0)
    rrd = write_recording(a, other=b)
    assert rrd.name == "first_and_second.rrd"
    assert rrd.parent == a.parent
    found = entities(rrd)
    assert {f"/{run}/error/lat/solution" for run in "AB"} < found
    assert {f"/update/pose_fix/{run}" for run in "AB"} < found
    colours = [column(rrd, f"/{run}/error/lat/solution", "SeriesLines:colors") for run in "AB"]
    assert colours[0] != colours[1]
    assert stamps(rrd, "/A/error/lat/solution") == stamps(rrd, "/B/error/lat/solution")
    (text,) = column(rrd, "/summary", "TextDocument:text")
    assert "| fusion.gnss.inflation | 4.0 | 9.0 |" in str(text)
    assert "limits.lon_m" not in str(text)


def test_the_sensors_of_one_log_are_drawn_once(make_run: MakeRun) -> None:
    a, b = make_run("first"), make_run("second")
    for run in (a, b):
        (run / "manifest.json").write_text(json.dumps({"log": {"sha256": "ab"}}))
    found = entities(write_recording(a, other=b))
    assert "/A/error/lat/GNSS" in found
    assert "/B/error/lat/GNSS" not in found
    assert "/B/nis/gnss_position/accepted" in found


def test_the_summary_shows_the_scores(make_run: MakeRun) -> None:
    (text,) = column(write_recording(make_run()), "/summary", "TextDocument:text")
    assert "| run | fusion | 99.50 % | 0.030 m | 0.030 m | 0.060 deg |" in str(text)
    assert "| run | GNSS | 75.00 % | 0.050 m | 0.040 m | - |" in str(text)
    assert "lon 0.6 m, lat 0.3 m, yaw 1 deg" in str(text)


def test_run_facts_are_properties(make_run: MakeRun) -> None:
    rrd = write_recording(make_run())
    assert column(rrd, "/__properties/run", "config_sha256") == [f"{1:064x}"]


def test_a_run_without_reference_is_drawn(make_run: MakeRun) -> None:
    run = make_run(duration_s=10.0)
    table = pq.read_table(run / "states.parquet")
    for name in table.column_names:
        if name.startswith(("ref_", "err_", "sigma_")):
            table = table.set_column(table.column_names.index(name), name, pa.array(np.full(len(table), np.nan)))
    pq.write_table(table, run / "states.parquet")
    (run / "metrics.json").write_text(json.dumps({"limits": {}, "methods": {}}))
    rrd = write_recording(run)
    assert "/run/error/lat/solution" in entities(rrd)  # its style
    assert stamps(rrd, "/run/error/lat/solution") == []
    assert len(stamps(rrd, "/run/far/vehicle")) == 100
    assert "nothing is scored" in str(column(rrd, "/summary", "TextDocument:text"))


def test_a_run_that_never_aligned_is_drawn(make_run: MakeRun) -> None:
    run = make_run(duration_s=10.0)
    pq.write_table(pq.read_table(run / "states.parquet").slice(0, 0), run / "states.parquet")
    rrd = write_recording(run)
    assert column(rrd, "/gnss_status", "StateChange:state") == ["RTK float", "-"]


@pytest.mark.parametrize(
    "name", ["states.parquet", "decisions.parquet", "metrics.json", "manifest.json", "config.toml"]
)
def test_a_missing_file_is_named(make_run: MakeRun, name: str) -> None:
    run = make_run(duration_s=2.0)
    (run / name).unlink()
    with pytest.raises(EgolocError, match=f"{name}: missing"):
        write_recording(run)
    assert not (run / "run.rrd").exists()


@pytest.mark.parametrize(
    "name", ["states.parquet", "decisions.parquet", "metrics.json", "manifest.json", "config.toml"]
)
def test_a_foreign_file_is_named(make_run: MakeRun, name: str) -> None:
    run = make_run(duration_s=2.0)
    (run / name).write_bytes(b"\xff\x00 not it")
    with pytest.raises(EgolocError, match=f"{name}: expected") as caught:
        write_recording(run)
    assert "\n" not in str(caught.value)


def test_a_missing_column_is_named(make_run: MakeRun) -> None:
    run = make_run(duration_s=2.0)
    pq.write_table(pq.read_table(run / "states.parquet").drop_columns(["sigma_lat"]), run / "states.parquet")
    with pytest.raises(EgolocError, match=r"states\.parquet: .*without: sigma_lat"):
        write_recording(run)


def test_what_is_no_folder_is_said(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="expected a run folder"):
        write_recording(tmp_path / "nowhere")


def test_an_empty_run_is_said(make_run: MakeRun) -> None:
    run = make_run(duration_s=2.0)
    for name in ("states.parquet", "decisions.parquet"):
        pq.write_table(pq.read_table(run / name).slice(0, 0), run / name)
    with pytest.raises(EgolocError, match="both tables are empty"):
        write_recording(run)


def test_runs_of_different_times_are_refused(make_run: MakeRun) -> None:
    a, b = make_run("a", duration_s=2.0), make_run("b", duration_s=2.0)
    for name in ("states.parquet", "decisions.parquet"):
        table = pq.read_table(b / name)
        later = pa.array(table["t_ns"].to_numpy() + 3600 * NS_PER_S)
        pq.write_table(table.set_column(table.column_names.index("t_ns"), "t_ns", later), b / name)
    with pytest.raises(EgolocError, match="do not overlap"):
        write_recording(a, other=b)


def test_a_target_that_cannot_be_written_is_named(make_run: MakeRun, tmp_path: Path) -> None:
    target = tmp_path / "missing" / "run.rrd"
    with pytest.raises(EgolocError, match=r"run\.rrd: cannot be written"):
        write_recording(make_run(duration_s=2.0), target)


def test_without_a_display_nothing_is_opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert not open_viewer(tmp_path / "run.rrd")


def test_thinning_keeps_changes() -> None:
    t = np.arange(10) * 10_000_000  # 100 Hz
    assert thin(t).tolist() == [0, 5]
    assert thin(t, marks=np.array([0, 0, 1, 0, 0, 0, 0, 0, 0, 0])).tolist() == [0, 2, 3, 5]
    assert thin(np.empty(0, np.int64)).tolist() == []


def test_lanes_end_a_period_after_their_last_row() -> None:
    t = np.array([0, 1, 2, 10, 11]) * NS_PER_S
    at, codes = spans(t, np.array([4, 4, 3, 3, 3]))
    assert (at // NS_PER_S).tolist() == [0, 2, 3, 10, 12]
    assert codes.tolist() == [4, 3, -1, 3, -1]
    assert gaps(t).tolist() == [3]


def test_strips_are_cut_at_pauses_and_unknown_rows() -> None:
    t = np.array([0, 1, 2, 3, 20, 21]) * NS_PER_S
    points = np.arange(12.0).reshape(6, 2)
    points[1] = np.nan
    assert [part.tolist() for part in strips(t, points)] == [[[0, 1], [4, 5], [6, 7]], [[8, 9], [10, 11]]]


@pytest.mark.parametrize(("extent", "spacing"), [(0.0, 0.1), (95.0, 10.0), (500.0, 50.0), (2100.0, 500.0)])
def test_the_grid_has_round_spacing(extent: float, spacing: float) -> None:
    assert grid_spacing(extent) == pytest.approx(spacing)


def test_reasons_have_codes(make_run: MakeRun) -> None:
    columns = load_columns(make_run(duration_s=2.0))
    assert columns.reasons[columns.code("chi_square")] == "chi_square"
    assert columns.code("unheard of") == -1
