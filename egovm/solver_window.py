"""The window of dots: what one level of the pose solver knows of each point for every pose of its range.

Bilinear interpolation commutes with the dot product, so features need not be sampled at every candidate: a patch of
dots around the point is enough. Candidates of one yaw differ by whole cells and share their bilinear weights.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from egovm.config import LatticeConfig
from egovm.lattice import rotated, seen_from, yaws
from egovm.solver_dots import patch_dots
from egovm.solver_sums import can_sum, lattice_sums
from sensors.errors import EgolocError


@dataclass(frozen=True, slots=True)
class Window:
    """Dots around the points of K elements of B samples, and how to read them.

    dots: (B, K, P, G, S, S) of valid elements, 0 else; places: (B, K, P, 2) m in vehicle axes at the level's centre, 0
    where an element is not valid; corners: (B, K, P, 2) int64 row and column at which the patch begins; valid: (B, K)
    bool, elements that lie on the map for all candidates, whether or not a prior leaves them.
    """

    lattice: LatticeConfig
    level: int
    cells: tuple[int, int]
    """Rows and columns of the BEV map."""
    dots: Tensor
    places: Tensor
    corners: Tensor
    valid: Tensor


def dot_window(
    lattice: LatticeConfig,
    level: int,
    features: Tensor,
    embeddings: Tensor,
    places: Tensor,
    valid: Tensor,
    groups: int = 1,
) -> Window:
    """The window of one level.

    features: (B, C, H, W), rows along the vehicle's x, columns along its y, both rising, the vehicle in the middle, a
    cell as wide as the level's step; channels_last is read where it lies, anything else is copied. embeddings:
    (B, K, C); places: (B, K, P, 2) m, P points whose features are averaged; valid: (B, K) bool.
    """
    height, width = features.shape[-2:]
    size = window_cells(lattice, level, height, width)
    cells = _cells(lattice, level, places[:, :, :, None], yaws(lattice, level, places), (height, width))
    inside = _inside(cells.detach(), lattice.reach, (height, width))
    used = valid & inside.flatten(2).all(-1)
    places = torch.where(used[:, :, None, None], places, torch.zeros_like(places))
    corners = torch.floor(cells.detach().amin(3)).to(torch.int64) - lattice.reach
    last = torch.tensor((height - size, width - size), device=corners.device)
    corners = torch.minimum(corners.clamp(min=0), last)
    points = places.shape[2]
    embeddings = torch.where(used[:, :, None], embeddings, torch.zeros_like(embeddings))
    dots = patch_dots(
        features.permute(0, 2, 3, 1),
        embeddings.repeat_interleave(points, 1),
        corners.flatten(1, 2),
        used.repeat_interleave(points, 1),
        size,
        groups,
    )
    dots = torch.unflatten(dots, 1, places.shape[1:3])
    return Window(lattice, level, (height, width), dots, places, corners, used)


def window_cells(lattice: LatticeConfig, level: int, height: int, width: int) -> int:
    """Side S of a patch that holds all that candidates read of a point inside for all of them.

    Over the range of yaws a coordinate moves by at most that range times the other one, which is at most half of the
    map less the translations. Raises where the map is smaller than a patch.
    """
    half = (max(height, width) - 1) / 2 - lattice.reach
    moved = math.ceil(1.001 * max(half, 0.0) * 2.0 * lattice.reach * lattice.step_rad(level))
    size = lattice.steps + 1 + moved
    if min(height, width) < size:
        raise EgolocError(f"BEV map: expected at least {size} x {size} cells, got {height} x {width}")
    return size


def lattice_dots(window: Window) -> Tensor:
    """Dots (B, K, G, yaw, x, y) of each element at every candidate: the mean over its points."""
    patches, weights = _read(window)
    below, steps = window.lattice.steps, window.lattice.steps + 1
    patches = torch.unflatten(patches, -1, (steps, steps))
    blended = sum(
        weights[..., corner, None, None] * patches[..., i : i + below, j : j + below]
        for corner, (i, j) in enumerate(_CORNERS)
    )
    assert isinstance(blended, Tensor)
    return blended.mean(2).flip(-2, -1)


def summed_lattice_dots(window: Window) -> Tensor:
    """Sum (B, yaw, x, y) over the elements and groups of their dots: as ``lattice_dots``, but no element is kept."""
    local = _local(window)
    if can_sum(window.dots, local):
        flat = window.dots.flatten(1, 2), local.flatten(1, 2), _times(window).flatten(1, 2)
        summed: Tensor = lattice_sums(*flat, window.lattice.steps)
        return summed
    return gathered_lattice_dots(window)


def gathered_lattice_dots(window: Window) -> Tensor:
    """The same in plain torch: with gradients, and in exports."""
    patches, weights = _read(window)
    below, steps = window.lattice.steps, window.lattice.steps + 1
    patches = patches.sum(3).flatten(1, 2).transpose(1, 2)
    weights = weights[:, :, :, 0].flatten(1, 2).permute(0, 2, 3, 1) / window.places.shape[2]
    shared = torch.unflatten(weights @ patches, -1, (steps, steps))
    blended = sum(shared[:, :, corner, i : i + below, j : j + below] for corner, (i, j) in enumerate(_CORNERS))
    assert isinstance(blended, Tensor)
    return blended.flip(-2, -1)


def dots_at(window: Window, offsets: Tensor) -> Tensor:
    """Dots (B, M, K, G) of each element at any poses of the window: offsets (B, M, 3) from the level's centre.

    Beyond the window (``in_window``) a point is read at the edge of its patch.
    """
    size = window.dots.shape[-1]
    moved = seen_from(offsets[:, :, None, None], window.places[:, None])
    local = (_cell_of(moved, window.lattice.step_m(window.level), window.cells) - window.corners[:, None]).clamp(
        0.0, size - 1.0
    )
    base = torch.floor(local.detach()).clamp(max=size - 2.0)
    weights = _weights(local - base)
    row, column = base.to(torch.int64).unbind(-1)
    index = torch.stack([(row + i) * size + column + j for i, j in _CORNERS], -1)
    samples, poses, elements, points, _ = index.shape
    groups = window.dots.shape[3]
    index = index.permute(0, 2, 3, 1, 4).reshape(samples, elements, points, 1, poses * 4)
    read = window.dots.flatten(4).gather(4, index.expand(-1, -1, -1, groups, -1))
    read = torch.unflatten(read, -1, (poses, 4))
    return (read * weights.permute(0, 2, 3, 1, 4)[:, :, :, None]).sum(-1).mean(2).permute(0, 3, 1, 2)


def in_window(lattice: LatticeConfig, level: int, offsets: Tensor) -> Tensor:
    """(...) bool: offsets (..., 3) from a level's centre that lie within its candidates."""
    half = lattice.reach * torch.tensor(
        (lattice.step_m(level), lattice.step_m(level), lattice.step_rad(level)), dtype=offsets.dtype
    ).to(offsets.device)
    t = rotated(offsets[..., :2], -offsets[..., 2])
    return (torch.cat((t, offsets[..., 2:]), -1).abs() <= half * (1.0 + 1e-6)).all(-1)


_CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Row and column of the cells that a bilinear weight belongs to."""


def _weights(part: Tensor) -> Tensor:
    """(..., 4) bilinear weights in the order of _CORNERS. part: (..., 2) of a cell beyond the first of them."""
    row, column = part.unbind(-1)
    return torch.stack(((1 - row) * (1 - column), (1 - row) * column, row * (1 - column), row * column), -1)


def _cell_of(places: Tensor, cell_m: float, cells: tuple[int, int]) -> Tensor:
    """Row and column (..., 2), in cells, of places (..., 2) m; a whole number is the middle of a cell."""
    return places / cell_m + torch.tensor(
        ((cells[0] - 1) / 2, (cells[1] - 1) / 2), dtype=places.dtype, device=places.device
    )


def _cells(lattice: LatticeConfig, level: int, places: Tensor, yaw: Tensor, cells: tuple[int, int]) -> Tensor:
    """Row and column (..., yaw, 2) of places (..., 1, 2) m, seen under each yaw and not translated."""
    return _cell_of(rotated(places, -yaw), lattice.step_m(level), cells)


def _inside(cells: Tensor, reach: int, shape: tuple[int, int]) -> Tensor:
    """(B, K, P, yaw) bool: all translations read between middles of cells of the map."""
    rows, columns = cells.unbind(-1)
    return (rows >= reach) & (rows <= shape[0] - 1 - reach) & (columns >= reach) & (columns <= shape[1] - 1 - reach)


def _read(window: Window) -> tuple[Tensor, Tensor]:
    """For each yaw the cells that its translations read, and the weights of the four around a point.

    Patches (B, K, P, G, yaw, (steps + 1)^2) and weights (B, K, P, 1, yaw, 4). Translations run against the cells:
    the first row belongs to the largest t.
    """
    size, local = window.dots.shape[-1], _local(window)
    base = torch.floor(local.detach()).clamp(0.0, size - window.lattice.steps - 1.0)
    weights = _weights(local - base)
    steps = torch.arange(window.lattice.steps + 1, device=base.device)
    row, column = base.to(torch.int64).unbind(-1)
    index = (row * size + column)[..., None] + (steps[:, None] * size + steps).flatten()
    flat = index.flatten(3)[:, :, :, None].expand(-1, -1, -1, window.dots.shape[3], -1)
    patches = window.dots.flatten(4).gather(4, flat)
    return torch.unflatten(patches, -1, (local.shape[3], len(steps) ** 2)), weights[:, :, :, None]


def _times(window: Window) -> Tensor:
    """(B, K, P) what each point counts of its element; of points that all lie in one place the first stands for all."""
    places = window.places
    points = places.shape[2]
    together = (places == places[:, :, :1]).flatten(2).all(-1)[..., None]
    alone = torch.arange(points, device=places.device) == 0
    counted = torch.where(together, alone.to(places.dtype), torch.full_like(places[..., 0], 1.0 / points))
    return counted * window.valid[..., None]


def _local(window: Window) -> Tensor:
    """(B, K, P, yaw, 2) row and column in the patch of a point under each yaw, at the largest translation."""
    around = yaws(window.lattice, window.level, window.places)
    cells = _cells(window.lattice, window.level, window.places[:, :, :, None], around, window.cells)
    return cells - window.corners[:, :, :, None] - window.lattice.reach
