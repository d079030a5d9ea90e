"""Frames in the map: motion compensation, limits, what is left out, and a car that drives through."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sensors.datasets import argoverse2
from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.maps.accumulation import Reach, accumulation
from sensors.maps.ground_height import ground_height
from sensors.maps.surfels import SurfelConfig, surfels_in
from sensors.maps.voxels import Voxels
from sensors.records import Trajectory
from sensors.rotation import q_from_rpy
from tests.sensors.maps.street import GROUND_M, NOISE_M, T0, Street, around, block, frames

Floats = NDArray[np.float64]
STREET = block(3)
TRUTH = around(STREET, 0.3)


def off_surfaces(street: Street, xyz: Floats) -> Floats:
    """(N,) m from points in the map to the nearest surface of the street."""
    at = street.in_street(xyz)
    nearest = np.abs(at[:, 2] - GROUND_M)
    for low, high in street.boxes:
        outside = np.linalg.norm(np.maximum(np.maximum(low - at, at - high), 0.0), axis=1)
        inside = np.minimum(at - low, high - at).min(axis=1)
        nearest = np.minimum(nearest, np.where(outside > 0.0, outside, inside))
    return nearest


def turning() -> Trajectory:
    """2 s at 10 Hz: 10 m/s ahead, turning by 0.5 rad/s."""
    t = T0 + np.arange(21) * 100_000_000
    s = np.arange(21) * 0.1
    zero = np.zeros(21)
    return Trajectory(t, t, np.column_stack((10.0 * s, zero, zero)), q_from_rpy(zero, zero, 0.5 * s))


def frame(xyz: Floats, t_s: float, offset_s: float = 0.0, compensated: bool = False) -> Frame:
    offset = np.full(len(xyz), round(offset_s * 1e9), np.int32)
    stamp = T0 + round(t_s * 1e9)
    return Frame(stamp, stamp, (Sweep(xyz.astype(np.float32), offset_ns=offset, compensated=compensated),))


def test_points_of_a_moving_lidar_lie_on_the_surfaces() -> None:
    steps = accumulation(TRUTH)
    seen = list(frames(STREET, TRUTH, every_ns=700_000_000, azimuths=120))
    placed = list(steps.placed(seen))
    assert len(placed) == len(seen) > 3
    off = np.concatenate([off_surfaces(STREET, part.xyz) for part in placed])
    assert np.sqrt(np.mean(off**2)) < NOISE_M
    frozen = [replace(f, sweeps=tuple(replace(s, compensated=True) for s in f.sweeps)) for f in seen]
    off = np.concatenate([off_surfaces(STREET, part.xyz) for part in steps.placed(frozen)])
    assert np.sqrt(np.mean(off**2)) > 5 * NOISE_M


@pytest.mark.parametrize(
    ("offset_s", "compensated", "at_s"), [(0.0, False, 1.05), (0.125, False, 1.175), (0.125, True, 1.05)]
)
def test_a_point_is_placed_by_the_pose_of_its_own_moment(offset_s: float, compensated: bool, at_s: float) -> None:
    (placed,) = accumulation(turning()).placed([frame(np.array([[20.0, 5.0, 1.0]]), 1.05, offset_s, compensated)])
    c, s = np.cos(0.5 * at_s), np.sin(0.5 * at_s)
    np.testing.assert_allclose(placed.xyz, [[10 * at_s + 20 * c - 5 * s, 20 * s + 5 * c, 1.0]], atol=1e-6)
    np.testing.assert_allclose(placed.T_map_body[:3, 3], [10.5, 0.0, 0.0], atol=1e-9)


def test_the_reference_point_is_not_the_body() -> None:
    (placed,) = accumulation(turning(), arm=(2.0, 0.0, 0.5)).placed([frame(np.array([[20.0, 0.0, 0.0]]), 0.0)])
    np.testing.assert_allclose(placed.xyz, [[18.0, 0.0, -0.5]], atol=1e-6)


def test_range_and_vehicle_are_left_out() -> None:
    points = np.array([[1.0, 0.0, 0.0], [4.0, 0.0, 0.0], [6.0, 0.0, 0.0], [0.0, 30.0, 0.0], [0.0, 70.0, 0.0]])
    (placed,) = accumulation(turning(), reach=Reach(max_range_m=60.0)).placed([frame(points, 0.0)])
    np.testing.assert_allclose(placed.xyz, points[[2, 3]], atol=1e-6)


def test_frames_beside_the_trajectory_are_counted() -> None:
    far = np.array([[20.0, 0.0, 0.0]])
    gappy = turning()[np.r_[0:8, 14:21]]
    steps = accumulation(gappy)
    given = [frame(far, -0.1), frame(far, 0.2), frame(far, 1.0), frame(far, 1.95, 0.1), frame(0.1 * far, 0.3)]
    assert [part.frame_ns for part in steps.placed(given)] == [T0 + 200_000_000]
    assert steps.left_out == {
        "outside of the trajectory": 2,
        "in a gap of the trajectory": 1,
        "no points within reach": 1,
    }


def test_a_trajectory_without_attitude_is_refused() -> None:
    bare = turning()
    with pytest.raises(EgolocError, match="two or more poses with attitude, got 0 of 21"):
        accumulation(Trajectory(bare.t_ns, bare.t_ns, bare.p_map))


def test_a_car_that_drives_through_leaves_no_surfels() -> None:
    """A van meets the vehicle at 6 m/s in the other lane; parked ones stay."""
    straight = Street(
        np.array([[[-30.0, 8.0, GROUND_M], [60.0, 12.0, 6.0]], [[10.0, -5.0, GROUND_M], [15.0, -3.0, 1.6]]])
    )
    t = T0 + np.arange(0, 8_000_000_000, 20_000_000)
    s = 4.0 * (t - T0) * 1e-9
    zero = np.zeros(len(t))
    q = q_from_rpy(zero, zero, zero + straight.yaw)
    truth = Trajectory(t, t, straight.in_map(np.column_stack((s, zero, zero))), q)

    def van(t_s: float) -> Floats:
        return np.array([[[40.0 - 6.0 * t_s, 2.5, GROUND_M], [45.0 - 6.0 * t_s, 4.5, 1.8]]])

    voxels = Voxels(0.5, apart_s=1.0)
    for part in accumulation(truth).placed(frames(straight, truth, 200_000_000, moving=van, azimuths=180)):
        voxels.add(part.xyz, part.frame_ns)

    def on(least: int, low: tuple[float, float, float], high: tuple[float, float, float]) -> int:
        found = surfels_in(voxels, SurfelConfig(), least)
        place = straight.in_street(np.column_stack((found.p, found.z)))
        return int(((place >= low) & (place <= high)).all(axis=1).sum())

    lane, parked, wall = ((-10, 2, 0), (50, 5, 3)), ((9.5, -5.5, 0), (15.5, -2.5, 3)), ((-10, 7.5, 0), (50, 9, 6))
    assert on(1, *lane) > 12
    assert on(3, *lane) == 0
    assert on(3, *parked) >= 4
    assert on(3, *wall) > 25


def test_ground_surfels_of_a_real_log_agree_with_its_ground_height(data: Path) -> None:
    """Two sweeps of an Argoverse 2 log; its raster has steps of 6 cm at this height."""
    folder = next((data / "av2").glob("7fab2350*"))
    steps = accumulation(argoverse2.load(folder).reference)
    voxels = Voxels(0.5)
    for part in steps.placed(argoverse2.frames(folder)):
        voxels.add(part.xyz)
    assert not steps.left_out
    surfels = surfels_in(voxels, SurfelConfig())
    above = surfels.z - ground_height(folder / "map", surfels.p)
    road = (surfels.normal[:, 2] > 0.98) & (np.abs(above) < 0.5)
    assert road.sum() > 200
    assert abs(np.median(above[road])) < 0.05
    assert np.percentile(np.abs(above[road]), 90) < 0.1
