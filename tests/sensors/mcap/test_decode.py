"""What foreign messages become, and which rows are left out."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sensors.mcap.decode import DEFAULT_SIGMA, RADIUS_95, SIGMA_95
from sensors.mcap.io import read_log
from sensors.records import GnssFix, GnssStatus, LeftOut, Log
from tests.sensors.mcap.messages import COV, START_NS, gps, header, imu_messages, nav_sat, pose, stamp, twist

Save = Callable[..., Path]


def gnss_of(log: Log) -> GnssFix:
    assert log.gnss is not None
    return log.gnss


def test_nav_sat_fix(save: Save) -> None:
    small = (0.0004, 0, 0, 0, 0.0004, 0, 0, 0, 0.001)
    sent = [
        nav_sat(0, -1),
        nav_sat(1, 0),
        nav_sat(2, 1),
        nav_sat(3, 2),
        nav_sat(4, 2, small),
        nav_sat(5, -2),
        nav_sat(6, 9),
    ]
    log = read_log(save(sent))
    assert log.left_out == ()
    names = [GnssStatus(s).name for s in gnss_of(log).status]
    assert names == ["NONE", "SINGLE", "DGNSS", "FLOAT", "FIXED", "NONE", "SINGLE"]
    np.testing.assert_array_equal(gnss_of(log).llh[3], [np.radians(49.0), np.radians(8.0), 103.0])
    np.testing.assert_array_equal(gnss_of(log).cov_enu[0].ravel(), COV)
    assert np.isnan(gnss_of(log).yaw).all()


def test_an_unknown_covariance_is_the_default_of_its_status(save: Save) -> None:
    log = read_log(save([nav_sat(0, 0, kind=0), nav_sat(1, 2, (0,) * 9, kind=0)]))
    for row, status in enumerate((GnssStatus.SINGLE, GnssStatus.FLOAT)):
        horizontal, vertical = DEFAULT_SIGMA[status]
        expected = np.diag([horizontal**2, horizontal**2, vertical**2])
        np.testing.assert_array_equal(gnss_of(log).cov_enu[row], expected)


def test_gps_fix(save: Save) -> None:
    codes = (-1, 0, 1, 2, 18, 33, 20, 19)
    heading = {"dip": 30.0, "err_dip": SIGMA_95}
    unknown = {"kind": 0, "err_horz": RADIUS_95, "err_vert": 2 * SIGMA_95}
    sent = [gps(k, code, **(heading if k == 6 else {"dip": 50.0})) for k, code in enumerate(codes)]
    log = read_log(save([*sent, gps(8, **unknown)]))
    assert log.left_out == ()
    names = [GnssStatus(s).name for s in gnss_of(log).status]
    assert names == ["NONE", "SINGLE", "DGNSS", "FLOAT", "DGNSS", "DGNSS", "FLOAT", "FIXED", "FIXED"]
    assert np.flatnonzero(np.isfinite(gnss_of(log).yaw)).tolist() == [6]
    assert gnss_of(log).yaw[6] == pytest.approx(np.radians(60.0), abs=1e-15)
    assert gnss_of(log).yaw_sigma[6] == pytest.approx(np.radians(1.0), abs=1e-15)
    np.testing.assert_allclose(gnss_of(log).cov_enu[8], np.diag([1.0, 1.0, 4.0]), rtol=1e-14)
    assert log.gnss_velocity is None


def test_velocity_out_of_gps_fix(save: Save) -> None:
    motion = {"speed": 10.0, "track": 90.0, "climb": -1.0, "err_speed": SIGMA_95, "err_track": 11.4 * SIGMA_95}
    still = {"speed": 0.0, "track": np.nan, "climb": 0.0, "err_climb": SIGMA_95}
    log = read_log(save([gps(0, **motion), gps(1, **still), gps(2, speed=np.nan)]))
    velocity = log.gnss_velocity
    assert velocity is not None
    np.testing.assert_allclose(velocity.vel_enu, [[10, 0, -1], [0, 0, 0]], atol=1e-14)
    across = 10 * np.radians(11.4)
    np.testing.assert_allclose(velocity.cov_enu[0], np.diag([1.0, across**2, 0.04]), atol=1e-12)
    np.testing.assert_allclose(velocity.cov_enu[1], np.diag([0.01, 0.01, 1.0]), atol=1e-12)
    assert log.left_out == (LeftOut("/gps", "speed, track or climb is not finite", 1),)


def test_poses_and_odometry(save: Save) -> None:
    log = read_log(
        save([pose(0), pose(1, q=(0, 0, 1.2, 1.6)), pose(0, odometry=True), pose(1, q=(0,) * 4, odometry=True)])
    )
    assert log.pose_fixes is not None
    assert log.reference is not None
    np.testing.assert_allclose(log.pose_fixes.pose, [[1, 2, 2 * np.arctan2(0.6, 0.8)]], atol=1e-15)
    assert log.pose_fixes.cov.ravel().tolist() == list(COV)
    assert log.left_out == (LeftOut("/pose", "pose.orientation is not a unit quaternion", 1),)
    assert log.reference.p_map.tolist() == [[1, 2, 3], [1, 2, 3]]
    assert log.reference.q_map_body[0].tolist() == [0, 0, 0.6, 0.8]
    assert np.isnan(log.reference.q_map_body[1]).all()
    np.testing.assert_allclose(log.reference.sigma, [[5**0.5, 3], [5**0.5, 3]])


def test_a_reference_without_covariance_has_unknown_sigmas(save: Save) -> None:
    log = read_log(
        save([pose(0, cov=(0,) * 9, odometry=True), pose(1, cov=(4, 0, 0, 0, 4, 0, 0, 0, -1), odometry=True)])
    )
    assert log.reference is not None
    np.testing.assert_array_equal(log.reference.sigma, [[np.nan, np.nan], [2, np.nan]])


def reasons(log: Log) -> dict[str, int]:
    return {row.reason: row.count for row in log.left_out}


def test_bad_imu_rows(save: Save) -> None:
    messages = imu_messages(30)
    for k, (field, axis, value) in enumerate([("angular_velocity", "x", np.nan), ("linear_acceleration", "z", np.inf)]):
        messages[k].value[field][axis] = value  # type: ignore[index]
    messages[5].value["angular_velocity_covariance"][0] = -1.0  # type: ignore[index]
    messages[6].value["header"]["stamp"]["nanosec"] = 4_000_000_000  # type: ignore[index]
    for k, wrong in ((10, 9), (15, 3)):
        messages[k].value["header"] = messages[wrong].value["header"]  # type: ignore[index]
    messages[20].value["header"] = header(START_NS + 3600 * 10**9)  # type: ignore[index]
    log = read_log(save(messages))
    assert reasons(log) == {
        "angular_velocity is not finite": 1,
        "linear_acceleration is not finite": 1,
        "angular_velocity is marked as not measured (covariance -1)": 1,
        "header.stamp.nanosec is not below 1e9": 1,
        "stamp jumps away from its arrival": 1,
        "stamp repeats": 1,
        "stamp goes back": 1,
    }
    assert log.imu is not None
    assert len(log.imu) == 23
    assert all(row.source == "/imu" for row in log.left_out)


def test_bad_gnss_rows(save: Save) -> None:
    zero, indefinite = (0,) * 9, (1, 2, 0, 2, 1, 0, 0, 0, 1)
    sent = [
        *(nav_sat(k) for k in range(10)),
        nav_sat(10, latitude=np.nan),
        nav_sat(11, latitude=91.0),
        nav_sat(12, cov=zero),
        nav_sat(13, cov=indefinite),
        nav_sat(14, cov=(np.inf,) * 9),
        nav_sat(15, cov=(1e300,) * 9),
    ]
    log = read_log(save(sent))
    assert reasons(log) == {
        "latitude, longitude or altitude is not finite": 1,
        "latitude or longitude is out of range": 1,
        "position_covariance is not finite": 1,
        "position_covariance is all zero": 1,
        "position_covariance is not positive definite": 2,
    }
    assert len(gnss_of(log)) == 10


def test_bad_pose_and_wheel_rows(save: Save) -> None:
    zero = (0,) * 9
    poses = [
        pose(0),
        pose(1, p=(np.nan, 0, 0)),
        pose(2, p=(1, 2, np.nan)),
        pose(3, cov=zero),
        pose(4, q=(0, 0, 0, np.nan)),
    ]
    log = read_log(
        save([*poses, twist(0, "body"), twist(1, "body", cov=zero), twist(2, "body", linear=(np.inf, 0, 0))])
    )
    assert log.pose_fixes is not None
    assert log.wheel is not None
    assert log.pose_fixes.t_ns.tolist() == [stamp(0), stamp(2)]
    assert len(log.wheel) == 1
    assert reasons(log) == {
        "pose.position is not finite": 1,
        "pose.orientation is not a unit quaternion": 1,
        "pose.covariance of x, y, yaw is all zero": 1,
        "twist.linear.x is not finite": 1,
        "twist.covariance[0] is not positive": 1,
    }


def test_late_fixes_are_put_in_order_and_wrong_stamps_are_not(save: Save) -> None:
    sent = [nav_sat(k) for k in range(40)]
    sent[5], sent[6] = sent[6]._replace(log_time=stamp(5)), sent[5]._replace(log_time=stamp(6))
    sent[30].value["header"] = header(stamp(10) + 1)  # type: ignore[index]
    log = read_log(save(sent))
    assert reasons(log) == {"stamp goes back": 1}
    assert gnss_of(log).t_ns.tolist() == [stamp(k) for k in range(40) if k != 30]
    assert gnss_of(log).arrival_ns[5] == stamp(6)
