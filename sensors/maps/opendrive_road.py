"""An OpenDRIVE road's XML into plain records: reference line, profiles, lane sections."""

from collections.abc import Iterable
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np

from sensors.maps.builder import Builder
from sensors.maps.hardened_xml import mistake, number
from sensors.maps.road_geometry import MAX_TURN_RAD, PlanView, Shape
from sensors.maps.road_surface import CrossShape, Cubics, RoadSurface
from sensors.maps.vector_map import Floats

GAP_M, BROKEN_M = 0.05, 1.0
"""Between pieces of a reference line: a gap that is told, and one that makes it none."""
JUST_BEFORE_M = 1e-6
"""Of the end of a piece, where the next has not begun."""
SHORTEST_M = 1e-4
"""Pieces of a reference line below this come from rounding in exporters."""
LONGEST_M = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """A lane of a section. width, border (absolute t of its outer edge; None: by width), height of its outer edge: over
    the road's s, m; level: not turned by the superelevation; marks: those of its outer edge, each from its s on.
    """

    id: int
    type: str
    level: bool
    width: Cubics
    border: Cubics | None
    height: Cubics
    marks: tuple[tuple[float, Element], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A lane section from start to end, s in m: centre lane and its sides, from the middle outwards."""

    start: float
    end: float
    offset: Cubics
    centre: Lane
    left: tuple[Lane, ...]
    right: tuple[Lane, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """A road. junction: it connects roads within one; right_hand: traffic keeps to the right."""

    id: str
    element: Element
    surface: RoadSurface
    sections: tuple[Section, ...]
    junction: bool
    right_hand: bool


def read_road(road: Element, builder: Builder) -> Road | None:
    """A road's records; None, and counted, where it has no length. Raises EgolocError with the line of a mistake."""
    plan = _plan_view(road, builder)
    if plan is None:
        builder.leave_out("roads without length")
        return None
    if road.find("elevationProfile/elevation") is None:
        builder.leave_out("elevation profiles that are missing: those roads are at height 0, as the format says")
    surface = RoadSurface(
        plan,
        float(plan.s[-1] + plan.length[-1]),
        cubics(road.findall("elevationProfile/elevation")),
        cubics(road.findall("lateralProfile/superelevation")),
        cubics(e for e in road.findall("lateralProfile/crossfall") if e.get("side", "both") in {"left", "both"}),
        cubics(e for e in road.findall("lateralProfile/crossfall") if e.get("side", "both") in {"right", "both"}),
        _cross_shape(road),
    )
    sections = tuple(_sections(road, surface.length, builder))
    in_junction = road.get("junction", "-1") not in {"-1", ""}
    return Road(road.get("id", "?"), road, surface, sections, in_junction, road.get("rule", "RHT").upper() != "LHT")


def cubics(records: Iterable[Element], key: str = "s", origin: float = 0.0) -> Cubics:
    """Piecewise cubics of records with a, b, c, d and a start."""
    rows = [[origin + number(e, key, 0.0), *(number(e, name, 0.0) for name in "abcd")] for e in records]
    table = np.array(sorted(rows, key=lambda row: row[0])).reshape(-1, 5)
    return Cubics(table[:, 0], table[:, 1:])


def _plan_view(road: Element, builder: Builder) -> PlanView | None:
    rows, shapes = [], []
    for geometry in road.findall("planView/geometry"):
        placed = [number(geometry, key) for key in ("s", "x", "y", "hdg", "length")]
        if not 0.0 <= placed[4] <= LONGEST_M:
            raise mistake(geometry, f"length: expected 0..{LONGEST_M:.0f} m, got {placed[4]:g}")
        if placed[4] < SHORTEST_M:
            builder.leave_out("pieces of a reference line without length")
            continue
        shape, coefficients = _shape(geometry, placed[4])
        shapes.append(shape)
        rows.append(placed + coefficients + [0.0] * (8 - len(coefficients)))
    if not rows:
        return None
    table = np.array(rows)
    order = np.argsort(table[:, 0], kind="stable")
    columns = np.ascontiguousarray(table[order].T)
    s, x, y, heading, size = columns[:5]
    plan = PlanView(s, x, y, heading, size, np.array(shapes, np.int8)[order], columns[5:].T)
    _check_joints(road, plan, builder)
    return plan


def _check_joints(road: Element, plan: PlanView, builder: Builder) -> None:
    """Refuse a reference line in pieces; count small gaps, and a length that is not the line's."""
    if len(plan.s) > 1:
        apart = np.hypot(*(plan.at(plan.s[1:] - JUST_BEFORE_M)[:, :2] - np.column_stack((plan.x, plan.y))[1:]).T)
        worst = int(np.argmax(apart))
        if apart[worst] > BROKEN_M:
            where = f"planView: expected pieces that join, the one at s {plan.s[worst + 1]:g}"
            raise mistake(road, f"{where} begins {apart[worst]:.3g} m from the end of the one before")
        if (apart > GAP_M).any():
            builder.leave_out(
                f"gaps of up to {BROKEN_M:g} m between pieces of reference lines", int((apart > GAP_M).sum())
            )
    length = number(road, "length", float(plan.s[-1] + plan.length[-1]))
    if abs(length - plan.s[-1] - plan.length[-1]) > BROKEN_M:
        builder.leave_out("lengths of roads that differ from their reference lines': the lines' are taken")


def _shape(geometry: Element, length: float) -> tuple[Shape, list[float]]:
    shape = next((e for e in geometry if e.tag not in {"userData", "include", "dataQuality"}), None)
    if shape is None:
        raise mistake(geometry, "expected line, arc, spiral, poly3 or paramPoly3 in it, got nothing")
    match shape.tag:
        case "line":
            return Shape.CLOTHOID, []
        case "arc":
            return Shape.CLOTHOID, _curvatures(shape, ("curvature", "curvature"), length)
        case "spiral":
            return Shape.CLOTHOID, _curvatures(shape, ("curvStart", "curvEnd"), length)
        case "poly3":
            return Shape.CUBIC, [number(shape, key) for key in "abcd"]
        case "paramPoly3":
            return Shape.PARAMETRIC, _parametric(shape, length)
    raise mistake(shape, "expected line, arc, spiral, poly3 or paramPoly3")


def _curvatures(shape: Element, keys: tuple[str, str], length: float) -> list[float]:
    values = [number(shape, key) for key in keys]
    turn = max(map(abs, values)) * length
    if turn > MAX_TURN_RAD:
        raise mistake(shape, f"expected a curve that turns ten times at most, got {turn / (2 * np.pi):.0f}")
    return values


def _parametric(shape: Element, length: float) -> list[float]:
    """Coefficients for a parameter in metres, whatever its range in the file."""
    span = shape.get("pRange", "normalized")
    if span not in {"arcLength", "normalized"}:
        raise mistake(shape, f"pRange: expected arcLength or normalized, got {span[:40]!r}")
    scale = length if span == "normalized" else 1.0
    return [number(shape, f"{name}{axis}") / scale**power for axis in "UV" for power, name in enumerate("abcd")]


def _cross_shape(road: Element) -> CrossShape:
    groups: dict[float, list[Element]] = {}
    for shape in road.findall("lateralProfile/shape"):
        groups.setdefault(number(shape, "s"), []).append(shape)
    at = sorted(groups)
    return CrossShape(np.array(at), tuple(cubics(groups[s], "t") for s in at))


def _sections(road: Element, length: float, builder: Builder) -> Iterable[Section]:
    """Lane sections; one of a single side leaves the other side's lanes as they were."""
    elements = sorted(road.findall("lanes/laneSection"), key=lambda e: number(e, "s"))
    starts = [number(e, "s") for e in elements]
    offset = cubics(road.findall("lanes/laneOffset"))
    sides: dict[str, tuple[Lane, ...]] = {"left": (), "right": ()}
    for element, start, after in zip(elements, starts, [*starts[1:], length], strict=False):
        one_sided = element.get("singleSide", "false") in {"true", "1"}
        for side in sides:
            if not one_sided or element.find(side) is not None:
                sides[side] = _side(element, side, start, builder)
        end = min(after, length)
        if end - start < SHORTEST_M:
            builder.leave_out("lane sections without length")
            continue
        centre = _side(element, "center", start, builder)
        middle = centre[0] if centre else Lane(0, "none", False, Cubics(), None, Cubics(), ())
        yield Section(start, end, offset, middle, sides["left"], sides["right"])


def _side(section: Element, side: str, start: float, builder: Builder) -> tuple[Lane, ...]:
    lanes = [_lane(element, start, side, builder) for element in section.findall(f"{side}/lane")]
    return tuple(sorted(lanes, key=lambda lane: abs(lane.id)))


def _lane(element: Element, start: float, side: str, builder: Builder) -> Lane:
    number_of_lane = number(element, "id")
    sign = {"left": 1.0, "center": 0.0, "right": -1.0}[side]
    if number_of_lane % 1.0 or np.sign(number_of_lane) != sign:
        raise mistake(element, f"id: expected a whole number that fits <{side}>, got {element.get('id')!r}")
    widths, borders = element.findall("width"), element.findall("border")
    marks = [(start + number(mark, "sOffset", 0.0), mark) for mark in element.findall("roadMark")]
    if side != "center" and not widths and not borders:
        builder.leave_out("lane widths that are missing: those lanes are closed")
    return Lane(
        int(number_of_lane),
        element.get("type", "none"),
        element.get("level", "false") in {"true", "1"},
        cubics(widths, "sOffset", start),
        cubics(borders, "sOffset", start) if borders and not widths else None,
        _outer_heights(element, start),
        tuple(sorted(marks, key=lambda mark: mark[0])),
    )


def _outer_heights(lane: Element, start: float) -> Cubics:
    rows = sorted([start + number(e, "sOffset", 0.0), number(e, "outer", 0.0)] for e in lane.findall("height"))
    table: Floats = np.array(rows).reshape(-1, 2)
    return Cubics(table[:, 0], np.column_stack((table[:, 1], np.zeros((len(table), 3)))))
