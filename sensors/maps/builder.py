"""What an importer collects: elements one by one, and what it left out and why."""

from collections import Counter

import numpy as np
from numpy.typing import ArrayLike

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.maps.vector_map import NO_SURFELS, Colour, Elements, Floats, Kind, Style, Surfels, VectorMap
from sensors.records import LeftOut


class Builder:
    """Elements in the order in which they are added."""

    def __init__(self, source: str) -> None:
        """source: file and format, for messages and provenance."""
        self.source = source
        self._codes: list[tuple[int, int, int]] = []
        self._xyz: list[Floats] = []
        self._names: list[str] = []
        self._left_out: Counter[str] = Counter()

    def add(
        self,
        kind: Kind,
        xyz: ArrayLike,
        style: Style = Style.UNKNOWN,
        colour: Colour = Colour.UNKNOWN,
        name: str = "",
    ) -> None:
        """Add an element with vertices (n, 2) or (n, 3), m in the map's frame; heights may be NaN.

        Raises EgolocError where x or y is not finite.
        """
        vertices = np.atleast_2d(np.asarray(xyz, np.float64))
        if vertices.shape[1] == 2:
            vertices = np.column_stack((vertices, np.full(len(vertices), np.nan)))
        if not np.isfinite(vertices[:, :2]).all():
            raise EgolocError(f"{self.source}: {name}: expected finite coordinates, got NaN or Inf")
        self._codes.append((kind, style, colour))
        self._xyz.append(vertices)
        self._names.append(name)

    def leave_out(self, reason: str, count: int = 1) -> None:
        """So many things of the source are not in the map. reason: what they are and why, as a user would say it."""
        self._left_out[reason] += count

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """What was left out, the most frequent first."""
        return tuple(LeftOut(self.source, reason, count) for reason, count in self._left_out.most_common())

    def built(self, frame: MapFrame, surfels: Surfels = NO_SURFELS, road_km: float | None = None) -> VectorMap:
        """The map of all that was added."""
        kind, style, colour = np.array(self._codes, np.int8).reshape(-1, 3).T
        first = np.cumsum([0, *(len(vertices) for vertices in self._xyz)])
        xyz = np.concatenate(self._xyz) if self._xyz else np.empty((0, 3))
        source = np.zeros(len(self._names), np.int32)
        elements = Elements(kind, style, colour, first, xyz, source, np.array(self._names, np.str_))
        return VectorMap(frame, elements, surfels, (self.source,), road_km)
