"""Poses at which a map is judged: along its own lines, or along a given drive.

Lines side by side are one road: a place beside an earlier one, along the same axis, is left out. The longest lines come
first, so that a road is followed along few of them; what is left is chained into ways.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, map_from_llh, rotation_map_enu
from sensors.kernel import kernel
from sensors.maps.map_file import MapFile
from sensors.maps.placing import LOCAL
from sensors.maps.vector_map import Elements, Floats, Kind
from sensors.maps.ways import chained
from sensors.records import Trajectory
from sensors.rotation import rotate, yaw_from_q

SPACING_M = 5.0
"""Between poses, m."""
APART_M = 12.0
"""Lines that are closer together than this, across, are of one road, m."""
AXIS_RAD = math.radians(30.0)
"""Lines whose directions differ by more than this are of two roads."""
STEP_M = 0.5
"""Of a drive only rows so far apart count: noise at a standstill is no way, m."""
BREAK_M = 50.0
"""A drive with a longer step goes on elsewhere, m."""
FAR_M = 100.0
"""A route that nowhere comes so near to what the map holds is of another place or in another frame, m."""


_LEADING = (Kind.LANE_LINE, Kind.ROAD_BOUNDARY)
"""Kinds that run along a road; the first of which there are any is followed."""


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """N poses in the order of driving. xy: (N, 2) m in the map's frame; heading: (N,) rad; way: (N,) int64, rising:
    what has the same number is driven without a break; spacing_m: length of road that each pose stands for.
    """

    xy: Floats
    heading: Floats
    way: NDArray[np.int64]
    spacing_m: float = SPACING_M

    def __len__(self) -> int:
        return len(self.way)

    @property
    def km(self) -> float:
        """Length of road that is judged."""
        return len(self) * self.spacing_m / 1e3


def route_of_map(opened: MapFile, spacing_m: float = SPACING_M) -> Route:
    """Along the lane lines of a map (those too that are not painted), else along its road boundaries.

    A pose every spacing_m; headings along the line: what its direction is says nothing of that of the traffic, but what
    a pose sees ahead it also sees behind. Nothing where the map has neither.
    """
    counts = opened.facts.counts
    kind = next((kind for kind in _LEADING if counts.get(kind.name.lower())), None)
    if kind is None:
        return Route(np.empty((0, 2)), np.empty(0), np.empty(0, np.int64), spacing_m)
    xy, heading, length, line = _places(opened, kind, spacing_m)
    rank = np.lexsort((np.arange(len(xy)), line, -length))
    kept = rank[_beside_none(xy[rank], heading[rank], line[rank], spacing_m)]
    order, turned, way = chained(xy[kept], heading[kept], line[kept], spacing_m)
    rows = kept[order]
    return Route(xy[rows], heading[rows] + np.where(turned, np.pi, 0.0), way, spacing_m)


def route_of_trajectory(
    trajectory: Trajectory, where: str, opened: MapFile, frame: MapFrame | None = None, spacing_m: float = SPACING_M
) -> Route:
    """A drive, a pose every spacing_m of way; headings of its attitude, else of its course.

    frame: of the trajectory; None: the map's own. where: what messages call the trajectory. Raises EgolocError
    where the frames cannot be converted, where the drive is too short, and where it is nowhere near the map.
    """
    xy, attitude = _in_map(trajectory, where, opened.frame, frame)
    rows = _moving(xy)
    step = np.hypot(*np.diff(xy[rows], axis=0).T)
    at = np.concatenate(([0.0], np.cumsum(step)))
    s = np.arange(0.5 * spacing_m, at[-1], spacing_m)
    after = np.searchsorted(at, s, side="right")
    s, after = s[step[after - 1] < BREAK_M], after[step[after - 1] < BREAK_M]
    if len(s) < 2:
        raise EgolocError(f"{where}: expected a route of {2 * spacing_m:g} m or more, got {at[-1]:.1f} m")
    place = _at(xy[rows], at, s)
    _refuse_far(place, where, opened)
    course = xy[rows[after]] - xy[rows[after - 1]]
    known = attitude[rows[np.where(at[after] - s < s - at[after - 1], after, after - 1)]]
    heading = np.where(np.isfinite(known), known, np.arctan2(course[:, 1], course[:, 0]))
    breaks = np.hypot(*np.diff(place, axis=0).T) > BREAK_M
    return Route(place, heading, np.concatenate(([0], np.cumsum(breaks))), spacing_m)


class _Places(NamedTuple):
    """Places along lines. xy: (N, 2) m; heading: (N,) rad; length: (N,) m of the line; line: (N,) its number."""

    xy: Floats
    heading: Floats
    length: Floats
    line: NDArray[np.int64]


def _places(opened: MapFile, kind: Kind, spacing_m: float) -> _Places:
    """Places along all lines of a kind, tile by tile."""
    parts, lines = [_Places(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0, np.int64))], 0
    for number, (x0, y0, x1, y1) in enumerate(opened.boxes.tolist()):
        # boxes of tiles overlap: a line belongs to the first that holds its first vertex
        found, _ = opened.around((x0 + x1) / 2, (y0 + y1) / 2, 0.5 * math.hypot(x1 - x0, y1 - y0))
        found = found.chosen((found.kind == kind) & (np.diff(found.first) > 1))
        found = found.chosen(_first_box(found, opened.boxes) == number)
        if len(found):
            places = _sampled(found, spacing_m)
            parts.append(places._replace(line=places.line + lines))
            lines += len(found)
    return _Places(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _first_box(lines: Elements, boxes: Floats) -> NDArray[np.intp]:
    """(N,) the first of the boxes (T, 4) that holds the first vertex of each line."""
    x, y = lines.xyz[lines.first[:-1], :2].T[:, :, None]
    inside = (x >= boxes[:, 0]) & (x <= boxes[:, 2]) & (y >= boxes[:, 1]) & (y <= boxes[:, 3])
    first: NDArray[np.intp] = np.argmax(inside, axis=1)
    return first


def _sampled(lines: Elements, spacing_m: float) -> _Places:
    """Places along lines, from half the spacing on; a line that is shorter has none."""
    xy = lines.xyz[:, :2]
    step = np.zeros(len(xy))
    step[1:] = np.hypot(*np.diff(xy, axis=0).T)
    step[lines.first[:-1]] = 1.0  # so that the end of a line and the beginning of the next are two places
    at = np.cumsum(step)
    begin, end = at[lines.first[:-1]], at[lines.first[1:] - 1]
    counts = np.floor((end - begin) / spacing_m + 0.5).astype(np.intp)
    line = np.repeat(np.arange(len(lines)), counts)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    s = np.minimum(begin[line] + (number + 0.5) * spacing_m, end[line])
    before, after = np.maximum(s - 1.0, begin[line]), np.minimum(s + 1.0, end[line])
    ahead = _at(xy, at, after) - _at(xy, at, before)
    return _Places(_at(xy, at, s), np.arctan2(ahead[:, 1], ahead[:, 0]), (end - begin)[line], line)


def _at(xy: Floats, at: Floats, s: Floats) -> Floats:
    return np.column_stack((np.interp(s, at, xy[:, 0]), np.interp(s, at, xy[:, 1])))


def _beside_none(xy: Floats, heading: Floats, line: NDArray[np.int64], spacing_m: float) -> NDArray[np.intp]:
    """Rows of places that are beside no earlier place of another line that is kept."""
    if not len(xy):
        return np.empty(0, np.intp)
    cell = np.floor((xy - xy.min(axis=0)) / APART_M).astype(np.int64)
    wide = int(cell[:, 0].max()) + 3
    codes, at = np.unique((cell[:, 1] + 1) * wide + cell[:, 0] + 1, return_inverse=True)
    kept = np.zeros(len(xy), np.bool_)
    _thin(xy, heading, line, codes, at, wide, 0.6 * spacing_m, np.full(len(codes), -1), np.full(len(xy), -1), kept)
    return np.flatnonzero(kept)


@kernel()
def _thin(xy, heading, line, codes, at, wide, near, last, before, kept):  # type: ignore[no-untyped-def]
    """Fill kept (N,). last: (cells,) the last place kept in each; before: (N,) the one kept before it in its cell."""
    for i in range(len(xy)):
        cos, sin = math.cos(heading[i]), math.sin(heading[i])
        free = True
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                code = codes[at[i]] + dy * wide + dx
                cell = np.searchsorted(codes, code)
                if not free or cell >= len(codes) or codes[cell] != code:
                    continue
                j = last[cell]
                while j >= 0 and free:
                    x, y = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
                    beside = abs(cos * x + sin * y) < near and abs(cos * y - sin * x) < APART_M
                    free = (
                        line[j] == line[i] or not beside or abs(math.sin(heading[j] - heading[i])) > math.sin(AXIS_RAD)
                    )
                    j = before[j]
        if free:
            kept[i] = True
            before[i] = last[at[i]]
            last[at[i]] = i


def _in_map(trajectory: Trajectory, where: str, frame: MapFrame, given: MapFrame | None) -> tuple[Floats, Floats]:
    """(N, 2) m and (N,) heading rad, NaN where there is no attitude, in the map's frame."""
    p, q = trajectory.p_map, trajectory.q_map_body
    nose = rotate(q, np.array([1.0, 0.0, 0.0]))
    if given is not None and given != frame:
        if LOCAL in {given, frame}:
            whose = "the map" if frame == LOCAL else "it"
            raise EgolocError(
                f"{where}: expected a route in the map's frame, {whose} is in a local one without a datum"
            )
        llh = llh_from_map(given, p)
        p = map_from_llh(frame, llh)
        turn = rotation_map_enu(frame, llh)[0] @ rotation_map_enu(given, llh)[0].transpose(0, 2, 1)
        nose = np.einsum("nij,nj->ni", turn, nose)
        return p[:, :2], np.arctan2(nose[:, 1], nose[:, 0])
    return p[:, :2], yaw_from_q(q)


def _moving(xy: Floats) -> NDArray[np.intp]:
    """Rows that are STEP_M or more from the one before: standing still adds none."""
    rows = [0] if len(xy) else []
    x, y = xy.T.tolist()
    for i in range(len(x)):
        if math.hypot(x[i] - x[rows[-1]], y[i] - y[rows[-1]]) >= STEP_M:
            rows.append(i)
    return np.array(rows, np.intp)


def _refuse_far(xy: Floats, where: str, opened: MapFile) -> None:
    """A route of which no pose is near a tile."""
    if not len(opened.boxes):
        raise EgolocError(f"{opened.path}: expected a map with something along {where}, it is empty")
    boxes = opened.boxes.T[:, None, :]
    x, y = xy.T[:, :, None]
    dx, dy = (
        np.maximum(np.maximum(boxes[0] - x, x - boxes[2]), 0.0),
        np.maximum(np.maximum(boxes[1] - y, y - boxes[3]), 0.0),
    )
    nearest = float(np.hypot(dx, dy).min())
    if nearest > FAR_M:
        raise EgolocError(
            f"{where}: expected a route in the frame of {opened.path}, it comes no nearer to the map than "
            f"{nearest / 1e3:,.1f} km"
        )
