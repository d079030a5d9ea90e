"""Signals of an OpenDRIVE road: traffic lights and signs; stop lines, crossings and arrows drawn as signals.

What a signal is stands in its type by the country's catalogue; where that says nothing (-1) its name is taken.
"""

from collections.abc import Mapping
from xml.etree.ElementTree import Element

import numpy as np

from sensors.maps.builder import Builder
from sensors.maps.hardened_xml import number
from sensors.maps.opendrive_lanes import DRIVABLE, across
from sensors.maps.opendrive_place import Place, is_beyond, signal_place
from sensors.maps.opendrive_road import Road
from sensors.maps.vector_map import Floats, Kind, Style

GERMAN = {
    "293": (Kind.CROSSING, Style.ZEBRA),
    "294": (Kind.STOP_LINE, Style.SOLID),
    "341": (Kind.STOP_LINE, Style.DASHED),
    "297": (Kind.MARKING, Style.ARROW),
    "295": (Kind.MARKING, Style.SOLID),
    "296": (Kind.MARKING, Style.UNKNOWN),
    "298": (Kind.MARKING, Style.UNKNOWN),
    "299": (Kind.MARKING, Style.UNKNOWN),
}
"""Paint in the catalogue of Germany, which OpenDRIVE's own one includes; other numbers are upright signs."""
NAMED = (
    (("stopline", "stop_line", "stop line", "holdingline"), Kind.STOP_LINE, Style.SOLID),
    (("crosswalk", "crossing", "zebra"), Kind.CROSSING, Style.UNKNOWN),
    (("arrow",), Kind.MARKING, Style.ARROW),
    (("stencil", "roadmark", "sgrm"), Kind.MARKING, Style.UNKNOWN),
    (("pole", "lamp", "streetlight", "street_light", "street light"), Kind.POLE, Style.UNKNOWN),
    (("light", "signal"), Kind.SIGN, Style.LIGHT),
    (("sign",), Kind.SIGN, Style.UNKNOWN),
)
CROSSING_TYPE = "1000003"
STANDING_M = 1.5
"""A sign or light this tall that stands on the ground is drawn with its pole."""
OVERHANG_M = 0.5


def add_signals(road: Road, roads: Mapping[str, Road], builder: Builder) -> None:
    """Every signal of a road; what is none of the map's kinds is counted."""
    for signal in road.element.findall("signals/signal"):
        kind, style = signal_kind(signal)
        if kind is None:
            builder.leave_out("signals of unknown type")
            continue
        place, there, s, t = signal_place(signal, road, roads)
        if is_beyond(there, s):
            builder.leave_out("signals beyond the end of their road")
            continue
        name = f"road {road.id} signal {signal.get('id', '?')}"
        match kind:
            case Kind.STOP_LINE:
                builder.add(kind, _stop_line(signal, place, there, s, t), style, name=name)
            case Kind.CROSSING | Kind.MARKING:
                _add_paint(signal, place, (kind, style, name), builder)
            case Kind.POLE:
                builder.add(kind, place.upright(number(signal, "height", 0.0)), style, name=name)
            case _:
                _add_upright(signal, place, style, name, builder)
    references = len(road.element.findall("signals/signalReference"))
    if references:
        builder.leave_out("references to signals of other roads: the signal is taken once, where it stands", references)


def signal_kind(signal: Element) -> tuple[Kind | None, Style]:
    """What a signal is; None: neither its type nor its name tells."""
    code, name = signal.get("type", "-1"), signal.get("name", "").lower()
    if signal.get("dynamic") == "yes":
        return Kind.SIGN, Style.LIGHT
    if signal.get("country", "").lower() in {"opendrive", "de", "deu", "germany", ""}:
        if code == CROSSING_TYPE:
            return Kind.CROSSING, Style.UNKNOWN
        if code in GERMAN:
            return GERMAN[code]
    if code not in {"-1", "none", ""}:
        return Kind.SIGN, Style.LIGHT if code.startswith("10000") else Style.UNKNOWN
    named = (row for row in NAMED if any(word in name for word in row[0]))
    return next(((kind, style) for _, kind, style in named), (None, Style.UNKNOWN))


def _add_upright(signal: Element, place: Place, style: Style, name: str, builder: Builder) -> None:
    """A sign's face; of one drawn with its pole the pole, and the sign as a point at its top."""
    width, height = number(signal, "width", 0.0), number(signal, "height", 0.0)
    if height >= STANDING_M and number(signal, "zOffset", 0.0) < OVERHANG_M:
        builder.add(Kind.POLE, place.upright(height), name=f"{name} pole")
        builder.add(Kind.SIGN, place.around(0.0, 0.0, [height]), style, name=name)
    elif width > 0.0 and height > 0.0:
        builder.add(Kind.SIGN, place.face(width, height), style, name=name)
    else:
        builder.add(Kind.SIGN, place.around(0.0, 0.0, [0.5 * max(height, 0.0)]), style, name=name)


def _add_paint(signal: Element, place: Place, what: tuple[Kind, Style, str], builder: Builder) -> None:
    """A crossing or a marking on the road: a box, its width across; its length is often the signal's value."""
    kind, style, name = what
    width = number(signal, "width", 0.0)
    length = number(signal, "length", 0.0) or (number(signal, "value", 0.0) if kind == Kind.CROSSING else 0.0)
    if width > 0.0 and length > 0.0:
        builder.add(kind, place.box(length, width), style, name=name)
    elif kind == Kind.MARKING:
        builder.add(kind, place.around(0.0, 0.0, [0.0]), style, name=name)
    else:
        builder.leave_out("crossings without a size")


def _stop_line(signal: Element, place: Place, road: Road, s: float, t: float) -> Floats:
    """(2, 3) the line: as drawn where that lies on the driving lanes for which it is valid, else across all of these.

    Drawing tools put the line's place in its middle or at its end, so the width alone does not tell.
    """
    width = number(signal, "width", 0.0)
    lanes = _valid_lanes(signal, road, s)
    if len(lanes) and not lanes.min() - OVERHANG_M <= t - 0.5 * width < t + 0.5 * width <= lanes.max() + OVERHANG_M:
        ends = np.array([lanes.max(), lanes.min()])
        return road.surface.points(np.full(2, s), ends, np.full(2, number(signal, "zOffset", 0.0)))
    return place.around(0.0, 0.5 * width * np.array([1.0, -1.0]), 0.0)


def _valid_lanes(signal: Element, road: Road, s: float) -> Floats:
    """(2 k,) t of the borders of the k driving lanes for which a signal is valid."""
    section = next((part for part in road.sections if part.start <= s <= part.end), None)
    if section is None:
        return np.empty(0)
    valid = [(number(e, "fromLane"), number(e, "toLane")) for e in signal.findall("validity")]
    side = {"+": -1, "-": 1}.get(signal.get("orientation", "none"), 0) * (1 if road.right_hand else -1)
    borders = [
        (float(inner[0]), float(outer[0]))
        for lane, inner, outer in across(section, np.array([s]))
        if lane.type in DRIVABLE
        and (not valid or any(min(ends) <= lane.id <= max(ends) for ends in valid))
        and (not side or side * lane.id > 0)
    ]
    return np.array(borders).ravel()
