"""Map points onto the BEV plane against the paper's Eq. S1-S4 solved one by one, and what the plane's height does."""

import numpy as np
import pytest

from egovm.config import BevConfig
from egovm.projection import bev_cells, ground_under, on_plane, plane_height
from sensors.errors import EgolocError
from sensors.rotation import matrix_from_q, q_from_rpy

UTM = np.array((448_000.0, 5_411_000.0, 112.0))


def pose(roll: float, pitch: float, yaw: float, place: np.ndarray = UTM) -> np.ndarray:
    """(4, 4) of Euler angles, deg."""
    T = np.eye(4)
    T[:3, :3] = matrix_from_q(q_from_rpy(*np.radians((roll, pitch, yaw))))[0]
    T[:3, 3] = place
    return T


@pytest.mark.parametrize("height_m", [0.0, -1.85])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.0, 0.0, 137.0), (4.0, -3.0, -60.0), (-20.0, 25.0, 200.0)])
def test_it_solves_the_equations_of_the_supplement(angles: tuple[float, float, float], height_m: float) -> None:
    T = pose(*angles)
    R, t = T[:3, :3], T[:3, 3]
    n = R @ (0.0, 0.0, 1.0)
    for x, y in UTM[:2] + np.random.default_rng(1).uniform(-40.0, 40.0, (20, 2)):
        on = t + height_m * n  # a point of the plane, Eq. S1: n . (p - on) = 0
        z = (n @ on - n[0] * x - n[1] * y) / n[2]  # S2
        expected = R.T @ (np.array((x, y, z)) - t)  # S3
        assert expected[2] == pytest.approx(height_m, abs=1e-6)
        assert on_plane((x, y), T, height_m) == pytest.approx(expected[:2], abs=1e-8)


def test_paint_on_a_grade_stays_where_the_lidar_sees_it_on_the_ground_plane_only() -> None:
    up = np.degrees(np.arctan(0.05))
    T = pose(0.0, -up, 30.0)  # the nose points up the grade
    seen = np.array((10.0, 3.0, -1.85))  # paint, in body axes
    paint = (T[:3, :3] @ seen + T[:3, 3])[:2]
    assert on_plane(paint, T, -1.85) == pytest.approx(seen[:2], abs=1e-8)
    shift = on_plane(paint, T, 0.0) - seen[:2]
    assert shift == pytest.approx((0.05 * 1.85, 0.0), abs=1e-8)  # the paper's plane: 9 cm


def test_a_tenth_of_a_millimetre_survives_the_coordinates_of_utm() -> None:
    T = pose(0.0, 0.0, 90.0)
    moved = on_plane((UTM[0], UTM[1] + 1e-4), T, 0.0)
    assert moved == pytest.approx((1e-4, 0.0), abs=1e-8)


def test_cells_are_counted_from_their_middles() -> None:
    bev = BevConfig(half_m=8.0)
    assert bev_cells((-7.75, 7.75), bev, 0) == pytest.approx((0.0, 31.0))
    assert bev_cells((0.0, 0.25), bev, 1) == pytest.approx((31.5, 32.5))


def test_the_plane_is_the_ground_or_as_configured() -> None:
    assert plane_height(BevConfig(), -1.7) == -1.7
    assert plane_height(BevConfig(plane_height_m=0.0), -1.7) == 0.0


def test_a_vehicle_on_its_side_is_told() -> None:
    with pytest.raises(EgolocError, match=r"initial pose: expected a tilt under 60 deg, got 85 deg"):
        on_plane(UTM[:2], pose(85.0, 0.0, 0.0), 0.0)
    with pytest.raises(EgolocError, match=r"got nan deg"):
        on_plane(UTM[:2], np.full((4, 4), np.nan), 0.0)


def test_the_ground_is_the_commonest_height_near_the_vehicle() -> None:
    draw = np.random.default_rng(2)
    ground = np.column_stack((draw.uniform(-10.0, 10.0, (4000, 2)), draw.normal(-1.83, 0.02, 4000)))
    walls = np.column_stack((draw.uniform(4.0, 8.0, (3000, 2)), draw.uniform(-1.8, 6.0, 3000)))
    roof = np.column_stack((draw.uniform(-1.0, 1.0, (9000, 2)), np.full(9000, -0.3)))
    assert ground_under(np.vstack((ground, walls, roof)).astype(np.float32)) == pytest.approx(-1.83, abs=0.01)
    assert ground_under(roof) is None
    assert ground_under(np.empty((0, 3), np.float32)) is None
