"""egoloc simulate --frames and --map: what they write is the world of the drive; without streets they write nothing."""

from pathlib import Path

import numpy as np
import pytest

from replay.cli import main
from sensors.maps.map_file import open_map
from sensors.mcap.frames import read_frames
from sensors.mcap.io import read_log
from sensors.simulate.scenarios import load
from sensors.simulate.surroundings import drive_frames, drive_map


def test_frames_and_map_are_those_of_the_drive(tmp_path: Path) -> None:
    log, chart = tmp_path / "log.mcap", tmp_path / "map.parquet"
    assert (
        main(["simulate", "survey", str(log), "--duration-s", "1", "--seed", "2", "--frames", "--map", str(chart)]) == 0
    )
    scenario = load("survey")
    wanted = list(drive_frames(1.0, 2, scenario))
    found = list(read_frames(log))
    assert len(found) == len(wanted) == 10
    for frame, made in zip(found, wanted, strict=True):
        assert (frame.t_ns, frame.arrival_ns) == (made.t_ns, made.arrival_ns)
        for column in ("xyz", "offset_ns", "intensity", "ring", "T_body_lidar"):
            np.testing.assert_array_equal(getattr(frame.sweeps[0], column), getattr(made.sweeps[0], column))
    known = drive_map(1.0, 2, scenario)
    with open_map(chart) as opened:
        assert opened.frame == known.frame == read_log(log).map_frame
        held = opened.whole()
    assert len(held.elements) == len(known.elements) > 20


def test_the_log_is_the_same_with_and_without_frames(tmp_path: Path) -> None:
    with_frames, without = tmp_path / "a.mcap", tmp_path / "b.mcap"
    assert main(["simulate", "survey", str(with_frames), "--duration-s", "1", "--frames"]) == 0
    assert main(["simulate", "survey", str(without), "--duration-s", "1"]) == 0
    np.testing.assert_array_equal(read_log(with_frames).imu.gyro, read_log(without).imu.gyro)
    assert not list(read_frames(without))


@pytest.mark.parametrize("option", [["--frames"], ["--map", "map.parquet"]])
def test_a_drive_without_streets_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], option: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "clean", "log.mcap", "--duration-s", "1", *option]) == 2
    assert "network: expected a [network]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_map_does_not_replace_the_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "log.mcap")
    assert main(["simulate", "survey", path, "--duration-s", "1", "--map", path]) == 2
    assert "--map: expected another file than the log" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
