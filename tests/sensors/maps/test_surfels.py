"""Surfels: exact moments, the paper's filter, one a cell, any order and chunks, degenerate and bad input."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.maps.surfels import SurfelConfig, best_of_cells, surfels_of, upward
from sensors.maps.vector_map import Surfels
from sensors.maps.voxels import FIRST_ROOM, Voxels

Floats = NDArray[np.float64]


def patch(
    rng: np.random.Generator, centre: tuple[float, float, float], normal: tuple[float, float, float], noise: float
) -> Floats:
    """4,000 points on a plane of 6 x 6 m."""
    n = np.array(normal) / np.linalg.norm(normal)
    u = np.cross(n, (0.3, 0.5, 0.9))
    u /= np.linalg.norm(u)
    a, b = rng.uniform(-3.0, 3.0, (2, 4000, 1))
    points: Floats = np.array(centre) + a * u + b * np.cross(n, u) + noise * rng.normal(size=(4000, 1)) * n
    return points


def rows(surfels: Surfels) -> Floats:
    return np.column_stack((surfels.p, surfels.z, surfels.normal, surfels.ratios))


@pytest.mark.parametrize("normal", [(0.02, 0.03, 1.0), (0.8, 0.6, 0.0), (0.5, -0.4, 0.3)])
def test_normals_and_places_of_a_noisy_plane(normal: tuple[float, float, float]) -> None:
    centre = (512_345.25, 4_412_345.5, 112.0)
    surfels = surfels_of(patch(np.random.default_rng(1), centre, normal, 0.02))
    n = np.array(normal) / np.linalg.norm(normal)
    assert len(surfels) >= 9
    angle = np.degrees(np.arccos(np.clip(np.abs(surfels.normal @ n), 0.0, 1.0)))
    assert np.median(angle) < 0.8
    # ten points of 2 cm on a strip of 0.1 m, the least that counts: 3.6 deg
    assert angle.max() < 4.0
    away = (np.column_stack((surfels.p, surfels.z)) - centre) @ n
    assert np.sqrt(np.mean(away**2)) < 0.005
    assert abs(np.mean(away)) < 0.002
    assert (surfels.ratios[:, 0] <= 0.1).all()
    assert (surfels.ratios[:, 1] <= surfels.ratios[:, 0]).all()
    assert (surfels.normal[:, 2] >= 0.0).all()


def test_each_cell_of_the_ground_keeps_one() -> None:
    rng = np.random.default_rng(2)
    points = np.concatenate([patch(rng, (0.0, 0.0, z), (0.0, 0.1, 1.0), 0.02) for z in (0.0, 4.0)])
    surfels = surfels_of(points)
    cells = np.floor(surfels.p)
    assert len(np.unique(cells, axis=0)) == len(surfels) >= 20
    assert len(surfels_of(points, SurfelConfig(cell_m=2.0))) < len(surfels) / 2


def test_the_thinnest_of_a_cell_is_kept() -> None:
    up = np.tile((0.0, 0.0, 1.0), (3, 1))
    ratios = np.array([[0.05, 0.01], [0.02, 0.01], [0.09, 0.01]])
    given = Surfels(np.array([[0.2, 0.3], [0.9, 0.1], [-0.1, 0.3]]), np.array([1.0, 2.0, 3.0]), up, ratios)
    kept = best_of_cells(given, 1.0)
    assert kept.z.tolist() == [3.0, 2.0]


def test_moments_equal_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(0.0, 1.0, (500, 3)) * (0.99, 0.99, 0.2) + (700_000.0, 5_400_000.0, -3.0)
    voxels = Voxels(0.5)
    voxels.add(points)
    windows = voxels.windows(np.arange(len(voxels)), voxels.sighted(1), 2, 500)
    # the cube of 1 m around them, and the same half a metre lower
    assert windows.points.tolist() == [500.0, 500.0]
    np.testing.assert_allclose(np.sort(windows.middle[:, 2]), [-3.0, -2.5])
    np.testing.assert_allclose(windows.middle[:, :2], [[700_000.5, 5_400_000.5]] * 2)
    found = windows
    np.testing.assert_allclose(found.mean[0], points.mean(axis=0), rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(found.cov[0], np.cov(points.T, bias=True), rtol=0.0, atol=1e-9)


def test_order_and_chunks_change_only_the_rounding() -> None:
    rng = np.random.default_rng(4)
    points = np.concatenate([patch(rng, (30.0 * k, -12.0, 1.0), (0.1 * k, 1.0, 0.3), 0.02) for k in range(-3, 4)])
    whole = surfels_of(points)
    chunks = surfels_of(iter(np.array_split(rng.permutation(points), 13)))
    assert len(whole) > 60
    np.testing.assert_allclose(rows(chunks), rows(whole), rtol=0.0, atol=1e-9)


def test_a_cloud_that_outgrows_the_table() -> None:
    count = 3 * FIRST_ROOM
    points = np.column_stack((np.arange(count) * 1.0, np.zeros(count), np.zeros(count))) + 0.25
    voxels = Voxels(0.5)
    voxels.add(np.concatenate((points, points)))
    assert len(voxels) == count
    np.testing.assert_allclose(voxels.means(), points)


def test_clutter_and_lines_are_no_planes() -> None:
    rng = np.random.default_rng(5)
    ball = rng.uniform(-2.0, 2.0, (5000, 3))
    along = np.linspace(0.0, 20.0, 5000)
    ring = np.column_stack((along, 0.01 * along**2, np.zeros(5000))) + 0.002 * rng.normal(size=(5000, 3))
    assert len(surfels_of(ball)) == 0
    assert len(surfels_of(ring)) == 0


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        np.zeros((1, 3)),
        np.array([[0.0, 0.0, 0.0], [0.3, 0.3, 0.3]]),
        np.full((1000, 3), 7.3),
        np.linspace(0.0, 0.9, 100)[:, None] * (1.0, 0.5, 0.2),
    ],
    ids=["none", "one", "two", "the same", "on a line"],
)
def test_too_little_for_a_plane(points: Floats) -> None:
    assert len(surfels_of(points)) == 0


def test_an_exact_plane_has_ratio_zero() -> None:
    x, y = np.meshgrid(np.arange(0.05, 1.0, 0.1), np.arange(0.05, 1.0, 0.1))
    surfels = surfels_of(np.column_stack((x.ravel(), y.ravel(), np.full(100, 2.5))))
    assert len(surfels) == 1
    np.testing.assert_allclose(surfels.normal, [[0.0, 0.0, 1.0]], atol=1e-12)
    assert surfels.z[0] == pytest.approx(2.5, abs=1e-12)
    assert surfels.ratios.max() < 1e-9


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e12])
@pytest.mark.parametrize("row", [0, 7])
def test_points_that_are_none_are_refused(bad: float, row: int) -> None:
    points = np.zeros((9, 3))
    points[row, 1] = bad
    with pytest.raises(EgolocError, match="points: expected"):
        surfels_of(points)


def test_a_wrong_shape_is_refused() -> None:
    with pytest.raises(EgolocError, match=r"shape \(N, 3\), got \(5, 2\)"):
        surfels_of(np.zeros((5, 2)))


def test_points_of_two_places_on_the_earth_are_refused() -> None:
    with pytest.raises(EgolocError, match="one place on the earth"):
        surfels_of(np.array([[0.0, 0.0, 0.0], [9e6, 0.0, 0.0]]))


def test_normals_point_up() -> None:
    normals = np.array([[0.0, 0.6, -0.8], [-1.0, 0.0, 0.0], [0.6, -0.8, 0.0], [0.0, 0.0, 1.0]])
    assert upward(normals).tolist() == [[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]


def test_sightings_count_moments_apart() -> None:
    voxels = Voxels(0.5, apart_s=1.0)
    for t_s in (0.0, 0.4, 0.9, 1.0, 1.2, 2.5):
        voxels.add(np.full((3, 3), 0.1), round(t_s * 1e9))
    voxels.add(np.full((1, 3), 5.1), 10**10)
    assert voxels.sightings().tolist() == [3, 1]
    assert voxels.sighted(2).tolist() == [True, False]
