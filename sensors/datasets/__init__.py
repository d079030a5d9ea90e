"""Importers: real recordings and vendor formats become a ``Log``. One file a format, imported when it is asked for."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from sensors.errors import EgolocError
from sensors.records import Frame, Log

FORMATS = {
    "rtklib": "RTKLIB solution (.pos) with an IMU .csv and its .tag",
    "imu-gnss-drive": "folder of imu.csv.gz, gnss.csv.gz and reference_*.csv.gz",
    "comma2k19": "segment folder with processed_log/ and global_pose/",
    "rosbag": "ROS 1 bag, or ROS 2 bag folder",
    "novatel": "NovAtel OEM7 ASCII log",
    "gtsam-kitti": "folder gtsam/Data of the gtsam package",
    "argoverse2": "folder of an Argoverse 2 sensor or LiDAR log",
    "nuscenes-frame": "folder of nuScenes keyframes with a calibration.json as mmdetection3d writes it",
}
"""Name of each format and what SRC is."""


def load(format: str, src: Path, topics: Mapping[str, str] | None = None) -> Log:
    """Log of a recording. topics (rosbag only): sensor (imu, gnss, ...) -> topic, where a bag has two for a sensor."""
    src = Path(src)
    module = _module(format, src)
    if format == "rosbag":
        log: Log = module.load(src, topics)
        return log
    if topics:
        raise EgolocError(f"format {format}: topics: only rosbag has topics")
    loaded: Log = module.load(src)
    return loaded


def frames(format: str, src: Path) -> Iterator[Frame]:
    """LiDAR and camera frames of a recording in order of time, read one at a time; none where its format has none."""
    src = Path(src)
    module = _module(format, src)
    found: Iterator[Frame] = module.frames(src) if hasattr(module, "frames") else iter(())
    return found


def _module(format: str, src: Path) -> Any:
    """The importer of a format; EgolocError where there is none, or nothing at src."""
    if format not in FORMATS:
        raise EgolocError(f"format {format}: expected one of {', '.join(FORMATS)}")
    if not src.exists():
        raise EgolocError(f"{src}: no such file or folder")
    return import_module(f"sensors.datasets.{format.replace('-', '_')}")
