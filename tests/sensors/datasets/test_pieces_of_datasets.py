"""Every recording, converted: read window by window it is the same as read whole."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from sensors.datasets import load
from sensors.mcap.io import read_log, read_pieces, write_log
from sensors.pieces import join, summed
from tests.sensors.mcap.test_pieces import assert_same, in_windows

LONG = (
    "urban-medium-turn-loop-nominal-001",
    "urban-long-turn-loop-nominal-001",
    "mixed-road-long-drive-nominal-001",
    "parkinglot-maneuvers",
)
RECORDINGS = [
    ("rtklib", "rtk_drive"),
    ("comma2k19", "comma2k19"),
    ("rosbag", "rosbag1/test1.bag"),
    ("imu-gnss-drive", "imu_gnss_drives/parking-lot-figure8-nominal-001"),
    *(pytest.param("imu-gnss-drive", f"imu_gnss_drives/{name}", marks=pytest.mark.slow) for name in LONG),
]
"""Format and place below the data."""
LENGTH_S = 17.0


def assert_pieces_are_the_whole(path: Path) -> None:
    whole, pieces = read_log(path), list(read_pieces(path, length_s=LENGTH_S))
    assert whole.imu is not None
    assert len(pieces) >= (whole.imu.t_ns[-1] - whole.imu.t_ns[0]) * 1e-9 // LENGTH_S
    joined = join(in_windows(pieces, LENGTH_S))
    assert_same(joined, whole)
    assert set(joined.left_out) == set(summed(whole.left_out))


@pytest.mark.parametrize(("format", "place"), RECORDINGS)
def test_a_converted_recording_in_pieces_is_the_whole(data: Path, tmp_path: Path, format: str, place: str) -> None:
    write_log(tmp_path / "a.mcap", load(format, data / place))
    assert_pieces_are_the_whole(tmp_path / "a.mcap")


def test_kitti_in_pieces_is_the_whole(tmp_path: Path) -> None:
    found = find_spec("gtsam")
    if found is None or found.origin is None:
        pytest.skip("gtsam is not installed, and its data with it")
    write_log(tmp_path / "a.mcap", load("gtsam-kitti", Path(found.origin).parent / "Data"))
    assert_pieces_are_the_whole(tmp_path / "a.mcap")
