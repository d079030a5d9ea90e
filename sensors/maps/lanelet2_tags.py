"""What Lanelet2's and Autoware's tags are in a map: kinds and styles by type and subtype, and what is no element.

Source: Lanelet2's LinestringTagging, Autoware's format extension. Of ``solid_dashed`` and its reverse, the first word
is the left line: the page's table was once the other way round, and only this agrees with its lane changes.
"""

from sensors.maps.osm import Tags
from sensors.maps.vector_map import Colour, Kind, Style

LINES: dict[str, tuple[Kind, Style | None]] = {
    "line_thin": (Kind.LANE_LINE, None),
    "line_thick": (Kind.LANE_LINE, None),
    "bike_marking": (Kind.LANE_LINE, Style.DASHED),
    "virtual": (Kind.LANE_LINE, Style.VIRTUAL),
    "road_border": (Kind.ROAD_BOUNDARY, Style.ROAD_EDGE),
    "curbstone": (Kind.ROAD_BOUNDARY, Style.CURB),
    "guard_rail": (Kind.ROAD_BOUNDARY, Style.BARRIER),
    "wall": (Kind.ROAD_BOUNDARY, Style.BARRIER),
    "fence": (Kind.ROAD_BOUNDARY, Style.BARRIER),
    "jersey_barrier": (Kind.ROAD_BOUNDARY, Style.BARRIER),
    "stop_line": (Kind.STOP_LINE, None),
    "crosswalk_polygon": (Kind.CROSSING, Style.UNKNOWN),
    "pedestrian_marking": (Kind.MARKING, Style.UNKNOWN),
    "zebra_marking": (Kind.MARKING, Style.ZEBRA),
    "arrow": (Kind.MARKING, Style.ARROW),
    "symbol": (Kind.MARKING, Style.UNKNOWN),
    "zig-zag": (Kind.MARKING, Style.UNKNOWN),
    "keepout": (Kind.MARKING, Style.UNKNOWN),
    "hatched_road_markings": (Kind.MARKING, Style.UNKNOWN),
    "30": (Kind.MARKING, Style.UNKNOWN),
    "50": (Kind.MARKING, Style.UNKNOWN),
    "70": (Kind.MARKING, Style.UNKNOWN),
}
"""Ways that are lines or outlines. Style None: the subtype says it."""
FACES = {"traffic_sign": Style.UNKNOWN, "traffic_light": Style.LIGHT}
"""Ways that are the lower edge of a face, ``height`` high."""
STYLES: dict[str, Style] = {
    "": Style.UNKNOWN,
    "solid": Style.SOLID,
    "dashed": Style.DASHED,
    "solid_solid": Style.DOUBLE_SOLID,
    "dashed_dashed": Style.DOUBLE_DASHED,
    "solid_dashed": Style.SOLID_DASHED,
    "dashed_solid": Style.DASHED_SOLID,
}
NO_ELEMENT = {
    "rail": "tracks of a railway: the map has no kind for them",
    "gate": "gates: they move",
    "lift_gate": "gates: they move",
    "door": "gates: they move",
    "bump": "speed bumps: the map has no kind for them",
    "light_bulbs": "light bulbs: inside the face of their traffic light",
}
"""Types of ways that are known and left out."""
DRIVING = frozenset({"road", "highway", "play_street", "emergency_lane", "bus_lane", "exit"})
"""Subtypes of lanelets that are road."""
OF_CROSSING = frozenset({"pedestrian_marking", "zebra_marking", "virtual", ""})
"""Types of a crossing's sides that are nothing of their own: they are in its outline."""
DASH_ENDS = frozenset({"begin", "start", "end", "dot"})
"""Types of nodes that say where in a line its paint begins and ends."""


def style_of(tags: Tags, style: Style | None) -> Style | None:
    """Of a line; None where its subtype is not known here."""
    return STYLES.get(tags.get("subtype", "")) if style is None else style


def colour_of(tags: Tags) -> Colour | None:
    """Of paint; None where it is named and not known here."""
    name = tags.get("color", tags.get("colour", "unknown"))
    return Colour.__members__.get(name.upper())
