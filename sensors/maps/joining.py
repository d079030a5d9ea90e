"""Columns of several maps or tiles end to end, and several maps as one in which nothing stands twice."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.maps.quantized import cm_from_m
from sensors.maps.vector_map import NO_ELEMENTS, NO_SURFELS, Elements, Kind, Surfels, VectorMap
from sensors.records import LeftOut

_LINES = (Kind.LANE_LINE, Kind.ROAD_BOUNDARY)


def joined_elements(parts: Sequence[Elements]) -> Elements:
    """The elements of all parts, in their order."""
    parts = [part for part in parts if len(part)]
    if len(parts) < 2:
        return parts[0] if parts else NO_ELEMENTS
    counts = np.concatenate([np.diff(part.first) for part in parts])
    kind, style, colour, xyz, source, name = (
        np.concatenate([getattr(part, column) for part in parts])
        for column in ("kind", "style", "colour", "xyz", "source", "name")
    )
    return Elements(kind, style, colour, np.concatenate(([0], np.cumsum(counts))), xyz, source, name)


def joined_surfels(parts: Sequence[Surfels]) -> Surfels:
    """The surfels of all parts, in their order."""
    parts = [part for part in parts if len(part)]
    if len(parts) < 2:
        return parts[0] if parts else NO_SURFELS
    return Surfels(*(np.concatenate([getattr(part, column) for part in parts]) for column in Surfels.__slots__))


def joined_maps(maps: Sequence[VectorMap]) -> tuple[VectorMap, tuple[LeftOut, ...]]:
    """One map of N in the same frame, N >= 1, and how many elements an earlier one had to the centimetre.

    Where maps overlap (logs of one city carry its map around each), each element is taken from the first that has it.
    A map's road_km counts by the share of its lines that was taken. Raises EgolocError where frames differ.
    """
    frame = maps[0].frame
    seen: set[bytes] = set()
    parts: list[VectorMap] = []
    left_out: list[LeftOut] = []
    for each in maps:
        if each.frame != frame:
            raise EgolocError(f"{each.sources[0]}: expected the frame of {maps[0].sources[0]}: choose one with --frame")
        new = _unseen(each.elements, seen)
        if not new.all():
            left_out.append(LeftOut(each.sources[0], "elements that a source before it has too", int((~new).sum())))
        parts.append(_taken(each, new))
    first = np.cumsum([0, *(len(part.sources) for part in parts)])
    elements = [
        replace(part.elements, source=part.elements.source + np.int32(offset))
        for part, offset in zip(parts, first[:-1], strict=True)
    ]
    lengths = [part.road_km for part in parts]
    return VectorMap(
        frame,
        joined_elements(elements),
        joined_surfels([part.surfels for part in parts]),
        tuple(source for part in parts for source in part.sources),
        None if None in lengths else float(sum(filter(None, lengths))),
    ), tuple(left_out)


def is_same_grid(one: MapFrame, other: MapFrame) -> bool:
    """Whether coordinates of two frames differ by a shift at most: their UTM zone is one."""
    return one == other or (one.kind == other.kind == "utm" and (one.zone, one.south) == (other.zone, other.south))


def moved(vector_map: VectorMap, frame: MapFrame) -> VectorMap:
    """The map in a frame of the same UTM zone with another origin."""
    shift = np.subtract(vector_map.frame.origin, frame.origin)
    elements, surfels = vector_map.elements, vector_map.surfels
    return replace(
        vector_map,
        frame=frame,
        elements=replace(elements, xyz=elements.xyz + shift),
        surfels=replace(surfels, p=surfels.p + shift[:2], z=surfels.z + shift[2]),
    )


def _unseen(elements: Elements, seen: set[bytes]) -> NDArray[np.bool_]:
    """(N,) whether an element is none of those seen before; those of one map do not count against each other."""
    cm = cm_from_m(elements.xyz) + 0.0  # no -0.0
    keys = [
        bytes([kind]) + cm[a:b].tobytes()
        for kind, a, b in zip(elements.kind, elements.first[:-1], elements.first[1:], strict=True)
    ]
    new = np.array([key not in seen for key in keys], bool)
    seen.update(keys)
    return new


def _taken(vector_map: VectorMap, new: NDArray[np.bool_]) -> VectorMap:
    """The map with its new elements alone."""
    if new.all() or vector_map.road_km is None:
        return replace(vector_map, elements=vector_map.elements.chosen(new))
    lengths = lengths_m(vector_map.elements) * np.isin(vector_map.elements.kind, _LINES)
    share = float(lengths[new].sum() / max(lengths.sum(), 1e-9))
    return replace(vector_map, elements=vector_map.elements.chosen(new), road_km=vector_map.road_km * share)


def lengths_m(elements: Elements) -> NDArray[np.float64]:
    """(N,) length of each element in the plane, m."""
    step = np.zeros(len(elements.xyz))
    step[1:] = np.hypot(*np.diff(elements.xyz[:, :2], axis=0).T)
    step[elements.first[:-1]] = 0.0  # from the end of one element to the beginning of the next
    total: NDArray[np.float64] = np.add.reduceat(step, elements.first[:-1]) if len(elements) else np.zeros(0)
    return total
