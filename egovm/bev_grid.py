"""The BEV plane's cells: the one place that says which index is which axis.

BEV maps are (B, C, H, W): rows along the vehicle's x (forward), columns along its y (left), both rising, the body's
origin in the middle of the map, where four cells meet. Places between cells are told in cells, a whole number being the
middle of a cell: row = x / cell + (rows - 1) / 2, and columns alike. The paper's Eq. S4 counts from the corner of the
map instead; half a cell lies between the two.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from egovm.config import BevConfig


@dataclass(frozen=True, slots=True)
class BevGrid:
    """A square of cells around the vehicle. cells: along a side; cell_m: side of a cell, m."""

    cells: int
    cell_m: float

    @classmethod
    def of(cls, config: BevConfig, level: int) -> "BevGrid":
        """The grid of a level."""
        return cls(config.cells(level), config.cell_m[level])

    @property
    def half_m(self) -> float:
        """From the middle to the edge, m."""
        return 0.5 * self.cells * self.cell_m

    def cells_from_m(self, xy: Tensor) -> Tensor:
        """Row and column (..., 2), in cells, of places (..., 2) m in body axes."""
        return xy / self.cell_m + 0.5 * (self.cells - 1)

    def m_from_cells(self, cells: Tensor) -> Tensor:
        """Places (..., 2) m in body axes of rows and columns (..., 2)."""
        return (cells - 0.5 * (self.cells - 1)) * self.cell_m

    def middles(self, like: Tensor) -> Tensor:
        """(H, W, 2) m, middles of all cells, in the type and on the device of another tensor."""
        return self.m_from_cells(self.indices(like))

    def indices(self, like: Tensor) -> Tensor:
        """(H, W, 2) row and column of all cells, in the type and on the device of another tensor."""
        steps = torch.arange(self.cells, dtype=like.dtype, device=like.device)
        return torch.stack(torch.meshgrid(steps, steps, indexing="ij"), -1)
