"""Argoverse 2 maps: ``log_map_archive_*.json`` of a log, as the data set's sensor and LiDAR logs carry it.

Lane segments' boundaries are lane lines, each once (neighbours repeat it), an unpainted one virtual; the outline of the
drivable areas is the road's boundary; pedestrian crossings are rings of their two edges. Double lines are told from
the lane outwards. There are no stop lines, poles or signs.

Frame: city coordinates are UTM east and north from the city's origin, which Argoverse 2 publishes (av2-api,
``av2.geometry.utm``). Its heights have a datum of their own, which is not published: z is taken as it is. A file of an
unknown city is a local plane. Where z is missing, it comes from the log's ground height, in 0.3 m cells, where known.
"""

import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from sensors.errors import EgolocError
from sensors.geodesy import Floats, MapFrame, llh_from_map, map_from_llh
from sensors.maps.builder import Builder
from sensors.maps.ground_height import ground_height
from sensors.maps.json_text import read_json
from sensors.maps.outline import outlines
from sensors.maps.placing import LOCAL, placed, refuse_frame
from sensors.maps.rings import closed, ring_of_sides
from sensors.maps.road_length import polyline_m, road_km
from sensors.maps.vector_map import Colour, Kind, Style, VectorMap
from sensors.records import LeftOut

CITIES: dict[str, tuple[int, float, float]] = {
    "ATX": (14, 30.27464237939507, -97.7404457407424),
    "DTW": (17, 42.29993066912924, -83.17555750783717),
    "MIA": (17, 25.77452579915163, -80.19656914449405),
    "PAO": (10, 37.416065, -122.13571963362166),
    "PIT": (17, 40.44177902989321, -80.01294377242584),
    "WDC": (18, 38.889377, -77.0355047439081),
}
"""UTM zone and latitude, longitude (deg) of each city's origin. Source: av2-api, ``av2.geometry.utm``."""

_PAINT: dict[str, tuple[Style, Style]] = {
    "SOLID": (Style.SOLID, Style.SOLID),
    "DASHED": (Style.DASHED, Style.DASHED),
    "DOUBLE_SOLID": (Style.DOUBLE_SOLID, Style.DOUBLE_SOLID),
    "DOUBLE_DASH": (Style.DOUBLE_DASHED, Style.DOUBLE_DASHED),
    "SOLID_DASH": (Style.DASHED_SOLID, Style.SOLID_DASHED),
    "DASH_SOLID": (Style.SOLID_DASHED, Style.DASHED_SOLID),
}
"""Styles as left and as right boundary of the lane that names them, along it: the first word is the inner line."""


class _Point(msgspec.Struct, gc=False):
    x: float
    y: float
    z: float | None = None


class _Lane(msgspec.Struct):
    id: int
    lane_type: str
    left_lane_boundary: list[_Point]
    right_lane_boundary: list[_Point]
    left_lane_mark_type: str
    right_lane_mark_type: str


class _Crossing(msgspec.Struct):
    id: int
    edge1: list[_Point]
    edge2: list[_Point]


class _Area(msgspec.Struct):
    id: int
    area_boundary: list[_Point]


class _Archive(msgspec.Struct):
    lane_segments: dict[str, _Lane]
    pedestrian_crossings: dict[str, _Crossing]
    drivable_areas: dict[str, _Area] = {}


def read(path: Path, frame: MapFrame | None = None) -> tuple[VectorMap, tuple[LeftOut, ...]]:
    """The map of a file, or of a log's folder or its folder ``map``, and what of it is not in the map.

    Raises EgolocError for a damaged file and for a frame that is not the city's.
    """
    path = _file(path)
    archive = read_json(path, _Archive)
    source, xyz_of = f"{path.name} (Argoverse 2)", _Lines(path)
    builder = Builder(source)
    lanes = _Lanes(archive, xyz_of, builder)
    for crossing in archive.pedestrian_crossings.values():
        name = f"pedestrian crossing {crossing.id}"
        ring = ring_of_sides(xyz_of(crossing.edge1, name), xyz_of(crossing.edge2, name))
        builder.add(Kind.CROSSING, ring, name=name)
    _add_areas(archive, xyz_of, builder)
    own = _city_frame(path)
    found = builder.built(own or LOCAL, road_km=lanes.road_km())
    return _moved(path, found, own, frame), builder.left_out


def _file(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = [*path.glob("log_map_archive_*.json"), *path.glob("map/log_map_archive_*.json")]
    if len(found) != 1:
        raise EgolocError(f"{path}: expected one log_map_archive_*.json in it or in its folder map, got {len(found)}")
    return found[0]


def _city_frame(path: Path) -> MapFrame | None:
    """The frame in which city coordinates are map coordinates; the city is in the file's name."""
    named = re.search(r"____([A-Z]{3})_city_\d+", path.name)
    if not named or named[1] not in CITIES:
        return None
    zone, lat, lon = CITIES[named[1]]
    east, north, _ = map_from_llh(MapFrame("utm", zone=zone), np.radians([[lat, lon, 0.0]]))[0]
    return MapFrame("utm", (float(east), float(north), 0.0), zone)
