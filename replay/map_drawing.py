"""What is drawn of a map, in a picture as in a recording: shapes by kind, and the pieces of its route."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.maps.columns import SURFEL
from sensors.maps.map_file import MapFile
from sensors.maps.route import Route
from sensors.maps.vector_map import Elements, Kind, Style, VectorMap

Floats = NDArray[np.float64]

KIND_COLOURS: Mapping[str, str] = {
    "lane_line": "#7d8590",
    "road_boundary": "#3d444d",
    "stop_line": "#b0309b",
    "crossing": "#6d4bd1",
    "marking": "#9aa34b",
    "pole": "#101418",
    "sign": "#0b7a5c",
    "surfel": "#c9c4b8",
}
MOST_ELEMENTS = 60_000
"""Of a larger map the route alone is drawn: its elements would be smaller than a pixel."""
MOST_SURFELS = 300_000
"""Of more, every so many is drawn."""
MOST_HELD = 3_000_000
"""Of a map with more surfels the route alone is drawn: decoded they take 64 bytes each."""


class Drawn(NamedTuple):
    """lines, points: kind -> (n, 2) vertices of each line, (N, 2) places; surfels: (K, 2); complete: all is there."""

    lines: Mapping[str, list[Floats]]
    points: Mapping[str, Floats]
    surfels: Floats
    complete: bool


def drawn_elements(opened: MapFile) -> Drawn:
    """The shapes of a map; nothing of one that is too large."""
    whole = shown(opened)
    if whole is None:
        return Drawn({}, {}, np.empty((0, 2)), complete=False)
    lines: dict[str, list[Floats]] = {}
    points: dict[str, Floats] = {}
    for kind, part in by_kind(whole.elements):
        if kind in (Kind.POLE, Kind.SIGN):
            points[kind.name.lower()] = part.xyz[part.first[:-1], :2]
        else:
            lines[kind.name.lower()] = np.split(part.xyz[:, :2], part.first[1:-1])
    return Drawn(lines, points, whole.surfels.p, complete=True)


def shown(opened: MapFile) -> VectorMap | None:
    """The map with as many surfels as can be told apart; None: it is too large."""
    counts = opened.facts.counts
    surfels = counts.get(SURFEL, 0)
    if sum(counts.values()) - surfels > MOST_ELEMENTS or surfels > MOST_HELD:
        return None
    whole = opened.whole()
    step = -(-max(surfels, 1) // MOST_SURFELS)
    return replace(whole, surfels=whole.surfels.chosen(np.arange(0, surfels, step)))


def by_kind(elements: Elements) -> Iterator[tuple[Kind, Elements]]:
    """The elements that somebody sees, kind by kind, kinds without any left out."""
    seen = elements.style != Style.VIRTUAL
    for kind in Kind:
        chosen = elements.chosen(seen & (elements.kind == kind))
        if len(chosen):
            yield kind, chosen


def pieces(route: Route) -> Floats:
    """(N, 2, 2) the piece of way that each pose stands for: half the spacing to both sides."""
    half = 0.55 * route.spacing_m * np.column_stack((np.cos(route.heading), np.sin(route.heading)))
    return np.stack((route.xy - half, route.xy + half), axis=1)


def round_length(most: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten that is no larger."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= most * (1.0 + 1e-9)))
