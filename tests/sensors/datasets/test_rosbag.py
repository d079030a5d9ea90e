"""ROS bags: a real ROS 1 bag and a ROS 2 bag written here."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from sensors.datasets import load
from sensors.errors import EgolocError

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
COUNT = 50


def header(k: int, frame: str) -> Any:
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=1_700_000_000 + k // 10, nanosec=k % 10 * 100_000_000)
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def vector(x: float, y: float, z: float) -> Any:
    return TYPES["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def quaternion(x: float, y: float, z: float, w: float) -> Any:
    return TYPES["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def imu(k: int) -> Any:
    zero = np.zeros(9)
    return TYPES["sensor_msgs/msg/Imu"](
        header=header(k, "imu_link"),
        orientation=quaternion(0, 0, 0, 1),
        orientation_covariance=zero,
        angular_velocity=vector(0.1, 0.2, 0.3),
        angular_velocity_covariance=zero,
        linear_acceleration=vector(1.0, 2.0, 9.8),
        linear_acceleration_covariance=zero,
    )


def fix(k: int) -> Any:
    status = TYPES["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
    return TYPES["sensor_msgs/msg/NavSatFix"](
        header=header(k, "gps"),
        status=status,
        latitude=48.0,
        longitude=11.0,
        altitude=500.0 + k,
        position_covariance=np.diag([1.0, 2.0, 4.0]).ravel(),
        position_covariance_type=2,
    )


def odometry(k: int, frame: str = "odom") -> Any:
    point = TYPES["geometry_msgs/msg/Point"](x=float(k), y=2.0, z=3.0)
    pose = TYPES["geometry_msgs/msg/Pose"](position=point, orientation=quaternion(0, 0, 0, 1))
    twist = TYPES["geometry_msgs/msg/Twist"](linear=vector(1.5, 0, 0), angular=vector(0, 0, 0.1))
    cov = (np.eye(6) * 0.04).ravel()
    return TYPES["nav_msgs/msg/Odometry"](
        header=header(k, frame),
        child_frame_id="base_link",
        pose=TYPES["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=cov),
        twist=TYPES["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=cov),
    )


def transforms(_: int) -> Any:
    """The IMU, turned 90 deg to the left, sits 1 m ahead of base_link, the antenna 0.5 m behind and 1.6 m up."""
    messages = []
    for child, p, q in (
        ("imu_link", (1.0, 0.0, 0.3), (0, 0, np.sqrt(0.5), np.sqrt(0.5))),
        ("gps", (-0.5, 0.0, 1.6), (0, 0, 0, 1)),
    ):
        transform = TYPES["geometry_msgs/msg/Transform"](translation=vector(*p), rotation=quaternion(*q))
        stamped = TYPES["geometry_msgs/msg/TransformStamped"]
        messages.append(stamped(header=header(0, "base_link"), child_frame_id=child, transform=transform))
    return TYPES["tf2_msgs/msg/TFMessage"](transforms=messages)


def bag(folder: Path, topics: dict[str, tuple[str, Callable[[int], Any]]]) -> Path:
    path = folder / "bag"
    with Writer(path, version=9) as writer:
        for topic, (kind, make) in topics.items():
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for k in range(1 if "tf" in topic else COUNT):
                stamp = 1_700_000_000_000_000_000 + k * 100_000_000 + 5_000_000
                writer.write(connection, stamp, STORE.serialize_cdr(make(k), kind))
    return path


IMU = ("sensor_msgs/msg/Imu", imu)
FIX = ("sensor_msgs/msg/NavSatFix", fix)
ODOM = ("nav_msgs/msg/Odometry", odometry)
TF = ("tf2_msgs/msg/TFMessage", transforms)


def test_a_ros2_bag(tmp_path: Path) -> None:
    log = load("rosbag", bag(tmp_path, {"/imu": IMU, "/fix": FIX, "/odom": ODOM, "/tf_static": TF}))
    assert log.imu is not None
    assert log.gnss is not None
    assert log.wheel is not None
    assert (len(log.imu), len(log.gnss), len(log.wheel)) == (COUNT, COUNT, COUNT)
    assert log.imu.t_ns[1] == 1_700_000_000_100_000_000
    assert log.imu.arrival_ns[1] == 1_700_000_000_105_000_000
    np.testing.assert_allclose(log.imu.gyro[0], [-0.2, 0.1, 0.3], atol=1e-12)
    np.testing.assert_allclose(log.imu.accel[0], [-2.0, 1.0, 9.8], atol=1e-12)
    np.testing.assert_allclose(log.gnss.llh[3], [np.radians(48), np.radians(11), 503.0])
    np.testing.assert_allclose(np.diag(log.gnss.cov_enu[0]), [1, 2, 4])
    np.testing.assert_allclose(log.vehicle.gnss_lever_arm, [-1.5, 0, 1.3])
    np.testing.assert_allclose(log.vehicle.rear_axle, [-1, 0, -0.3])
    assert set(log.wheel.speed) == {1.5}
    assert log.wheel.sigma[0] == pytest.approx(0.2)
    assert log.reference is None
    assert log.map_frame is not None
    assert log.map_frame.zone == 32


def test_odometry_in_the_map_is_a_reference(tmp_path: Path) -> None:
    topics = {"/imu": IMU, "/fix": FIX, "/truth": ("nav_msgs/msg/Odometry", lambda k: odometry(k, "map"))}
    log = load("rosbag", bag(tmp_path, topics))
    assert log.reference is not None
    assert log.wheel is None
    np.testing.assert_allclose(log.reference.p_map[4], [4, 2, 3])


def test_two_topics_for_a_sensor_are_both_named(tmp_path: Path) -> None:
    path = bag(tmp_path, {"/imu/front": IMU, "/imu/rear": IMU, "/fix": FIX})
    with pytest.raises(EgolocError, match=r"imu: /imu/front .* and /imu/rear .* could all feed it") as raised:
        load("rosbag", path)
    assert str(raised.value).startswith(str(path))
    chosen = load("rosbag", path, {"imu": "/imu/rear"})
    assert chosen.imu is not None
    with pytest.raises(EgolocError, match=r"topics\.imu: no topic /imu"):
        load("rosbag", path, {"imu": "/imu"})
    with pytest.raises(EgolocError, match=r"topics\.radar: no such sensor"):
        load("rosbag", path, {"radar": "/imu"})


def test_a_bag_without_sensors_says_what_it_has(tmp_path: Path) -> None:
    with pytest.raises(EgolocError, match="the bag has tf2_msgs/msg/TFMessage"):
        load("rosbag", bag(tmp_path, {"/tf_static": TF}))


def test_a_ros1_bag(data: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The robot's IMU stands on edge (gravity on y) and the bag has no /tf_static: levelled, no vehicle assumed."""
    log = load("rosbag", data / "rosbag1/test1.bag")
    assert log.imu is not None
    assert log.gnss is not None
    assert log.wheel is not None
    assert (len(log.imu), len(log.gnss), len(log.wheel)) == (11865, 989, 3952)
    np.testing.assert_allclose(log.imu.accel.mean(axis=0), [0, 0, 9.79], atol=0.01)
    assert not log.vehicle.land_vehicle
    assert "no /tf_static" in caplog.text
    span = (log.imu.t_ns[-1] - log.imu.t_ns[0]) * 1e-9
    assert span == pytest.approx(395.3, abs=0.1)


@pytest.mark.parametrize("size", [0, 10, 5000, 1_000_000])
def test_a_cut_ros1_bag_is_one_line(data: Path, tmp_path: Path, size: int) -> None:
    path = tmp_path / "cut.bag"
    path.write_bytes((data / "rosbag1/test1.bag").read_bytes()[:size])
    with pytest.raises(EgolocError, match=r"cut\.bag") as raised:
        load("rosbag", path)
    assert "\n" not in str(raised.value)
