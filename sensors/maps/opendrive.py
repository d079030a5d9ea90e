"""OpenDRIVE maps (.xodr): lane lines, edges of roads, stop lines, crossings, poles, signs and lights.

``hardened_xml`` reads, ``opendrive_road`` makes records of it, ``opendrive_lanes``, ``_signals`` and ``_objects`` make
elements. Heights are the file's (elevation, superelevation, crossfall, shape, lane height).
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.maps.builder import Builder
from sensors.maps.georeference import georeference
from sensors.maps.hardened_xml import mistake, number, parse
from sensors.maps.opendrive_lanes import add_lanes, driving_length
from sensors.maps.opendrive_objects import add_objects
from sensors.maps.opendrive_road import Road, read_road
from sensors.maps.opendrive_signals import add_signals
from sensors.maps.placing import LOCAL, placed, refuse_frame
from sensors.maps.vector_map import Floats, VectorMap
from sensors.records import LeftOut

NOT_TAKEN = {
    "junction": "junctions: their connecting roads are taken, their links are not",
    "controller": "controllers of signals",
    "junctionGroup": "groups of junctions",
    "station": "stations",
}

ON_EARTH_M = 2e7
"""Half the way around the earth: no projection goes farther."""


def read(path: Path, frame: MapFrame | None = None) -> tuple[VectorMap, tuple[LeftOut, ...]]:
    """Import a file; road_km is the length of roads with driving lanes, the roads within junctions not counted.

    frame: the one to bring it into; None: UTM by the file's georeference, without one the file's local plane (ENU with
    an unknown datum). Raises EgolocError, one line naming file, line and what was expected.
    """
    root = parse(path)
    if root.tag != "OpenDRIVE":
        raise mistake(root, "expected an OpenDRIVE map")
    builder = Builder(f"{path.name} (OpenDRIVE)")
    roads = _roads(root, builder)
    for road in roads.values():
        try:
            add_lanes(road, builder)
            add_signals(road, roads, builder)
            add_objects(road, builder)
        except EgolocError as error:
            where = str(path)
            raise error if str(error).startswith(where) else EgolocError(f"{where}: road {road.id}: {error}") from error
    road_km = sum(driving_length(road) for road in roads.values() if not road.junction) / 1e3
    return _in_frame(builder, root, path, frame, road_km)


def _roads(root: Element, builder: Builder) -> dict[str, Road]:
    roads: dict[str, Road] = {}
    for element in root.findall("road"):
        road = read_road(element, builder)
        if road is None:
            continue
        if road.id in roads:
            raise mistake(element, f"id: expected another one for each road, got {road.id!r} again")
        roads[road.id] = road
        if element.find("railroad/switch") is not None:
            builder.leave_out("railway switches", len(element.findall("railroad/switch")))
    for tag, reason in NOT_TAKEN.items():
        if root.find(tag) is not None:
            builder.leave_out(reason, len(root.findall(tag)))
    return roads


def _in_frame(
    builder: Builder, root: Element, path: Path, frame: MapFrame | None, road_km: float
) -> tuple[VectorMap, tuple[LeftOut, ...]]:
    """The map with its vertices turned by the header's offset, projected, and brought into the frame."""
    text = (root.findtext("header/geoReference") or "").strip()
    reference = georeference(text, path) if text else None
    if reference is not None and reference.geoid:
        builder.leave_out("geoids of the georeference: heights stay above the geoid")
    shifted = _shift(root.find("header/offset"))
    local = builder.built(LOCAL, road_km=road_km)
    world = shifted(local.elements.xyz)
    off = np.abs(world).max(axis=1) > ON_EARTH_M
    if off.any():
        name = local.elements.name[np.searchsorted(local.elements.first, off.argmax(), side="right") - 1]
        raise EgolocError(f"{path}: {name}: expected coordinates within {ON_EARTH_M / 1e3:.0f} km, got {world[off][0]}")
    if reference is None:
        refuse_frame(str(path), frame)
        target, xyz = LOCAL, world
    else:
        target, xyz = placed(str(path), reference.llh(world), frame, reference.zone)
        if len(world) and frame is None and reference.zone and abs(reference.zone) != target.zone:
            reason = f"zones: the georeference names {abs(reference.zone)}, the coordinates lie in {target.zone}"
            builder.leave_out(f"{reason}, where they are placed (are they local ones?)")
    return replace(local, frame=target, elements=replace(local.elements, xyz=xyz)), builder.left_out


def _shift(offset: Element | None) -> Callable[[Floats], Floats]:
    """The header's offset: turned about the origin first, then moved."""
    if offset is None:
        return lambda xyz: xyz
    x, y, z, heading = (number(offset, key, 0.0) for key in ("x", "y", "z", "hdg"))
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return lambda xyz: xyz @ turn.T + (x, y, z)
