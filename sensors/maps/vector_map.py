"""A vector map as columns: lane lines, boundaries, stop lines, crossings, markings, poles, signs, and surfels.

Coordinates are those of the map's frame (``sensors.geodesy.MapFrame``), m. Everything is immutable; an importer
collects its elements with ``sensors.maps.builder``, and a file holds them tile by tile (``sensors.maps.store``).
"""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Annotated, Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame

Floats = NDArray[np.float64]
Codes = NDArray[np.int8]
Indices = NDArray[np.int64]
Kilometres = Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]
"""Of road in a file; a million is more than any country has in one map."""


class Kind(IntEnum):
    """What an element is, and what its vertices are."""

    LANE_LINE = 0
    """Painted line along a lane: a polyline."""
    ROAD_BOUNDARY = 1
    """Edge of the road, curb, barrier: a polyline."""
    STOP_LINE = 2
    """A polyline across the lane."""
    CROSSING = 3
    """Pedestrian crossing: the closed ring of its outline, first vertex repeated."""
    MARKING = 4
    """Any other paint (arrow, text, hatched area): a polyline, or a ring."""
    POLE = 5
    """Two vertices, its foot and its top; one where only its place is known."""
    SIGN = 6
    """Traffic sign or light: the closed ring of its face's corners; one vertex, the centre, where no more is known."""


class Style(IntEnum):
    """How an element looks, where that is known."""

    UNKNOWN = 0
    SOLID = 1
    DASHED = 2
    DOUBLE_SOLID = 3
    DOUBLE_DASHED = 4
    SOLID_DASHED = 5
    """Two lines, the left one solid."""
    DASHED_SOLID = 6
    CURB = 7
    BARRIER = 8
    """Guard rail, wall, fence."""
    ROAD_EDGE = 9
    """No step: the end of the asphalt."""
    DOTS = 10
    """Botts' dots."""
    ZEBRA = 11
    ARROW = 12
    LIGHT = 13
    """Of SIGN: a traffic light."""
    VIRTUAL = 14
    """Nothing that a sensor sees: it closes a lane."""


class Colour(IntEnum):
    """Colour of paint."""

    UNKNOWN = 0
    WHITE = 1
    YELLOW = 2
    BLUE = 3
    RED = 4
    GREEN = 5


_MOST = {"kind": int(max(Kind)), "style": int(max(Style)), "colour": int(max(Colour))}
"""Greatest code of a column. An Enum's max takes longer than the rest of a small tile's checks."""


def _column(record: Any, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Check a column's shape, and store it contiguous and read-only."""
    array = np.ascontiguousarray(getattr(record, name), dtype=dtype)
    if array.shape != shape:
        raise EgolocError(f"{type(record).__name__}.{name}: expected shape {shape}, got {array.shape}")
    array.flags.writeable = False
    object.__setattr__(record, name, array)
    return array


@dataclass(frozen=True, slots=True, eq=False)
class Elements:
    """N elements with M vertices in all.

    kind, style, colour: (N,) int8 Kind, Style, Colour; first: (N + 1,) int64, element i has the vertices
    first[i]..first[i + 1]; xyz: (M, 3) m in the map's frame, z NaN where the height is not known; source: (N,) int32
    into VectorMap.sources; name: (N,) what the source calls it, for messages and health checks.
    """

    kind: Codes
    style: Codes
    colour: Codes
    first: Indices
    xyz: Floats
    source: NDArray[np.int32]
    name: NDArray[np.str_]

    def __post_init__(self) -> None:
        count = len(self.kind)
        for column, most in _MOST.items():
            codes = _column(self, column, (count,), np.int8)
            if count and not (codes.min() >= 0 and codes.max() <= most):
                raise EgolocError(f"Elements.{column}: expected 0..{most}, got {codes.min()}..{codes.max()}")
        first = _column(self, "first", (count + 1,), np.int64)
        xyz = _column(self, "xyz", (int(first[-1]), 3), np.float64)
        if first[0] != 0 or (np.diff(first) < 1).any():
            raise EgolocError("Elements.first: expected to begin at 0 and to rise: an element has a vertex or more")
        if not np.isfinite(xyz[:, :2]).all() or np.isinf(xyz[:, 2]).any():
            vertex = np.argmax(~np.isfinite(xyz[:, :2]).all(axis=1) | np.isinf(xyz[:, 2]))
            row = int(np.searchsorted(first, vertex, side="right")) - 1
            raise EgolocError(f"Elements.xyz: expected finite x and y, got NaN or Inf in {self.name[row] or row}")
        _column(self, "source", (count,), np.int32)
        _column(self, "name", (count,), np.str_)

    def __len__(self) -> int:
        return len(self.kind)

    def chosen(self, rows: NDArray[Any]) -> Self:
        """The elements of these rows (indices or a mask)."""
        rows = np.arange(len(self))[rows]
        counts = np.diff(self.first)[rows]
        first = np.concatenate(([0], np.cumsum(counts)))
        vertices = np.repeat(self.first[:-1][rows] - first[:-1], counts) + np.arange(first[-1])
        codes = self.kind[rows], self.style[rows], self.colour[rows]
        return type(self)(*codes, first, self.xyz[vertices], self.source[rows], self.name[rows])

    def vertices(self, row: int) -> Floats:
        """(n, 3) vertices of one element."""
        return self.xyz[self.first[row] : self.first[row + 1]]


@dataclass(frozen=True, slots=True, eq=False)
class Surfels:
    """K planar patches (the paper's section 5).

    p: (K, 2) m; z: (K,) m, NaN where not known; normal: (K, 3) unit, z >= 0; ratios: (K, 2) lambda1/lambda2 and
    lambda1/lambda3 of the points' covariance, eigenvalues in rising order.
    """

    p: Floats
    z: Floats
    normal: Floats
    ratios: Floats

    def __post_init__(self) -> None:
        count = len(self.p)
        for column, shape in (("p", (count, 2)), ("normal", (count, 3)), ("ratios", (count, 2))):
            if not np.isfinite(_column(self, column, shape, np.float64)).all():
                raise EgolocError(f"Surfels.{column}: expected finite numbers, got NaN or Inf")
        _column(self, "z", (count,), np.float64)

    def __len__(self) -> int:
        return len(self.p)

    def chosen(self, rows: NDArray[Any]) -> Self:
        """The surfels of these rows (indices or a mask)."""
        return type(self)(self.p[rows], self.z[rows], self.normal[rows], self.ratios[rows])


NO_ELEMENTS = Elements(
    np.empty(0, np.int8),
    np.empty(0, np.int8),
    np.empty(0, np.int8),
    np.zeros(1, np.int64),
    np.empty((0, 3)),
    np.empty(0, np.int32),
    np.empty(0, np.str_),
)
NO_SURFELS = Surfels(np.empty((0, 2)), np.empty(0), np.empty((0, 3)), np.empty((0, 2)))


@dataclass(frozen=True, slots=True, eq=False)
class VectorMap:
    """A map in memory.

    sources: what its elements come from (file and format); road_km: length of road, None: unknown.
    """

    frame: MapFrame
    elements: Elements = field(default_factory=lambda: NO_ELEMENTS)
    surfels: Surfels = field(default_factory=lambda: NO_SURFELS)
    sources: tuple[str, ...] = ()
    road_km: float | None = None

    def __post_init__(self) -> None:
        used = self.elements.source
        if len(used) and not (used.min() >= 0 and used.max() < len(self.sources)):
            raise EgolocError(f"VectorMap.sources: expected more than {used.max()} of them, got {len(self.sources)}")
