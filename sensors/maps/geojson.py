"""GeoJSON (RFC 7946) as a map: whatever a GIS has, in WGS-84 longitude and latitude, heights as third coordinate.

A feature's properties ``kind``, ``style`` and ``colour`` are our names in small letters (``lane_line``, ``dashed``,
``white``); ``name`` or the feature's id names it. A GIS's own names come in through rules. ``sensors.maps.geojson_out``
writes such a file; its member ``egoloc`` holds the map's frame and length of road, which are then taken over.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np

from sensors.errors import EgolocError
from sensors.geodesy import Floats, MapFrame
from sensors.maps.builder import Builder
from sensors.maps.json_text import read_json
from sensors.maps.placing import placed
from sensors.maps.vector_map import Colour, Kilometres, Kind, Style, VectorMap
from sensors.records import LeftOut

Position = Annotated[list[float], msgspec.Meta(min_length=2)]
Ring = Annotated[list[Position], msgspec.Meta(min_length=4)]
Line = Annotated[list[Position], msgspec.Meta(min_length=2)]
Rules = Mapping[str, Kind]
"""A kind for ``value`` of any property, or for ``property=value``. They go before the property ``kind``."""

E = TypeVar("E", Style, Colour)

_LINES = frozenset({Kind.LANE_LINE, Kind.ROAD_BOUNDARY, Kind.STOP_LINE, Kind.MARKING})
_RINGS = frozenset({Kind.CROSSING, Kind.MARKING, Kind.SIGN, Kind.ROAD_BOUNDARY})
_POINTS = frozenset({Kind.POLE, Kind.SIGN})
_WGS84 = ("CRS84", "4326", "4979")
"""How names of WGS-84 end in the member ``crs``, which RFC 7946 took out and a GIS still writes."""


class Own(msgspec.Struct):
    """What a map of ours has and a GIS does not know."""

    frame: MapFrame
    road_km: Kilometres | None = None


class _Geometry(msgspec.Struct, tag_field="type"):
    pass


class Point(_Geometry):
    coordinates: Position


class MultiPoint(_Geometry):
    coordinates: list[Position]


class LineString(_Geometry):
    coordinates: Line


class MultiLineString(_Geometry):
    coordinates: list[Line]


class Polygon(_Geometry):
    coordinates: list[Ring]


class MultiPolygon(_Geometry):
    coordinates: list[list[Ring]]


class GeometryCollection(_Geometry):
    geometries: list[Any]


class _Feature(msgspec.Struct):
    type: Literal["Feature"]
    geometry: Point | MultiPoint | LineString | MultiLineString | Polygon | MultiPolygon | GeometryCollection | None
    properties: dict[str, Any] | None = None
    id: str | int | float | None = None


class _Collection(msgspec.Struct):
    type: Literal["FeatureCollection"]
    features: list[_Feature]
    crs: Any = None
    egoloc: Own | None = None


class _Element(NamedTuple):
    kind: Kind
    style: Style
    colour: Colour
    name: str
    positions: list[list[float]]


def read(
    path: Path, frame: MapFrame | None = None, rules: Rules | None = None
) -> tuple[VectorMap, tuple[LeftOut, ...]]:
    """The map of a file, and which features are not in the map.

    Raises EgolocError for a file that is no feature collection, coordinates off the earth, and another place's frame.
    """
    collection = read_json(path, _Collection)
    _refuse_crs(path, collection.crs)
    builder = Builder(f"{path.name} (GeoJSON)")
    named = [(_name(row, feature), feature) for row, feature in enumerate(collection.features)]
    elements = [element for name, feature in named for element in _elements(name, feature, rules or {}, builder)]
    if named and not elements:
        raise EgolocError(f"{path}: no feature of {len(named)} is an element: {builder.left_out[0].reason}")
    own = collection.egoloc
    frame, xyz = placed(str(path), _llh(path, elements), frame or (own.frame if own else None))
    first = 0
    for kind, style, colour, name, positions in elements:
        builder.add(kind, xyz[first : first + len(positions)], style, colour, name)
        first += len(positions)
    return builder.built(frame, road_km=own.road_km if own else None), builder.left_out


def _refuse_crs(path: Path, crs: Any) -> None:
    name = crs.get("properties", {}).get("name", crs) if isinstance(crs, dict) else crs
    if crs is not None and not str(name).endswith(_WGS84):
        raise EgolocError(f"{path}: $.crs: expected WGS-84 longitude and latitude (RFC 7946), got {str(name)[:60]}")


def _name(row: int, feature: _Feature) -> str:
    named = (feature.properties or {}).get("name")
    return str(named) if named else f"feature {row if feature.id is None else feature.id}"


def _elements(name: str, feature: _Feature, rules: Rules, builder: Builder) -> Iterator[_Element]:
    """A feature's parts that fit its kind."""
    properties = feature.properties or {}
    kind = _kind(properties, rules)
    if kind is None:
        given = properties.get("kind")
        what = "without the property kind, and no rule for it" if given is None else f"of kind {given}: not known"
        builder.leave_out(f"features {what}")
        return
    style = _named(properties, "style", Style, builder)
    colour = _named(properties, "colour", Colour, builder)
    for what, positions in _parts(feature.geometry):
        if reason := _misfit(kind, what, positions):
            builder.leave_out(f"{kind.name.lower()}: {reason}")
        else:
            yield _Element(kind, style, colour, name, positions)


def _kind(properties: dict[str, Any], rules: Rules) -> Kind | None:
    for key, value in properties.items():
        if isinstance(value, str) and (rule := rules.get(f"{key}={value}", rules.get(value))) is not None:
            return rule
    return Kind.__members__.get(str(properties.get("kind")).upper())


def _named(properties: dict[str, Any], key: str, names: type[E], builder: Builder) -> E:
    value = properties.get(key)
    if value is not None and str(value).upper() not in names.__members__:
        builder.leave_out(f"{key} {value}: not known, the element is taken without")
        value = None
    return names["UNKNOWN" if value is None else str(value).upper()]


def _parts(geometry: _Geometry | None) -> Iterator[tuple[str, list[list[float]]]]:
    """What each part is (point, line, ring, hole, or a word for what no part can be), and its positions."""
    match geometry:
        case Point(at):
            yield "point", [at]
        case MultiPoint(points):
            yield from (("point", [at]) for at in points)
        case LineString(line):
            yield "line", line
        case MultiLineString(lines):
            yield from (("line", line) for line in lines)
        case Polygon(rings):
            yield from (("hole" if row else "ring", ring) for row, ring in enumerate(rings))
        case MultiPolygon(polygons):
            yield from (("hole" if row else "ring", ring) for rings in polygons for row, ring in enumerate(rings))
        case GeometryCollection():
            yield "geometry collection", []
        case _:
            yield "feature without geometry", []


def _misfit(kind: Kind, what: str, positions: list[list[float]]) -> str:
    """Why a part is no element of its kind; nothing where it is one."""
    if what == "hole" and kind is not Kind.ROAD_BOUNDARY:
        return "holes in a ring: it is taken without"
    is_ring = what in ("ring", "hole")
    if is_ring and positions[0] != positions[-1]:
        return "a ring that is not closed"
    is_ring = is_ring or (what == "line" and len(positions) > 3 and positions[0] == positions[-1])
    fits = (
        (what == "point" and kind in _POINTS)
        or (what == "line" and (kind in _LINES or (kind is Kind.POLE and len(positions) == 2)))
        or (is_ring and kind in _RINGS)
    )
    return "" if fits else f"a {what} is none"


def _llh(path: Path, elements: list[_Element]) -> Floats:
    """(N, 3) rad, rad, m of all positions, heights NaN where there is no third coordinate."""
    positions = [position for element in elements for position in element.positions]
    llh = np.array([(at[1], at[0], at[2] if len(at) > 2 else np.nan) for at in positions]).reshape(-1, 3)
    wrong = (np.abs(llh[:, :2]) > (90.0, 180.0)).any(axis=1)
    if wrong.any():
        row = int(np.argmax(wrong))
        ends = np.cumsum([len(element.positions) for element in elements])
        name = elements[int(np.searchsorted(ends, row, side="right"))].name
        got = f"{positions[row][0]:.10g}, {positions[row][1]:.10g}"
        raise EgolocError(f"{path}: {name}: expected longitude and latitude in degrees (WGS-84), got {got}")
    llh[:, :2] = np.radians(llh[:, :2])
    return llh
