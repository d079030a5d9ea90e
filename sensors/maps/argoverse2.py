"""Argoverse 2 maps: ``log_map_archive_*.json`` of a log, as the data set's sensor and LiDAR logs carry it.

Lane segments' boundaries are lane lines, each once (neighbours repeat it), an unpainted one virtual; the outline of the
drivable areas is the road's boundary; pedestrian crossings are rings of their two edges. Double lines are told from
the lane outwards. There are no stop lines, poles or signs.

Frame: city coordinates are UTM east and north from the city's origin, which Argoverse 2 publishes (av2-api,
``av2.geometry.utm``). Its heights have a datum of their own, which is not published: z is taken as it is. A file of an
unknown city is a local plane. Where z is missing, it comes from the log's ground height, in 0.3 m cells, where known.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from sensors.errors import EgolocError
from sensors.geodesy import Floats, MapFrame, map_from_llh
from sensors.maps.builder import Builder
from sensors.maps.ground_height import ground_height
from sensors.maps.json_text import read_json
from sensors.maps.outline import outlines
from sensors.maps.placing import LOCAL, geodetic, placed, refuse_far, refuse_frame
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
    drivable_areas: dict[str, _Area]


def read(path: Path, frame: MapFrame | None = None) -> tuple[VectorMap, tuple[LeftOut, ...]]:
    """The map of a file, or of a log's folder or its folder ``map``, and what of it is not in the map.

    Raises EgolocError for a damaged file and for a frame that is not the city's.
    """
    path = _file(path)
    archive = read_json(path, _Archive)
    builder = Builder(f"{path.name} (Argoverse 2)")
    length_km = _add_lanes(path, archive.lane_segments, builder)
    for crossing in archive.pedestrian_crossings.values():
        name = f"pedestrian crossing {crossing.id}"
        ring = ring_of_sides(_xyz(path, crossing.edge1, name), _xyz(path, crossing.edge2, name))
        builder.add(Kind.CROSSING, ring, name=name)
    _add_areas(path, archive.drivable_areas, builder)
    own = city_frame(path)
    found = builder.built(own or LOCAL, road_km=length_km)
    return _moved(path, _with_heights(path, found), own, frame), builder.left_out


def _file(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = [*path.glob("log_map_archive_*.json"), *path.glob("map/log_map_archive_*.json")]
    if len(found) != 1:
        raise EgolocError(f"{path}: expected one log_map_archive_*.json in it or in its folder map, got {len(found)}")
    return found[0]


def city_frame(path: Path) -> MapFrame | None:
    """The frame in which city coordinates are map coordinates; the city is in a map file's name, else None."""
    named = re.search(r"____([A-Z]{3})_city_\d+", path.name)
    if not named or named[1] not in CITIES:
        return None
    zone, lat, lon = CITIES[named[1]]
    east, north, _ = map_from_llh(MapFrame("utm", zone=zone), np.radians([[lat, lon, 0.0]]))[0]
    return MapFrame("utm", (float(east), float(north), 0.0), zone)


def _xyz(path: Path, points: list[_Point], name: str) -> Floats:
    """(n, 3) vertices, z NaN where missing."""
    if len(points) < 2:
        raise EgolocError(f"{path}: {name}: expected two points or more, got {len(points)}")
    xyz = np.array([(point.x, point.y, np.nan if point.z is None else point.z) for point in points])
    refuse_far(f"{path}: {name}", xyz)
    return xyz


def _add_lanes(path: Path, segments: Mapping[str, _Lane], builder: Builder) -> float:
    """Add every boundary once, and return the kilometres of road for vehicles."""
    paint: dict[object, tuple[Style, Colour, str, Floats]] = {}
    lane_m, bounds = [], []
    for lane in segments.values():
        keys, length = [], 0.0
        for side, points, mark in (
            ("left", lane.left_lane_boundary, lane.left_lane_mark_type),
            ("right", lane.right_lane_boundary, lane.right_lane_mark_type),
        ):
            name = f"lane {lane.id} {side}"
            xyz = _xyz(path, points, name)
            key, turned = _key(points)
            style, colour = _paint(mark, (side == "right") != turned, builder)
            old = paint.get(key)
            if old is None or old[0] == Style.VIRTUAL:
                paint[key] = style, colour, name, xyz[::-1] if turned else xyz
            if old is not None and (style, colour) != old[:2]:
                builder.leave_out("paint that one of a boundary's two lanes names otherwise: the other's is taken")
            keys.append(key)
            length += 0.5 * polyline_m(xyz)
        if lane.lane_type in ("VEHICLE", "BUS"):
            lane_m.append(length)
            bounds.append((keys[0], keys[1]))
    for style, colour, name, xyz in paint.values():
        builder.add(Kind.LANE_LINE, xyz, style, colour, name)
    return road_km(lane_m, bounds)


def _key(points: list[_Point]) -> tuple[object, bool]:
    """What a boundary's two lanes have in common, and whether it runs against this lane."""
    key = tuple((point.x, point.y) for point in points)
    return (key[::-1], True) if key[::-1] < key else (key, False)


def _paint(mark: str, right: bool, builder: Builder) -> tuple[Style, Colour]:
    """Style and colour of a mark type, as it is seen along the line whose lane is on its left (right: it is the lane's
    right boundary) or, turned, on its right."""
    if mark in ("NONE", "UNKNOWN"):
        return Style.VIRTUAL if mark == "NONE" else Style.UNKNOWN, Colour.UNKNOWN
    pattern, _, colour = mark.rpartition("_")
    if pattern not in _PAINT or colour not in Colour.__members__:
        builder.leave_out(f"mark types {mark}: not known, the line is taken without style")
        return Style.UNKNOWN, Colour.UNKNOWN
    return _PAINT[pattern][right], Colour[colour]


def _add_areas(path: Path, areas: Mapping[str, _Area], builder: Builder) -> None:
    """The edge of all drivable areas together: they overlap where one goes over into the next."""
    names = [f"drivable area {area.id}" for area in areas.values()]
    rings = [closed(_xyz(path, area.area_boundary, name)) for area, name in zip(areas.values(), names, strict=True)]
    parts = outlines(rings)
    whole = {index for index, part in parts if part is rings[index]}
    if len(whole) < len(rings):
        reason = "drivable areas: stretches of the outline between two of them are no edge of the road"
        builder.leave_out(reason, len(rings) - len(whole))
    for index, part in parts:
        builder.add(Kind.ROAD_BOUNDARY, part, name=names[index])


def _with_heights(path: Path, found: VectorMap) -> VectorMap:
    """Missing heights from the log's raster."""
    xyz = found.elements.xyz.copy()
    missing = np.isnan(xyz[:, 2])
    if not missing.any():
        return found
    xyz[missing, 2] = ground_height(path.parent, xyz[missing, :2])
    return replace(found, elements=replace(found.elements, xyz=xyz))


def _moved(path: Path, found: VectorMap, own: MapFrame | None, frame: MapFrame | None) -> VectorMap:
    """The map in the frame asked for."""
    if own is None:
        refuse_frame(f"{path}: unknown city", frame)
    if own is None or frame is None:
        return found
    frame, xyz = placed(str(path), geodetic(own, found.elements.xyz), frame)
    return replace(found, frame=frame, elements=replace(found.elements, xyz=xyz))
