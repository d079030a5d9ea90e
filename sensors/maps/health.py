"""Health of a vector map: what in its geometry and topology cannot be, or is hardly meant. Nothing is mended.

``health_shapes`` looks at each element for itself, ``health_neighbours`` at elements beside each other.
"""

from collections.abc import Iterator
from enum import Enum
from typing import NamedTuple

from sensors.maps.vector_map import VectorMap


class Check(Enum):
    """What is checked, and what a finding means."""

    ZERO_LENGTH = "all vertices are at one place"
    REPEATED_VERTEX = "the same vertex twice in a row"
    SELF_INTERSECTION = "the line crosses or touches itself"
    TURNS_BACK = "the line turns back on itself"
    OPEN_RING = "an outline that is not closed, or has fewer than three corners"
    SIZE = "no such thing is so large, or so small"
    STEEP = "the height jumps along the line"
    LEANING = "the pole's top does not stand over its foot"
    DUPLICATE = "two elements of a kind at one place"
    COVERED = "all of the element lies on another of its kind"
    OFF_ROAD = "no lane line or road boundary is near"
    GAP = "two lines that go on in each other end a little apart"
    HEIGHT_STEP = "two lines meet at different heights"
    CROSSES_BOUNDARY = "paint runs through a road boundary"


ERRORS = frozenset(
    {
        Check.ZERO_LENGTH,
        Check.SELF_INTERSECTION,
        Check.OPEN_RING,
        Check.SIZE,
        Check.STEEP,
        Check.LEANING,
        Check.DUPLICATE,
        Check.OFF_ROAD,
    }
)
"""What is wrong wherever it is found. The others are worth a look: some maps mean them."""


class Finding(NamedTuple):
    """One thing found. rows: of the elements; x, y: m in the map's frame; detail: with numbers and units."""

    check: Check
    rows: tuple[int, ...]
    x: float
    y: float
    detail: str

    @property
    def is_error(self) -> bool:
        """Whether it is wrong for sure."""
        return self.check in ERRORS


def findings(vector_map: VectorMap) -> list[Finding]:
    """All findings of a map in memory, check by check, in the order of its elements."""
    return sorted(_all(vector_map), key=lambda each: (list(Check).index(each.check), each.rows))


def _all(vector_map: VectorMap) -> Iterator[Finding]:
    from sensors.maps.geometries import geometries
    from sensors.maps.health_neighbours import neighbour_findings
    from sensors.maps.health_shapes import shape_findings

    if len(vector_map.elements):
        shapes = geometries(vector_map.elements)
        yield from shape_findings(vector_map.elements, shapes)
        yield from neighbour_findings(vector_map.elements, shapes, vector_map.surfels)
