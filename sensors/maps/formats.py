"""The formats that a map can be imported from, by name; each one's module is imported when it is asked for."""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.maps.vector_map import Kind, VectorMap
from sensors.records import LeftOut

FORMATS = {
    "lanelet2": "Lanelet2 or Autoware map (.osm)",
    "opendrive": "OpenDRIVE road network (.xodr)",
    "argoverse2": "Argoverse 2 log_map_archive_*.json, or the folder of a log",
    "geojson": "GeoJSON feature collection (.geojson, .json)",
}
"""Name of each format and what SRC is."""

_SUFFIXES = {".osm": "lanelet2", ".xodr": "opendrive", ".geojson": "geojson"}
_HEAD_BYTES = 4096
_MARKS = {
    b"<osm": "lanelet2",
    b"<OpenDRIVE": "opendrive",
    b'"FeatureCollection"': "geojson",
    b'"lane_segments"': "argoverse2",
    b'"pedestrian_crossings"': "argoverse2",
    b'"drivable_areas"': "argoverse2",
}
"""What is found near the beginning of a file of each format."""


def read_map(
    path: Path, format: str | None = None, frame: MapFrame | None = None, rules: Mapping[str, Kind] | None = None
) -> tuple[VectorMap, tuple[LeftOut, ...]]:
    """The map of a file, and what of it is left out. format None: as the file looks; frame None: the file's own.

    rules (geojson only): a kind for a GIS's own names, as ``sensors.maps.geojson`` describes. Raises EgolocError where
    there is no such file or format, where it cannot be guessed, and as each format does.
    """
    path = Path(path)
    if format is not None and format not in FORMATS:
        raise EgolocError(f"format {format}: expected one of {', '.join(FORMATS)}")
    if not (path.is_file() or path.is_dir()):
        raise EgolocError(f"{path}: no such file or folder")
    format = format or guessed(path)
    if rules and format != "geojson":
        raise EgolocError(f"format {format}: rules: only geojson has rules")
    module = import_module(f"sensors.maps.{format}")
    found: tuple[VectorMap, tuple[LeftOut, ...]]
    found = module.read(path, frame, rules) if rules else module.read(path, frame)
    return found


def guessed(path: Path) -> str:
    """The format of a file by its name's ending, else by its beginning; of a folder, the one that has folders.

    Raises EgolocError where it is none that is known.
    """
    if path.is_dir() or path.name.startswith("log_map_archive_"):
        return "argoverse2"
    if path.suffix.lower() in _SUFFIXES:
        return _SUFFIXES[path.suffix.lower()]
    try:
        with path.open("rb") as handle:
            head = handle.read(_HEAD_BYTES)
    except OSError as error:
        raise EgolocError(f"{path}: cannot be read: {error.strerror}") from error
    name = next((name for mark, name in _MARKS.items() if mark in head), None)
    if name is None:
        raise EgolocError(f"{path}: looks like no known map: say which format it is ({', '.join(FORMATS)})")
    return name
