"""The registry: names, lazy modules, mistakes."""

import subprocess
import sys
from pathlib import Path

import pytest

from sensors.datasets import FORMATS, load
from sensors.errors import EgolocError


def test_the_formats_are_those_of_the_command_line() -> None:
    known = {
        "rtklib",
        "imu-gnss-drive",
        "comma2k19",
        "rosbag",
        "novatel",
        "gtsam-kitti",
        "argoverse2",
        "nuscenes-frame",
    }
    assert set(FORMATS) == known


def test_no_importer_is_loaded_before_it_is_asked_for() -> None:
    code = "import sys, sensors.datasets; print([m for m in sys.modules if 'rosbags' in m or 'sensors.datasets.' in m])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="format kitti: expected one of rtklib"):
        load("kitti", tmp_path)
    with pytest.raises(EgolocError, match="no such file or folder"):
        load("rtklib", tmp_path / "absent")
    with pytest.raises(EgolocError, match="only rosbag has topics"):
        load("rtklib", tmp_path, {"imu": "/imu"})


@pytest.mark.parametrize("format", sorted(FORMATS))
def test_an_empty_folder_and_a_foreign_file_are_named(format: str, tmp_path: Path) -> None:
    for src in (tmp_path, tmp_path / "foreign.bin"):
        if src != tmp_path:
            src.write_bytes(bytes(range(256)) * 8)
        with pytest.raises(EgolocError, match=tmp_path.name) as raised:
            load(format, src)
        assert "\n" not in str(raised.value)
