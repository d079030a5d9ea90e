"""Point clouds in files: LAS and LAZ, PLY, PCD, numpy arrays. One file a format, imported when it is asked for."""

from importlib import import_module
from pathlib import Path

from sensors.clouds.cloud import Cloud as Cloud
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame

FORMATS = {".las": "las", ".laz": "las", ".ply": "ply", ".pcd": "pcd", ".npz": "arrays", ".npy": "arrays"}
"""Ending of a file's name -> module with ``read(path, frame)``."""


def read_cloud(path: Path, frame: MapFrame | None = None) -> Cloud:
    """The points of a file, by its name's ending.

    frame: the map's, into which a cloud that knows its place on the earth (LAS with a CRS) is brought; others stay as
    they are. Raises EgolocError for a file that is missing, of another format, damaged, or too large for the memory.
    """
    path = Path(path)
    name = FORMATS.get(path.suffix.lower())
    if name is None:
        raise EgolocError(f"{path}: expected a point cloud ending in {', '.join(FORMATS)}")
    if not path.is_file():
        raise EgolocError(f"{path}: {'a folder, expected a file' if path.is_dir() else 'no such file'}")
    cloud: Cloud = import_module(f"sensors.clouds.{name}").read(path, frame)
    return cloud
