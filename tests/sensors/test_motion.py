"""Motion between the moments of a frame: closed forms, and each kind against the other."""

import numpy as np
import pytest
from scipy.linalg import expm

from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.motion import ConstantVelocity, Standing, along, points_at, relative, span_of
from sensors.records import Trajectory
from sensors.rotation import q_from_rpy
from tests.sensors.pictures import image

T0 = 1_700_000_000_000_000_000


def circle(rate: float = 0.5, speed: float = 10.0, count: int = 400) -> Trajectory:
    """A level drive on a circle, far from the map's origin, a pose every 5 ms; the body heads along it."""
    t_ns = T0 + np.arange(count, dtype=np.int64) * 5_000_000
    angle = rate * (t_ns - T0) * 1e-9
    radius = speed / rate
    p = np.column_stack((radius * np.sin(angle), radius * (1.0 - np.cos(angle)), 0.0 * angle))
    return Trajectory(t_ns, t_ns, p + np.array([4e5, 5e6, 300.0]), q_from_rpy(0.0, 0.0, angle))


def test_constant_velocity_is_the_exponential_of_its_twist() -> None:
    motion = ConstantVelocity((9.0, -0.4, 0.2), (0.05, -0.1, 0.7))
    v, (a, b, c) = motion.velocity, motion.turn_rate
    twist = np.array([[0, -c, b, v[0]], [c, 0, -a, v[1]], [-b, a, 0, v[2]], [0, 0, 0, 0]])
    for ms in (-80, 0, 35):
        found = relative(motion, T0 + ms * 1_000_000, T0)
        np.testing.assert_allclose(found, expm(twist * ms * 1e-3), rtol=0, atol=1e-12)


def test_without_turning_it_goes_straight() -> None:
    at = ConstantVelocity((10.0, 0.0, 0.0)).carried(np.zeros((2, 3)), T0 + np.array([0, -50_000_000]), T0)
    np.testing.assert_allclose(at, [[0, 0, 0], [-0.5, 0, 0]], atol=1e-12)


def test_a_trajectory_agrees_with_the_velocity_that_it_has() -> None:
    """Between poses 5 ms apart the way is straight: on this circle that leaves 16 um."""
    rng = np.random.default_rng(1)
    places, when = rng.uniform(-50, 50, (200, 3)), T0 + rng.integers(10**9, 2 * 10**9 - 10**7, 200)
    to = T0 + 1_503_000_000
    found = along(circle()).carried(places, when, to)
    np.testing.assert_allclose(
        found, ConstantVelocity((10.0, 0.0, 0.0), (0.0, 0.0, 0.5)).carried(places, when, to), rtol=0, atol=1e-4
    )


def test_what_a_trajectory_covers() -> None:
    drive = circle()
    motion = along(drive)
    first, last = int(drive.t_ns[0]), int(drive.t_ns[-1])
    assert motion.covers(first, last)
    assert not motion.covers(first - 1, last)
    assert not motion.covers(first, last + 1)
    torn = along(drive[(drive.t_ns < T0 + 10**9) | (drive.t_ns > T0 + 15 * 10**8)])
    assert not torn.covers(T0 + 9 * 10**8, T0 + 16 * 10**8)
    assert torn.covers(T0, T0 + 9 * 10**8)
    with pytest.raises(EgolocError, match="expected two or more poses with attitude"):
        along(Trajectory(drive.t_ns, drive.t_ns, drive.p_map))


def test_points_are_moved_from_their_own_moment() -> None:
    """A wall post 10 m aside, seen five times while passing at 10 m/s, is one place; compensated points are at one."""
    offset = np.array([0, 25, 50, 75, 100]) * 1_000_000
    ahead = 20.0 - 10.0 * offset * 1e-9
    seen = np.column_stack((ahead, np.full(5, 10.0), np.zeros(5)))
    T = np.eye(4)
    T[:3, 3] = 1.0, 0.0, 1.5
    motion = ConstantVelocity((10.0, 0.0, 0.0))
    raw = Sweep(seen - T[:3, 3], T, offset)
    np.testing.assert_allclose(points_at(raw, T0, motion, T0 + 10**8), np.tile([19.0, 10.0, 0.0], (5, 1)), atol=1e-5)
    np.testing.assert_allclose(points_at(raw, T0, Standing(), T0 + 10**8), seen, atol=1e-5)
    brought = Sweep(np.tile([19.0, 10.0, -1.5], (5, 1)), T, offset, compensated=True)
    np.testing.assert_allclose(points_at(brought, T0, motion, T0 + 10**8), np.tile([19.0, 10, 0], (5, 1)), atol=1e-5)
    frame = Frame(T0, T0, (raw,), (image(T0 - 7),))
    assert span_of(frame) == (T0 - 7, T0 + 10**8)
    assert span_of(Frame(T0, T0, (brought,))) == (T0, T0)
