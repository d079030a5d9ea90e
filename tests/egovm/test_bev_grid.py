"""Which BEV index is which axis."""

import torch

from egovm.bev_grid import BevGrid
from egovm.config import BevConfig


def test_rows_run_forward_and_columns_left() -> None:
    grid = BevGrid(160, 0.5)
    cells = grid.cells_from_m(torch.tensor([[0.25, -0.25], [39.75, 39.75], [-39.75, 0.25], [10.25, -39.75]]))
    assert cells.tolist() == [[80.0, 79.0], [159.0, 159.0], [0.0, 80.0], [100.0, 0.0]]


def test_there_and_back() -> None:
    grid = BevGrid(32, 0.25)
    xy = torch.randn(20, 2, dtype=torch.float64)
    torch.testing.assert_close(grid.m_from_cells(grid.cells_from_m(xy)), xy)
    torch.testing.assert_close(grid.cells_from_m(grid.middles(xy)), grid.indices(xy))


def test_levels_cover_the_same_plane() -> None:
    grids = [BevGrid.of(BevConfig(), level) for level in range(3)]
    assert [grid.cells for grid in grids] == [160, 320, 640]
    assert [grid.half_m for grid in grids] == [40.0, 40.0, 40.0]
    for grid in grids:
        edge = grid.m_from_cells(torch.tensor([-0.5, grid.cells - 0.5]))
        assert edge.tolist() == [-40.0, 40.0]
