"""Objects of an OpenDRIVE road: crossings, poles, barriers, paint and islands, by outline, box or repetition."""

from collections.abc import Iterator
from xml.etree.ElementTree import Element

import numpy as np

from sensors.maps.builder import Builder
from sensors.maps.hardened_xml import mistake, number
from sensors.maps.opendrive_place import Place, is_beyond, on_road
from sensors.maps.opendrive_road import Road
from sensors.maps.opendrive_signals import NAMED
from sensors.maps.road_sampling import refined, simplified
from sensors.maps.vector_map import Floats, Kind, Style

TYPES = {
    "crosswalk": (Kind.CROSSING, Style.UNKNOWN),
    "pole": (Kind.POLE, Style.UNKNOWN),
    "streetLamp": (Kind.POLE, Style.UNKNOWN),
    "barrier": (Kind.ROAD_BOUNDARY, Style.BARRIER),
    "railing": (Kind.ROAD_BOUNDARY, Style.BARRIER),
    "soundBarrier": (Kind.ROAD_BOUNDARY, Style.BARRIER),
    "trafficIsland": (Kind.ROAD_BOUNDARY, Style.CURB),
    "roadMark": (Kind.MARKING, Style.UNKNOWN),
}
UNTYPED = {"", "-1", "none"}
MOST_REPEATED = 100_000


def add_objects(road: Road, builder: Builder) -> None:
    """Every object of a road; what is none of the map's kinds is counted by its type."""
    for element in road.element.findall("objects/object"):
        kind, style = object_kind(element)
        if kind is None:
            builder.leave_out(f"objects of type {element.get('type', 'none')[:40]}: the map has no such kind")
            continue
        name = f"road {road.id} object {element.get('id', '?')}"
        for xyz in _shapes(road, element, kind, builder):
            builder.add(kind, xyz, style, name=name)
        if element.find("markings/marking") is not None:
            builder.leave_out("markings around objects")
    for tag in ("objectReference", "tunnel", "bridge"):
        count = len(road.element.findall(f"objects/{tag}"))
        if count:
            builder.leave_out(f"{tag} of a road: the map has no such kind", count)


def object_kind(element: Element) -> tuple[Kind | None, Style]:
    """What an object is by its type, a road mark's subtype, or its name where it has no type."""
    kind, words = element.get("type", "none"), f"{element.get('subtype', '')} {element.get('name', '')}".lower()
    if kind in TYPES and kind != "roadMark":
        found, style = TYPES[kind]
        return found, Style.ZEBRA if found == Kind.CROSSING and "zebra" in words else style
    if kind == "roadMark" and "signalline" in words:
        return Kind.STOP_LINE, Style.SOLID
    if kind == "roadMark" or kind in UNTYPED:
        named = (row for row in NAMED if any(word in words for word in row[0]))
        return next(((found, style) for _, found, style in named), TYPES.get(kind, (None, Style.UNKNOWN)))
    return None, Style.UNKNOWN


def _shapes(road: Road, element: Element, kind: Kind, builder: Builder) -> Iterator[Floats]:
    """Vertices of an object and of each of its repetitions."""
    outlines = [*element.findall("outline"), *element.findall("outlines/outline")]
    repeats = element.findall("repeat")
    if not repeats and is_beyond(road, number(element, "s")):
        builder.leave_out("objects beyond the end of their road")
    elif outlines and not repeats:
        yield from (_outline(road, element, outline) for outline in outlines)
    elif not repeats:
        turn = number(element, "hdg", 0.0)
        place = on_road(road, number(element, "s"), number(element, "t"), number(element, "zOffset", 0.0), turn)
        yield _simple(element, place, kind)
    for repeat in repeats:
        yield from _repeated(road, element, repeat, kind, builder)


def _outline(road: Road, element: Element, outline: Element) -> Floats:
    """(n, 3) corners along the road or around the object's own axes; a closed ring unless it says otherwise."""
    on_surface, local = outline.findall("cornerRoad"), outline.findall("cornerLocal")
    if on_surface:
        s, t, dz = (
            np.array([number(e, key, None if key != "dz" else 0.0) for e in on_surface]) for key in ("s", "t", "dz")
        )
        corners = road.surface.points(s, t, dz)
    elif local:
        turn = number(element, "hdg", 0.0)
        place = on_road(road, number(element, "s"), number(element, "t"), number(element, "zOffset", 0.0), turn)
        corners = place.around(
            *(np.array([number(e, key, None if key != "z" else 0.0) for e in local]) for key in "uvz")
        )
    else:
        raise mistake(outline, "expected cornerRoad or cornerLocal in it")
    if outline.get("closed", "true") in {"false", "0"} or np.array_equal(corners[0], corners[-1]):
        return corners
    return np.concatenate((corners, corners[:1]))


def _simple(element: Element, place: Place, kind: Kind) -> Floats:
    """An object without an outline: an upright, the long middle line of its box, or the box."""
    length, width = number(element, "length", 0.0), number(element, "width", 0.0)
    if kind in {Kind.POLE, Kind.SIGN}:
        return place.upright(number(element, "height", 0.0))[-1 if kind == Kind.SIGN else 0 :]
    if kind in {Kind.ROAD_BOUNDARY, Kind.STOP_LINE} and max(length, width) > 0.0:
        ahead = np.array([0.5, -0.5])
        return place.around(ahead * length, 0.0, 0.0) if length >= width else place.around(0.0, ahead * width, 0.0)
    return place.box(length, width) if length > 0.0 and width > 0.0 else place.around(0.0, 0.0, [0.0])


def _repeated(road: Road, element: Element, repeat: Element, kind: Kind, builder: Builder) -> Iterator[Floats]:
    """One object every so many metres, or without a distance one that runs along the road."""
    start, length, distance = (number(repeat, key) for key in ("s", "length", "distance"))
    t = np.array([number(repeat, "tStart"), number(repeat, "tEnd", number(repeat, "tStart"))])
    z = np.array([number(repeat, "zOffsetStart", 0.0), number(repeat, "zOffsetEnd", 0.0)])
    if length < 0.0 or distance < 0.0 or (distance > 0.0 and length / distance > MOST_REPEATED):
        raise mistake(
            repeat, f"expected at most {MOST_REPEATED} objects in length and distance, got {length:g}, {distance:g}"
        )
    if is_beyond(road, start) or is_beyond(road, start + length):
        builder.leave_out("repeated objects beyond the end of their road")
    elif distance > 0.0:
        for along in np.arange(0.0, length + 1e-6, distance):
            side, above = (float(np.interp(along, [0.0, max(length, 1e-9)], ends)) for ends in (t, z))
            yield _simple(element, on_road(road, start + along, side, above, number(element, "hdg", 0.0)), kind)
    elif kind == Kind.ROAD_BOUNDARY and length > 0.0:
        yield _along(road, start, length, t, z)
    else:
        builder.leave_out("objects that run along the road and are no barrier")


def _along(road: Road, start: float, length: float, t: Floats, z: Floats) -> Floats:
    """(n, 3) a line from start over length, its t and height linear between their two ends."""

    def curve(s: Floats) -> Floats:
        share = (s - start) / length
        return road.surface.points(s, t[0] + share * (t[1] - t[0]), z[0] + share * (z[1] - z[0]))[:, None]

    breaks = road.surface.breaks
    inner = breaks[(breaks > start) & (breaks < start + length)]
    s = refined(curve, np.unique(np.concatenate(([start], inner, [start + length]))))
    return simplified(curve(s)[:, 0])
