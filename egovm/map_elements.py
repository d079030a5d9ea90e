"""The map around an initial pose as the network takes it: short segments, points with a height, and surfels."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovm.batch import SURFEL, MapElements
from egovm.config import MatchingConfig, NetworkConfig
from egovm.polylines import LINES, line_pieces
from egovm.projection import on_plane, plane_height
from sensors.errors import EgolocError
from sensors.maps.vector_map import Elements, Kind, Style, Surfels

Floats = NDArray[np.float64]

log = logging.getLogger(__name__)

_SHORTEST_M = 0.05
"""Shorter rests of segments that the edge of the BEV cuts off are dropped, m."""
_LEVEL = 0.9
"""Cosine of the tilt up to which a surfel counts as ground: it says nothing of x, y and yaw."""
_COLUMNS = ("type", "ends", "height", "normal", "ratios")


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """K pieces of map, nearest first, in body axes at an initial pose; the columns of ``MapElements`` without B.

    type: (K,) int64; ends: (K, 2, 3), height: (K,), normal: (K, 3), ratios: (K, 2) float32; left_out: how many more
    there were than the network takes.
    """

    type: NDArray[np.int64]
    ends: NDArray[np.float32]
    height: NDArray[np.float32]
    normal: NDArray[np.float32]
    ratios: NDArray[np.float32]
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.type)

    def chosen(self, rows: NDArray[Any], left_out: int = 0) -> Self:
        """The pieces of these rows (indices or a mask)."""
        columns = self.type[rows], self.ends[rows], self.height[rows], self.normal[rows], self.ratios[rows]
        return type(self)(*columns, left_out)


def pieces_around(
    elements: Elements, surfels: Surfels, T_map_body: Floats, config: NetworkConfig, ground_m: float
) -> Pieces:
    """The pieces near an initial pose (4, 4), nearest first by their middles, as many as the network takes.

    elements, surfels: what ``MapFile.around`` gives; ground_m: height of the ground under the vehicle in body axes, m.
    Segments are cut off, points and surfels dropped, where a candidate pose would see them beyond the BEV
    (``usable_half_m``). Raises EgolocError for a pose that is not upright.
    """
    half, height_m = usable_half_m(config), plane_height(config.bev, ground_m)
    parts = [
        _segments(elements, T_map_body, config.matching, height_m, half),
        _points(elements, T_map_body, height_m, half),
    ]
    if config.ablation.surfels:
        parts.append(_surfels(surfels, T_map_body, height_m, half))
    return _nearest(_joined(parts), config.matching)


def usable_half_m(config: NetworkConfig) -> float:
    """Half of the side of the square whose every place lies on the BEV for all candidates of the first level, m.

    The solver leaves out elements that some candidate does not see; so a long segment is cut off here instead.
    """
    bev, lattice = config.bev, config.solver.lattice
    yaw = math.radians(lattice.half_deg)
    half = (bev.half_m - bev.cell_m[0] / 2 - lattice.half_m) / (math.cos(yaw) + math.sin(yaw))
    if half <= 0.0:
        raise EgolocError(f"network: bev: half_m: expected more than the search range, got {bev.half_m:g}")
    return half - 1e-3  # float32


def padded(frames: Sequence[Pieces], count: int | None = None) -> MapElements:
    """Pieces of B frames (one or more) side by side, with a mask. count: K; None: of the longest frame, 1 at least."""
    longest = max(len(frame) for frame in frames)
    if count is not None and count < longest:
        raise ValueError(f"padded: expected at most {count} pieces in a frame, got {longest}")
    rows = max(longest, 1) if count is None else count
    valid = torch.arange(rows) < torch.tensor([len(frame) for frame in frames])[:, None]
    return MapElements(**{name: _stacked(frames, name, rows) for name in _COLUMNS}, valid=valid)


def places_of(elements: MapElements, config: MatchingConfig) -> Tensor:
    """(B, K, P, 2) m, where each piece is compared with the BEV: as ``sampled`` says."""
    ends = elements.ends[..., :2]
    if config.sampled == "middle":
        return ends.mean(2, keepdim=True)
    if config.sampled == "ends":
        return ends
    part = torch.linspace(0.0, 1.0, config.sampled, dtype=ends.dtype, device=ends.device)[:, None]
    return ends[:, :, :1] + part * (ends[:, :, 1:] - ends[:, :, :1])


def _stacked(frames: Sequence[Pieces], name: str, rows: int) -> Tensor:
    """(B, rows, ...) a column of all frames, 0 below its end."""
    columns = [getattr(frame, name) for frame in frames]
    stacked = np.zeros((len(frames), rows, *columns[0].shape[1:]), columns[0].dtype)
    for row, column in zip(stacked, columns, strict=True):
        row[: len(column)] = column
    return torch.from_numpy(stacked)


def _joined(parts: Sequence[Pieces]) -> Pieces:
    return Pieces(
        np.concatenate([part.type for part in parts]),
        np.concatenate([part.ends for part in parts]),
        np.concatenate([part.height for part in parts]),
        np.concatenate([part.normal for part in parts]),
        np.concatenate([part.ratios for part in parts]),
    )


def _made(
    type_: NDArray[np.integer],
    ends: Floats,
    z: Floats | None = None,
    height: Floats | None = None,
    normal: Floats | None = None,
    ratios: Floats | None = None,
) -> Pieces:
    """Pieces of ends (K, 2, 2); what is not given is 0."""
    count = len(ends)
    z = np.zeros(count) if z is None else z
    filled = np.concatenate((ends, np.broadcast_to(z[:, None, None], (count, 2, 1))), axis=2)
    return Pieces(
        type_.astype(np.int64),
        filled.astype(np.float32),
        np.zeros(count, np.float32) if height is None else height.astype(np.float32),
        np.zeros((count, 3), np.float32) if normal is None else normal.astype(np.float32),
        np.zeros((count, 2), np.float32) if ratios is None else ratios.astype(np.float32),
    )


def _segments(elements: Elements, T_map_body: Floats, config: MatchingConfig, height_m: float, half_m: float) -> Pieces:
    ends, kind = line_pieces(elements, config.segment_m)
    placed, kept = _clipped(on_plane(ends[..., :2], T_map_body, height_m), half_m)
    return _made(kind[kept], placed)


def _clipped(ends: Floats, half_m: float) -> tuple[Floats, NDArray[np.int64]]:
    """The parts (L, 2, 2) of segments (K, 2, 2) within a square, and their rows (L,)."""
    begin, way = ends[:, 0].T, (ends[:, 1] - ends[:, 0]).T
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    low, high = (-half_m - begin) / way, (half_m - begin) / way
    enter = np.minimum(low, high).max(axis=0).clip(min=0.0)
    leave = np.maximum(low, high).min(axis=0).clip(max=1.0)
    length = np.hypot(*way)
    kept = np.flatnonzero((leave - enter) * length > np.minimum(_SHORTEST_M, 0.999 * length))
    part = np.stack((enter, leave))[:, None, kept]
    return np.moveaxis(begin[:, kept] + part * way[:, kept], 2, 0), kept


def _points(elements: Elements, T_map_body: Floats, height_m: float, half_m: float) -> Pieces:
    """Poles at their feet, as high as they are; signs at their centres, as high as these are above the ground."""
    place, height, kind = standing(elements)
    xy = on_plane(place[:, :2], T_map_body, height_m)
    kept = (np.abs(xy) <= half_m).all(axis=1)
    xy, height, kind = xy[kept], height[kept], kind[kept]
    return _made(kind, _twice(xy), np.where(kind == Kind.SIGN, height, 0.0), height)


def standing(elements: Elements) -> tuple[Floats, Floats, NDArray[np.int8]]:
    """Places (N, 3) m of poles and signs in map axes, heights (N,) m, 0 where not known, and kinds (N,)."""
    rows = np.flatnonzero(np.isin(elements.kind, (Kind.POLE, Kind.SIGN)) & (elements.style != Style.VIRTUAL))
    first, last = elements.first[rows], elements.first[rows + 1] - 1
    pole = elements.kind[rows] == Kind.POLE
    foot, top = elements.xyz[first], elements.xyz[last]
    centre = _centres(elements.xyz, first, np.maximum(last - first, 1))  # a ring's first vertex comes again
    place = np.where(pole[:, None], foot, centre)
    height = np.where(pole, top[:, 2] - foot[:, 2], 0.0)
    height[~pole] = centre[~pole, 2] - _ground_below(elements, centre[~pole, :2])
    return place, np.nan_to_num(height), elements.kind[rows]


def _centres(xyz: Floats, first: NDArray[np.int64], counts: NDArray[np.int64]) -> Floats:
    """(N, 3) means of so many (N,) vertices from each first one (N,) on."""
    if not len(first):
        return np.empty((0, 3))
    begin = np.cumsum(counts) - counts
    rows = np.repeat(first - begin, counts) + np.arange(counts.sum())
    centres: Floats = np.add.reduceat(xyz[rows] - np.nan_to_num(xyz[0]), begin, axis=0) / counts[
        :, None
    ] + np.nan_to_num(xyz[0])
    return centres


def _ground_below(elements: Elements, xy: Floats) -> Floats:
    """(N,) height of the vertex of a line that is nearest to each place (N, 2); NaN where no line has heights."""
    ground = np.isin(elements.kind, LINES).repeat(np.diff(elements.first)) & np.isfinite(elements.xyz[:, 2])
    if not len(xy) or not ground.any():
        return np.full(len(xy), np.nan)
    known = elements.xyz[ground]
    x, y = (known[:, :2] - known[0, :2]).T.astype(np.float32)
    towards = (xy - known[0, :2]).astype(np.float32)
    squared = x * x + y * y - 2.0 * (towards @ np.stack((x, y)))  # less |xy|^2
    nearest: Floats = known[squared.argmin(axis=1), 2]
    return nearest


def _surfels(surfels: Surfels, T_map_body: Floats, height_m: float, half_m: float) -> Pieces:
    """Surfels of what stands, their normals in body axes, towards the vehicle: a map's only point upwards."""
    close = (np.abs(surfels.p - T_map_body[:2, 3]) < 1.5 * half_m).all(axis=1)
    near = np.flatnonzero(close & (np.abs(surfels.normal[:, 2]) < _LEVEL))
    xy = on_plane(surfels.p[near], T_map_body, height_m)
    inside = (np.abs(xy) <= half_m).all(axis=1)
    near, xy = near[inside], xy[inside]
    R, t = T_map_body[:3, :3], T_map_body[:3, 3]
    normal = surfels.normal[near] @ R
    away = (np.hypot(*normal[:, :2].T) > np.abs(normal[:, 2])) & ((normal[:, :2] * xy).sum(axis=1) > 0.0)
    normal = np.where(away[:, None], -normal, normal)
    above = np.column_stack((surfels.p[near], surfels.z[near])) - t
    z = np.nan_to_num(above @ R[:, 2] - height_m)
    return _made(np.full(len(near), SURFEL), _twice(xy), z, None, normal, surfels.ratios[near])


def _twice(xy: Floats) -> Floats:
    """(K, 2, 2): a point as a segment without length."""
    return np.repeat(xy[:, None], 2, axis=1)


def _nearest(pieces: Pieces, config: MatchingConfig) -> Pieces:
    """Nearest first; surfels, a hundred times as many, take no more than their share from the others."""
    middle = pieces.ends[..., :2].mean(axis=1)
    order = np.argsort(np.hypot(*middle.T), kind="stable")
    surfel = pieces.type[order] == SURFEL
    share = min(int(surfel.sum()), round(config.surfel_share * config.most_elements))
    others = min(int((~surfel).sum()), config.most_elements - share)
    allowed = np.where(surfel, np.cumsum(surfel) <= config.most_elements - others, np.cumsum(~surfel) <= others)
    left_out = len(pieces) - int(allowed.sum())
    if left_out:
        most = config.most_elements
        log.info("%d of %d pieces of map left out: most_elements is %d", left_out, len(pieces), most)
    return pieces.chosen(order[allowed], left_out)
