"""egoloc replay --smooth: its table and row, the same bytes whatever the way, and its use as a reference."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

from replay.cli import main
from replay.config import HideGnss, RunConfig
from replay.drive import read_reference
from replay.harness import replay_source, score_run
from replay.store import Keep
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, map_from_llh
from sensors.mcap.io import write_log
from sensors.records import Log
from sensors.rotation import rotate
from sensors.simulate.drive import simulate
from sensors.simulate.scenarios import load
from sensors.vehicle import Vehicle
from tests.replay.cutting import Memory
from tests.replay.fleet import LOG_FILES, content, tiny

SMOOTH = RunConfig(smooth=True)


@pytest.fixture(scope="module")
def log() -> Log:
    """Two minutes with float and lost RTK and blind stretches."""
    return simulate(120.0, 5, load("demo"))


@pytest.fixture(scope="module")
def run(log: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A smoothed run, not to be changed."""
    out = tmp_path_factory.mktemp("runs") / "run"
    replay_source(Memory(log), out, SMOOTH)
    return out


def metrics_of(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return found


def columns(path: Path) -> dict[str, Any]:
    table = pq.read_table(path)
    return {name: table[name].combine_chunks() for name in table.column_names}


class TestRun:
    def test_a_table_and_a_row(self, run: Path) -> None:
        assert sorted(p.name for p in run.iterdir()) == sorted([*LOG_FILES, "smoothed.parquet"])
        states, smoothed = (columns(run / f"{name}.parquet") for name in ("states", "smoothed"))
        assert list(states) == list(smoothed)
        same = ("t_ns", "ref_x", "ref_y", "ref_yaw", "ref_speed", "excluded", "stretch", "scene", "mode", "log")
        assert [name for name in same if not states[name].equals(smoothed[name])] == []
        methods = metrics_of(run)["methods"]
        assert list(methods) == ["gnss", "egovm", "fusion", "smoothed"]
        before, after = methods["fusion"], methods["smoothed"]
        assert after["ar"] >= before["ar"] > 0.9
        assert after["coverage"] == before["coverage"]
        for axis in ("lon", "lat", "yaw"):
            assert after[axis]["rmse"] < before[axis]["rmse"]
            error = np.abs(smoothed[f"err_{axis}"].to_numpy(zero_copy_only=False))[1:]
            error = np.degrees(error) if axis == "yaw" else error
            assert after[axis]["max"] == pytest.approx(np.nanmax(error), rel=1e-12)
            assert after[axis]["mae"] == pytest.approx(np.nanmean(error), rel=1e-9)

    def test_the_filter_does_not_notice(self, log: Log, run: Path, tmp_path: Path) -> None:
        replay_source(Memory(log), tmp_path / "plain", RunConfig())
        for name in ("states.parquet", "decisions.parquet"):
            assert (tmp_path / "plain" / name).read_bytes() == (run / name).read_bytes()
        plain, smoothed = metrics_of(tmp_path / "plain"), metrics_of(run)
        del smoothed["methods"]["smoothed"]
        assert plain == smoothed

    def test_the_same_bytes_however_the_drive_is_cut(self, log: Log, run: Path, tmp_path: Path) -> None:
        for length_s in (50.0, 7.0):
            out = tmp_path / f"cut_{length_s:g}"
            replay_source(Memory(log, length_s=length_s), out, SMOOTH)
            assert content(out) == content(run)

    def test_scored_again_it_is_the_same(self, run: Path, log: Log, tmp_path: Path) -> None:
        out = tmp_path / "run"
        hidden = msgspec.structs.replace(SMOOTH, hide_gnss=HideGnss(30.0, 10.0))
        replay_source(Memory(log), out, hidden)
        before = content(out)
        score_run(out, hidden.limits)
        assert content(out) == before

    def test_thinned_like_the_states(self, log: Log, tmp_path: Path) -> None:
        replay_source(Memory(log), tmp_path / "run", SMOOTH, keep=Keep(states_hz=1.0))
        t = [pq.read_table(tmp_path / "run" / f"{name}.parquet")["t_ns"].to_numpy() for name in ("states", "smoothed")]
        assert np.array_equal(*t)
        assert (t[0] % 10**9 == 0).all()

    def test_a_drive_that_never_aligns(self, log: Log, tmp_path: Path) -> None:
        assert log.gnss is not None
        standing = replace(log.gnss[:20], yaw=None, yaw_sigma=None)
        lost = replace(log, gnss=standing, gnss_velocity=None, pose_fixes=None)
        replay_source(Memory(lost), tmp_path / "run", SMOOTH)
        table = columns(tmp_path / "run" / "smoothed.parquet")
        assert len(table["t_ns"]) > 1000
        assert np.isnan(table["x"].to_numpy()).all()
        assert metrics_of(tmp_path / "run")["methods"]["smoothed"]["coverage"] == 0.0

    def test_a_drive_that_ends_badly_leaves_nothing(self, log: Log, tmp_path: Path) -> None:
        class Torn(Memory):
            def pieces(self, config: RunConfig) -> Iterator[Log]:
                yield from list(super().pieces(config))[:2]
                raise EgolocError("drive: chunk 7 is damaged")

        with pytest.raises(EgolocError, match="chunk 7"):
            replay_source(Torn(log, length_s=30.0), tmp_path / "run", SMOOTH)
        assert list(tmp_path.iterdir()) == []


class TestHidden:
    def test_better_than_the_filter_in_every_stretch(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        """GNSS and IMU alone, hidden for half a minute, where errors exceed those of the fixes that are the reference.

        ``tests/fusion/test_smoother.py`` compares with the truth.
        """
        path = tmp_path / "drive.mcap"
        write_log(path, replace(simulate(240.0, 4, load("clean")), pose_fixes=None, wheel=None))
        arguments = ["--hide-gnss", "50:30", "--smooth", "--out", str(tmp_path / "run")]
        assert main(["replay", str(path), *arguments]) == 0
        text = capsys.readouterr().out
        assert "Largest horizontal error within them: median" in text
        assert "Smoothed" in text
        hidden = metrics_of(tmp_path / "run")["hidden"]
        assert len(hidden["per_stretch"]) == 4
        pairs = [
            [entry[key]["largest_horizontal_m"] for key in ("within", "smoothed")] for entry in hidden["per_stretch"]
        ]
        told = [(before, after) for before, after in pairs if before > 0.15]
        assert len(told) >= 2
        assert all(after < before for before, after in told)
        self._equals_the_table(tmp_path / "run", hidden)

    def _equals_the_table(self, run: Path, hidden: dict[str, Any]) -> None:
        for name, key in (("states", "within"), ("smoothed", "smoothed")):
            table = columns(run / f"{name}.parquet")
            c = {k: table[k].to_numpy(zero_copy_only=False) for k in table if k not in {"pose_cov", "log", "excluded"}}
            miss = np.hypot(c["x"] - c["ref_x"], c["y"] - c["ref_y"])
            ratio = miss / np.hypot(c["sigma_lon"], c["sigma_lat"])
            for index, entry in enumerate(hidden["per_stretch"]):
                inside = (c["stretch"] == index) & np.isfinite(ratio)
                if inside.any():
                    assert entry[key]["largest_horizontal_m"] == pytest.approx(miss[inside].max(), rel=1e-12)
                    rms = np.sqrt(np.mean(ratio[inside] ** 2))
                    assert entry[key]["error_over_sigma_rms"] == pytest.approx(rms, rel=1e-9)


def test_in_arrival_order_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = tiny(tmp_path, 1)
    assert main(["replay", logs, "--smooth", "--order", "arrival", "--out", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.endswith('fusion.order: expected "stamp" to smooth a drive, got "arrival"')
    assert not (tmp_path / "run").exists()


class TestCampaign:
    def test_workers_and_resume_give_the_same_bytes(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        logs = tiny(tmp_path, 3)
        for name, workers in (("one", "1"), ("two", "2")):
            arguments = ["replay", logs, "--smooth", "--out", str(tmp_path / name), "--workers", workers]
            assert main(arguments) == 0
        whole = content(tmp_path / "one")
        assert content(tmp_path / "two") == whole
        assert sum(name.endswith("smoothed.parquet") for name in whole) == 3
        assert "smoothed" in metrics_of(tmp_path / "one")["methods"]
        drives = sorted(p for p in (tmp_path / "two").iterdir() if p.is_dir())
        (drives[0] / "smoothed.parquet").unlink()
        (drives[1] / "smoothed.parquet").write_bytes(b"PAR1")
        kept = (drives[2] / "smoothed.parquet").stat().st_mtime_ns
        assert main([*arguments, "--resume"]) == 0
        assert content(tmp_path / "two") == whole
        assert (drives[2] / "smoothed.parquet").stat().st_mtime_ns == kept
        capsys.readouterr()
        plain = [argument for argument in arguments if argument != "--smooth"]
        assert main([*plain, "--resume"]) == 2
        assert "configuration" in capsys.readouterr().err


class TestReference:
    def test_the_smoothed_drive_as_its_own_reference(self, log: Log, run: Path, tmp_path: Path) -> None:
        path = tmp_path / "drive.mcap"
        write_log(path, replace(log, reference=None))
        arguments = ["--smooth", "--reference", str(run / "smoothed.parquet"), "--out", str(tmp_path / "own")]
        assert main(["replay", str(path), *arguments]) == 0
        found = metrics_of(tmp_path / "own")
        assert found["reference"] == {"kind": "odometry", "source": "smoothed.parquet", "heading": "attitude"}
        assert found["methods"]["smoothed"]["lon"]["max"] < 1e-6
        assert found["methods"]["smoothed"]["yaw"]["max"] < 1e-6
        table = columns(tmp_path / "own" / "states.parquet")
        known = columns(run / "smoothed.parquet")
        sigma = table["ref_sigma_yaw"].to_numpy(zero_copy_only=False)
        at = known["t_ns"].to_numpy().tolist().index(table["t_ns"][5].as_py())
        assert sigma[5] == pytest.approx(np.sqrt(known["pose_cov"][at].values.to_numpy()[35]), rel=1e-9)
        assert found["methods"]["fusion"]["lat"]["mae"] == pytest.approx(
            metrics_of(run)["methods"]["fusion"]["lat"]["mae"], abs=0.02
        )

    def test_in_another_map_frame_and_at_another_point(self, run: Path) -> None:
        arm = (1.0, -0.5, 1.2)
        here, frame = read_reference(run / "smoothed.parquet", None, Vehicle())
        assert frame is not None
        llh = llh_from_map(frame, here.p_map)
        other = MapFrame("enu", (float(np.degrees(llh[0, 0])), float(np.degrees(llh[0, 1])) + 0.3, 0.0))
        there, placed = read_reference(run / "smoothed.parquet", other, Vehicle(reference_lever_arm=arm))
        assert placed == other
        moved = map_from_llh(other, llh_from_map(frame, here.p_map + rotate(here.q_map_body, np.array(arm))))
        assert np.abs(there.p_map - moved).max() < 1e-6
        turned = map_from_llh(other, llh_from_map(frame, here.p_map + rotate(here.q_map_body, np.array([1.0, 0, 0]))))
        ahead = turned - map_from_llh(other, llh)
        assert np.abs(rotate(there.q_map_body, np.array([1.0, 0, 0])) - ahead).max() < 1e-3  # a grid metre is not one

    @pytest.mark.parametrize(
        ("spoil", "said"),
        [
            (lambda run, path: path.write_bytes((run / "states.parquet").read_bytes()), "without a map frame"),
            (lambda run, path: path.write_bytes((run / "decisions.parquet").read_bytes()), "without column"),
            (lambda _, path: path.write_bytes(b"PAR1 and no more"), "expected a Parquet file"),
            (
                lambda run, path: pq.write_table(pq.read_table(run / "smoothed.parquet").slice(0, 0), path),
                "no usable row of 0",
            ),
        ],
    )
    def test_files_that_are_none(
        self, spoil: Any, said: str, run: Path, log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path, reference = tmp_path / "drive.mcap", tmp_path / "given.parquet"
        write_log(path, log)
        spoil(run, reference)
        assert main(["replay", str(path), "--reference", str(reference), "--out", str(tmp_path / "run")]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"egoloc: error: {reference}: ")
        assert said in error
        assert error.count("\n") == 1
        assert not (tmp_path / "run").exists()
