"""Lane borders of an OpenDRIVE road: its painted lines, and the edges between what is road and what is not."""

from collections.abc import Iterator
from functools import partial
from xml.etree.ElementTree import Element

import numpy as np

from sensors.maps.builder import Builder
from sensors.maps.hardened_xml import number
from sensors.maps.opendrive_road import Lane, Road, Section
from sensors.maps.road_geometry import PlanView
from sensors.maps.road_sampling import refined, simplified
from sensors.maps.vector_map import Colour, Floats, Kind, Style

NOT_ROAD = {"none", "sidewalk", "walking", "curb", "median"}
"""Types of lane that a car does not drive over; any other is road unless it is raised."""
DRIVABLE = {
    *("driving", "bidirectional", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane", "bus", "taxi"),
    *("HOV", "mwyEntry", "mwyExit", "special1", "special2", "special3", "shared"),
}
RAISED_M = 0.05
"""A lane whose outer edge is this high is a curb, not road."""
NARROW_M = 0.01

MARKS = {
    "solid": (Kind.LANE_LINE, Style.SOLID),
    "broken": (Kind.LANE_LINE, Style.DASHED),
    "solid solid": (Kind.LANE_LINE, Style.DOUBLE_SOLID),
    "broken broken": (Kind.LANE_LINE, Style.DOUBLE_DASHED),
    "solid broken": (Kind.LANE_LINE, Style.SOLID_DASHED),
    "broken solid": (Kind.LANE_LINE, Style.DASHED_SOLID),
    "botts dots": (Kind.LANE_LINE, Style.DOTS),
    "custom": (Kind.LANE_LINE, Style.UNKNOWN),
    "curb": (Kind.ROAD_BOUNDARY, Style.CURB),
    "edge": (Kind.ROAD_BOUNDARY, Style.ROAD_EDGE),
    "grass": (Kind.ROAD_BOUNDARY, Style.ROAD_EDGE),
}
MIRRORED = {Style.SOLID_DASHED: Style.DASHED_SOLID, Style.DASHED_SOLID: Style.SOLID_DASHED}
COLOURS = {
    "standard": Colour.WHITE,
    "white": Colour.WHITE,
    "yellow": Colour.YELLOW,
    "blue": Colour.BLUE,
    "red": Colour.RED,
    "green": Colour.GREEN,
}


def add_lanes(road: Road, builder: Builder) -> None:
    """Every painted line and every edge of a road, section by section."""
    for section in road.sections:
        lanes = (section.centre, *section.left, *section.right)
        s = refined(partial(_borders, road, section), _breaks(road, section))
        borders = _borders(road, section, s)
        for row, lane in enumerate(lanes):
            _add_marks(road, section, lane, s, borders[:, row], builder)
        for lane_id, style in _edges(road, section, s, builder):
            row = next(row for row, lane in enumerate(lanes) if lane.id == lane_id)
            name = f"road {road.id} lane {lane_id} s {section.start:.1f} edge"
            builder.add(Kind.ROAD_BOUNDARY, simplified(borders[:, row]), style, name=name)


def driving_length(road: Road) -> float:
    """Length of the sections with a lane for cars, m."""
    used = (sec for sec in road.sections if any(lane.type in DRIVABLE for lane in sec.left + sec.right))
    return sum(section.end - section.start for section in used)


def across(section: Section, s: Floats) -> Iterator[tuple[Lane, Floats, Floats]]:
    """Each lane's inner and outer border, t in m (n,) at s (n,): the left ones outwards, then the right ones."""
    centre = section.offset.at(s, section.end)
    for sign, lanes in ((1.0, section.left), (-1.0, section.right)):
        inner = centre
        for lane in lanes:
            if lane.border is not None:
                outer = lane.border.at(s, section.end)
            else:
                outer = inner + sign * np.maximum(lane.width.at(s, section.end), 0.0)
            yield lane, inner, outer
            inner = outer


def _borders(road: Road, section: Section, s: Floats) -> Floats:
    """(n, C, 3) outer borders at s (n,): of the centre lane, the left ones outwards, then the right ones."""
    surface = road.surface
    centre = surface.section(s, section.offset.at(s, section.end))
    sections, heights, previous, left = [centre], [np.zeros(len(s))], centre, True
    for lane, inner, outer in across(section, s):
        previous = centre if left and lane.id < 0 else previous
        left = lane.id > 0
        level = np.column_stack((outer - inner, np.zeros(len(s))))
        previous = previous + level if lane.level else surface.section(s, outer)
        sections.append(previous)
        heights.append(lane.height.at(s, section.end))
    lateral, lift = np.stack(sections, axis=1).transpose(2, 0, 1)
    return surface.placed(s, lateral, lift + np.column_stack(heights))


def _breaks(road: Road, section: Section) -> Floats:
    """Rising s of the section's ends and of all that changes between."""
    inner = [road.surface.breaks, section.offset.start]
    for lane in (section.centre, *section.left, *section.right):
        inner += [lane.width.start, lane.height.start, lane.border.start if lane.border else lane.width.start]
        inner.append(np.array([start for start, _ in lane.marks]))
    s = np.concatenate(inner)
    s = s[(s > section.start) & (s < section.end)]
    return np.unique(np.concatenate(([section.start], s, [section.end])))


def _add_marks(road: Road, section: Section, lane: Lane, s: Floats, border: Floats, builder: Builder) -> None:
    ends = (min(start, section.end) for start in [*(start for start, _ in lane.marks[1:]), section.end])
    for (start, mark), end in zip(lane.marks, ends, strict=False):  # without marks the section's end alone
        if mark.get("type", "none") == "none" or (start < end <= section.start):
            continue
        chosen = (s >= start) & (s <= end)
        if chosen.sum() < 2:
            builder.leave_out("road marks without length")
            continue
        kind, style, colour = _looks(mark, lane, builder)
        line = _shifted(mark, road.surface.plan, s[chosen], border[chosen])
        builder.add(kind, simplified(line), style, colour, f"road {road.id} lane {lane.id} s {start:.1f}")
        if mark.find("sway") is not None:
            builder.leave_out("sways of road marks: the line is taken straight")


def _looks(mark: Element, lane: Lane, builder: Builder) -> tuple[Kind, Style, Colour]:
    """Double lines are named from the middle of the road outwards, on the centre lane from left to right."""
    if mark.get("type", "") not in MARKS:
        builder.leave_out("types of road marks that are not known: the line is taken without style")
    if mark.get("color", "standard") not in COLOURS:
        builder.leave_out("colours that are not known: the line is taken without")
    kind, style = MARKS.get(mark.get("type", ""), (Kind.LANE_LINE, Style.UNKNOWN))
    style = MIRRORED.get(style, style) if lane.id > 0 else style
    colour = COLOURS.get(mark.get("color", "standard"), Colour.UNKNOWN)
    return kind, style, colour if kind == Kind.LANE_LINE else Colour.UNKNOWN


def _shifted(mark: Element, plan: PlanView, s: Floats, border: Floats) -> Floats:
    """The middle of a mark's lines, which may lie beside the border."""
    lines = mark.findall("type/line")
    offset = sum(number(line, "tOffset", 0.0) for line in lines) / max(len(lines), 1)
    if not offset:
        return border
    heading = plan.at(s)[:, 2]
    return border + offset * np.column_stack((-np.sin(heading), np.cos(heading), np.zeros(len(s))))


def _edges(road: Road, section: Section, s: Floats, builder: Builder) -> Iterator[tuple[int, Style]]:
    """The lane whose outer border is an edge of the road, and how that looks."""
    marked = {lane.id for lane in (section.centre, *section.left, *section.right) if _marks_edge(lane)}
    wide = [lane for lane, inner, outer in across(section, s) if np.abs(outer - inner).max() > NARROW_M]
    left, right = [lane for lane in wide if lane.id > 0], [lane for lane in wide if lane.id < 0]
    edges = [*_transitions(left), *_transitions(right)]
    first = [lanes[0] if lanes else None for lanes in (left, right)]
    if sum(lane is not None and _is_road(lane) for lane in first) == 1:
        edges.append((0, next((lane for lane in first if lane and not _is_road(lane)), None)))
    for lane_id, beyond in edges:
        if lane_id in marked:
            continue
        if beyond is None and road.junction:  # the asphalt of a junction goes on beside its connecting roads
            builder.leave_out("open sides of roads within junctions: no edge is there")
            continue
        raised = beyond is not None and (beyond.type == "curb" or _is_raised(beyond))
        yield lane_id, Style.CURB if raised else Style.ROAD_EDGE


def _transitions(lanes: list[Lane]) -> Iterator[tuple[int, Lane | None]]:
    """Edges on one side, from the middle outwards: the lane inside of each, and the lane that is no road if any."""
    for inner, outer in zip(lanes, [*lanes[1:], None], strict=False):
        beyond = outer is not None and _is_road(outer)
        if _is_road(inner) != beyond and (outer is not None or _is_road(inner)):
            yield inner.id, outer if _is_road(inner) else inner


def _is_road(lane: Lane) -> bool:
    return lane.type not in NOT_ROAD and not _is_raised(lane)


def _is_raised(lane: Lane) -> bool:
    return bool(len(lane.height.start) and lane.height.coefficients[:, 0].max() >= RAISED_M)


def _marks_edge(lane: Lane) -> bool:
    return any(MARKS.get(mark.get("type", ""), (None,))[0] == Kind.ROAD_BOUNDARY for _, mark in lane.marks)
