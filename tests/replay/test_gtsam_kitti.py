"""KITTI sequence 00 of the gtsam wheel, with its pauses in the IMU, through the whole replay."""

from importlib.util import find_spec
from pathlib import Path

import msgspec
import pytest

from replay.config import HideGnss, RunConfig
from replay.harness import replay_source
from sensors.datasets import load
from sensors.records import Log
from tests.replay.cutting import Memory


@pytest.fixture(scope="module")
def kitti() -> Log:
    found = find_spec("gtsam")
    if found is None or not found.submodule_search_locations:
        pytest.skip("gtsam is not installed: pip install 'egoloc[bench]'")
    return load("gtsam-kitti", Path(found.submodule_search_locations[0]) / "Data")


def test_hardly_a_position_of_the_drive_is_rejected(kitti: Log, tmp_path: Path) -> None:
    """Twice the IMU is off by more than it says, and a position must insist before it is believed: at one a second."""
    metrics = replay_source(Memory(kitti), tmp_path / "run", RunConfig())
    counts = metrics["decisions"]["gnss_position"]
    assert counts["accepted"] >= 462
    assert counts["chi_square"] <= 5


def test_drift_over_hidden_seconds_is_as_large_as_stated(kitti: Log, tmp_path: Path) -> None:
    config = msgspec.structs.replace(RunConfig(), hide_gnss=HideGnss(30.0, 5.0))
    hidden = replay_source(Memory(kitti), tmp_path / "run", config)["hidden"]
    assert hidden["stretches"] == 15
    assert hidden["end_horizontal_m"]["p50"] < 0.6
    assert hidden["end_horizontal_m"]["max"] < 1.5
    assert 0.5 < hidden["end_error_over_sigma_rms"] < 1.5
