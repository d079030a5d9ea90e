"""Rasters of the map against the distance to every segment, cell by cell."""

from itertools import pairwise

import numpy as np
import pytest

from egovm.config import BevConfig
from egovm.semantic_rasters import semantic_rasters
from sensors.maps.vector_map import NO_ELEMENTS, Elements, Kind, Style
from tests.egovm.made_map import made
from tests.egovm.test_projection import UTM, pose

BEV = BevConfig(half_m=8.0)


def some_map(seed: int) -> Elements:
    draw = np.random.default_rng(seed)
    lines = [(Kind(k), UTM + draw.uniform(-14.0, 14.0, (4, 3))) for k in (0, 1, 2, 0, 4)]
    ring = UTM + draw.uniform(-8.0, 8.0, (4, 3))
    points = [(Kind.POLE, UTM + draw.uniform(-5.0, 5.0, (2, 3))), (Kind.SIGN, UTM + draw.uniform(-5.0, 5.0, (1, 3)))]
    return made(*lines, (Kind.CROSSING, np.vstack((ring, ring[:1]))), *points)


def brute(elements: Elements, T: np.ndarray, level: int) -> np.ndarray:
    """(7, H, W) of a level vehicle, by the distance from each cell's middle to each edge."""
    cells, cell = BEV.cells(level), BEV.cell_m[level]
    x, y = (np.stack(np.meshgrid(*[np.arange(cells)] * 2, indexing="ij")) + 0.5) * cell - BEV.half_m
    raster = np.zeros((7, cells, cells), bool)
    for i, kind in enumerate(elements.kind):
        p = (elements.vertices(i) - T[:3, 3]) @ T[:3, :3]
        p = p[:1] if kind >= Kind.POLE else p
        radius = max(0.15, cell * (0.5**0.5 if kind >= Kind.POLE else 0.5))
        for a, b in pairwise(p if len(p) > 1 else p.repeat(2, axis=0)):
            d = b - a
            s = np.clip(((x - a[0]) * d[0] + (y - a[1]) * d[1]) / max(d[:2] @ d[:2], 1e-12), 0.0, 1.0)
            raster[kind] |= np.hypot(x - a[0] - s * d[0], y - a[1] - s * d[1]) <= radius
    return raster


@pytest.mark.parametrize("seed", range(4))
def test_they_equal_the_distance_to_every_segment(seed: int) -> None:
    elements, T = some_map(seed), pose(0.0, 0.0, 33.0 * seed)
    for level, raster in enumerate(semantic_rasters(elements, T, BEV, -1.8)):
        expected = brute(elements, T, level)
        assert raster.shape == expected.shape
        assert (raster != expected).sum() == 0
        assert expected.any(axis=(1, 2)).sum() >= 6


def test_a_line_is_a_third_of_a_metre_wide_and_never_broken() -> None:
    rasters = semantic_rasters(made((Kind.LANE_LINE, [(-20, 1.06), (20, 1.06)])), np.eye(4), BEV, 0.0)
    widths = [raster[Kind.LANE_LINE].sum(axis=1) for raster in rasters]
    assert [(w.min(), w.max()) for w in widths] == [
        (1, 1),
        (1, 1),
        (3, 3),
    ]  # around cell 17.62 by 0.5, 35.74 by 0.6, 71.98 by 1.2
    for angle in np.linspace(0.0, np.pi, 37):
        way = 20.0 * np.array((np.cos(angle), np.sin(angle)))
        for raster in semantic_rasters(made((Kind.LANE_LINE, [-way, way])), np.eye(4), BEV, 0.0):
            line = raster[Kind.LANE_LINE]
            assert line.any(axis=0 if abs(way[1]) > abs(way[0]) else 1).all()


def test_a_point_is_seen_wherever_it_stands_in_its_cell() -> None:
    for x, y in np.random.default_rng(3).uniform(-7.0, 7.0, (50, 2)):
        for raster in semantic_rasters(made((Kind.POLE, [(x, y, 0), (x, y, 5)])), np.eye(4), BEV, 0.0):
            assert 1 <= raster[Kind.POLE].sum() <= 9
            assert not raster[: Kind.POLE].any()


def test_rows_run_forward_and_columns_left() -> None:
    raster = semantic_rasters(made((Kind.POLE, [(6.3, -4.2)])), np.eye(4), BEV, 0.0)[2][Kind.POLE]
    rows, columns = np.nonzero(raster)
    assert rows.mean() == pytest.approx((6.3 + 8.0) / 0.125 - 0.5, abs=0.5)
    assert columns.mean() == pytest.approx((-4.2 + 8.0) / 0.125 - 0.5, abs=0.5)


def test_what_nothing_sees_is_not_drawn() -> None:
    unseen = made((Kind.LANE_LINE, [(0, 0), (5, 0)], Style.VIRTUAL), (Kind.ROAD_BOUNDARY, [(20, 0), (30, 0)]))
    assert not any(raster.any() for raster in semantic_rasters(unseen, np.eye(4), BEV, 0.0))
    assert not any(raster.any() for raster in semantic_rasters(NO_ELEMENTS, np.eye(4), BEV, 0.0))
