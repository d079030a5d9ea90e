"""Drives along a given trajectory: the boreas drive and made ones, pauses, backwards, mistakes."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sensors.datasets.trajectory_file import read_trajectory
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map
from sensors.records import Trajectory
from sensors.rotation import q_from_rpy, rpy_from_q
from sensors.simulate.driver import Driver
from sensors.simulate.environment import Environment
from sensors.simulate.following import TrajectoryPlan, along, offsets
from sensors.simulate.planning import plan_drive
from tests.sensors.simulate.roads import START_LLH

Floats = NDArray[np.float64]
FRAME = MapFrame("utm", (5_000.0, 5_330_000.0, 0.0), 32)


def track(
    speed: Floats, yaw: Floats, climb: float = 0.0, rate_hz: float = 10.0, *, attitude: bool = False
) -> Trajectory:
    """Rows at a rate along a path of given speed and yaw (N,)."""
    step = np.column_stack((speed * np.cos(yaw), speed * np.sin(yaw), climb * np.abs(speed))) / 10.0
    p = np.array([686_000.0, 0.0, 500.0]) + np.cumsum(step, axis=0)
    t_ns = 1_700_000_000_000_000_000 + np.rint(np.arange(len(p)) * 1e8).astype(np.int64)
    return Trajectory(t_ns, t_ns, p, q_from_rpy(0.0 * yaw, 0.0 * yaw, yaw) if attitude else None)


def town(seconds: int = 300) -> tuple[Floats, Floats]:
    """Speed and yaw at 10 Hz of a drive that turns, and pauses for 20 s in every 60."""
    t = np.arange(seconds * 10) / 10.0
    speed = np.clip(12.0 * np.sin(np.pi * (t % 60.0) / 40.0), 0.0, 8.0) * (t % 60.0 < 40.0)
    return speed, np.cumsum(np.where(np.sin(t / 15.0) > 0.6, 0.25, 0.0) * speed / 80.0)


def test_a_made_track_is_followed_in_place_and_time() -> None:
    speed, yaw = town()
    given = track(speed, yaw, climb=0.03)
    followed = along(given, FRAME, Driver(), "town")
    motion = followed.truth.at(given.t_ns)
    off = offsets(motion.llh, llh_from_map(FRAME, given.p_map))
    assert np.linalg.norm(off, axis=1).max() < 0.3
    assert followed.duration_s == pytest.approx(299.9)
    assert followed.truth.start_ns == given.t_ns[0]
    # uphill: the nose points up
    fast = np.linalg.norm(motion.vel_enu, axis=1) > 5.0
    np.testing.assert_allclose(rpy_from_q(motion.q_enu_body[fast])[:, 1], -0.03, atol=0.01)


def test_pauses_stay_pauses() -> None:
    speed, yaw = town()
    given = track(speed, yaw)
    motion = along(given, FRAME, Driver(), "town").truth.at(given.t_ns)
    at_rest = np.linalg.norm(motion.vel_enu, axis=1) == 0.0
    t = np.arange(3000) / 10.0
    inside = (t % 60.0 > 42.0) & (t % 60.0 < 58.0)
    assert at_rest[inside].all()
    assert not at_rest[speed > 1.0].any()


def test_a_file_with_attitude_says_where_the_vehicle_drives_backwards() -> None:
    t = np.arange(600) / 10.0
    speed = np.where(t < 25.0, np.minimum(4.0, t), 0.0) - np.where(t > 35.0, np.minimum(2.0, t - 35.0), 0.0)
    given = track(speed, np.full(600, 0.7), attitude=True)
    truth = along(given, FRAME, Driver(), "back").truth
    motion = truth.at(given.t_ns)
    assert np.linalg.norm(offsets(motion.llh, llh_from_map(FRAME, given.p_map)), axis=1).max() < 0.3
    np.testing.assert_allclose(np.unwrap(rpy_from_q(motion.q_enu_body)[:, 2]), 0.7, atol=0.05)
    assert truth.forward_speed(given.t_ns)[-50:].max() < -1.9


def test_slow_rows_are_followed_as_well() -> None:
    speed, yaw = town()
    given = track(speed, yaw)[::10]
    motion = along(given, FRAME, Driver(), "1 Hz").truth.at(given.t_ns)
    assert np.linalg.norm(offsets(motion.llh, llh_from_map(FRAME, given.p_map)), axis=1).max() < 0.5


def test_what_no_vehicle_can_follow_is_refused() -> None:
    speed, yaw = town()
    given = track(speed, yaw)
    jump = np.where(np.arange(len(given))[:, None] > 1500, [0.0, 40.0, 0.0], 0.0)
    torn = Trajectory(given.t_ns, given.arrival_ns, given.p_map + jump)
    with pytest.raises(
        EgolocError, match=r"torn: expected a trajectory that a vehicle can follow within 0.5 m, .* off at 1[45]\d s"
    ):
        along(torn, FRAME, Driver(), "torn")


def write_csv(path: Path, given: Trajectory) -> Path:
    rows = [f"{t},{x:.4f},{y:.4f},{z:.4f}" for t, (x, y, z) in zip(given.t_ns, given.p_map, strict=True)]
    path.write_text("\n".join(("t_ns,x,y,z", *rows)) + "\n")
    return path


def test_a_drive_is_planned_along_a_file_in_map_coordinates(tmp_path: Path) -> None:
    speed, yaw = town(120)
    given = track(speed, yaw)
    at_origin = Trajectory(given.t_ns, given.t_ns, given.p_map - given.p_map[0])
    path = write_csv(tmp_path / "town.csv", at_origin)
    around = {"city": Environment(), "canyon": Environment()}
    plan = TrajectoryPlan(file=str(path), environment="canyon")
    truth, course, duration_s = plan_drive(plan, around, Driver(), START_LLH, 0, 1)
    assert duration_s == pytest.approx(119.9)
    assert course.names == ("canyon",)
    begin = truth.at(given.t_ns[:1]).llh
    assert np.linalg.norm(offsets(begin, np.array([START_LLH]))) < 0.3
    length = float(speed.sum() / 10.0)
    assert course.s[-1] - course.s[0] == pytest.approx(length, rel=0.02)
    part = plan_drive(plan, around, Driver(), START_LLH, 0, 1, length_km=0.1)
    end = part.truth.start_ns + round(part.duration_s * 1e9)
    gone = np.diff(part.course.place(np.array([part.truth.start_ns, end])))
    assert gone[0] == pytest.approx(100.0, abs=1.0)
    assert plan_drive(plan, around, Driver(), START_LLH, 0, 1, duration_s=30.0).duration_s == 30.0


def test_mistakes_name_the_file_and_the_environment(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "short.csv", track(np.ones(5), np.zeros(5)))
    with pytest.raises(EgolocError, match=r"short\.csv: expected a trajectory of at least 1 s, got 5 rows"):
        plan_drive(TrajectoryPlan(file=str(path)), {}, Driver(), START_LLH, 0, 1)
    with pytest.raises(EgolocError, match="environment: expected one of city, got 'forest'"):
        plan_drive(TrajectoryPlan(file=str(path), environment="forest"), {}, Driver(), START_LLH, 0, 1)


def test_the_boreas_drive_is_followed(data: Path) -> None:
    path = next((data / "boreas").glob("*_poses.csv"))
    given, frame = read_trajectory(path, None)
    assert frame is not None
    truth, course, duration_s = plan_drive(TrajectoryPlan(file=str(path)), {}, Driver(), START_LLH, 0, 1)
    assert duration_s == pytest.approx(1118.87, abs=0.1)
    assert course.s[-1] == pytest.approx(7942.0, abs=20.0)
    motion = truth.at(given.t_ns)
    wanted = llh_from_map(frame, given.p_map)
    off = np.linalg.norm(offsets(motion.llh, wanted), axis=1)
    assert off.max() < 0.15
    speed = np.linalg.norm(motion.vel_enu, axis=1)
    moved = np.linalg.norm(np.gradient(given.p_map, axis=0), axis=1) * 10.0
    paused = moved < 0.03
    assert 0.15 < np.mean(speed == 0.0) < paused.mean() + 0.02
    assert moved[speed == 0.0].max() < 0.05
