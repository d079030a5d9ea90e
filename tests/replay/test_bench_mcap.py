"""The MCAP benchmark: its JSON, and that both readers read the same."""

from pathlib import Path

import numpy as np
import pytest

from replay.bench.mcap import PEER, read_with_peer, run, sensors
from replay.cli import main
from sensors.mcap.io import read_log, write_log


def test_its_json_has_every_row() -> None:
    result = run(repeats=1, messages=200)
    assert set(result) == {"bench", "rows", "ratios", "conditions"}
    names = [row["name"] for row in result["rows"]]
    assert names == ["egoloc", "egoloc, lz4", "egoloc, uncompressed", PEER, "egoloc, all sensors"]
    assert all(0 < row["min"] <= row["median"] <= row["max"] for row in result["rows"])
    rate = {row["name"]: row["median"] for row in result["rows"]}
    assert result["ratios"][PEER] == rate["egoloc"] / rate[PEER]


def test_both_readers_read_the_same(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", sensors(500))
    imu = read_log(tmp_path / "a.mcap").imu
    assert imu is not None
    peer = read_with_peer(tmp_path / "a.mcap")
    np.testing.assert_array_equal(peer[:, 1:], np.column_stack((imu.gyro, imu.accel)))


def test_other_benchmarks_take_no_log(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["bench", "mcap", "some.mcap"])
    assert stopped.value.code == 2
    assert "some.mcap" in capsys.readouterr().err
