"""egoloc convert and info with LiDAR frames, on the command line."""

import json
from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow import feather

from replay.cli import main
from sensors.mcap.frames import read_frames
from sensors.mcap.io import write_log
from sensors.records import Log
from tests.sensors.mcap.clouds import frames

AV2 = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    """Exit code, standard output, standard error of a command."""
    code = main([str(word) for word in words])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_an_argoverse_log_is_converted_with_its_frames(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "av2.mcap"
    code, out, _ = run(capsys, "convert", "argoverse2", data / "av2" / AV2, log)
    assert code == 0
    assert "LiDAR: 2 frames at 10.0 Hz, points in each: 51796 and 47552." in out
    assert "UTM zone 17" in out
    assert [frame.t_ns for frame in read_frames(log)] == [315966265259836000, 315966265360032000]
    found = json.loads(run(capsys, "info", log, "--json")[1])
    assert [(lidar["name"], lidar["count"], lidar["points"], lidar["compensated"]) for lidar in found["lidars"]] == [
        ("/lidar/points", 2, 51796, True),
        ("/lidar/1/points", 2, 47552, True),
    ]
    assert found["sensors"]["reference"]["count"] == 2392


def test_info_lists_lidars_for_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.mcap"
    write_log(log, Log(), frames=frames(11))
    code, out, _ = run(capsys, "info", log)
    assert code == 0
    words = " ".join(out.split())
    assert "LiDAR /lidar/points: 11 sweeps at 10.0 Hz, about 100 points each; at (" in words
    assert "fields x, y, z, intensity, ring, t." in words
    assert "/lidar/points PointCloud2 11 10.00 0.10 lidar" in words


def test_the_config_chooses_the_lidar(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, config = tmp_path / "a.mcap", tmp_path / "run.toml"
    write_log(log, Log(), frames=frames(3, lidars=2))
    config.write_text('[topics]\nlidar = "/lidar/1/points"\n')
    found = json.loads(run(capsys, "info", log, "--config", config, "--json")[1])
    assert [lidar["name"] for lidar in found["lidars"]] == ["/lidar/1/points"]
    config.write_text('[topics]\nlidar = "/lidar/2/points"\n')
    code, _, err = run(capsys, "info", log, "--config", config)
    assert code == 2
    assert "topics.lidar: no topic /lidar/2/points; the log has" in err


def test_a_log_without_lidar_lists_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.mcap"
    write_log(log, Log())
    assert json.loads(run(capsys, "info", log, "--json")[1])["lidars"] == []


def test_a_damaged_sweep_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, log = tmp_path / "source", tmp_path / "a.mcap"
    (source / "sensors" / "lidar").mkdir(parents=True)
    (source / "sensors" / "lidar" / "1.feather").write_bytes(b"no feather")
    code, _, err = run(capsys, "convert", "argoverse2", source, log)
    assert (code, err.count("\n")) == (2, 1)
    assert "city_SE3_egovehicle.feather" in err
    poses = {name: [0.0] for name in ("qx", "qy", "qz", "tx_m", "ty_m", "tz_m")}
    feather.write_feather(pa.table({"timestamp_ns": [1], "qw": [1.0]} | poses), source / "city_SE3_egovehicle.feather")
    lidars = {"sensor_name": ["up_lidar", "down_lidar"], "qw": [1.0, 1.0]} | {name: [0.0, 0.0] for name in poses}
    (source / "calibration").mkdir()
    feather.write_feather(pa.table(lidars), source / "calibration" / "egovehicle_SE3_sensor.feather")
    code, _, err = run(capsys, "convert", "argoverse2", source, log)
    assert (code, err.count("\n")) == (2, 1)
    assert "1.feather: expected a feather file" in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["source"]
