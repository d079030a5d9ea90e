"""ROS 1 bags and ROS 2 bag folders, through the rosbags package: the same messages and rules as for MCAP logs.

The messages that feed a sensor are transcribed to a temporary MCAP file and read by ``sensors.mcap``, so topics,
frames and bad rows are judged alike. An Odometry in a frame other than map is wheel odometry: its forward speed is
kept. Extrinsics come from /tf_static, where the bag has it.
"""

import logging
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.rosbag1 import ReaderError as Reader1Error
from rosbags.rosbag2 import ReaderError as Reader2Error
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from sensors.datasets.static_transforms import StaticTransforms, base_from, read_static
from sensors.errors import EgolocError
from sensors.geodesy import utm_frame
from sensors.mcap.io import read_log
from sensors.mcap.topics import BODY_FRAMES, MAP_FRAMES, check_choice
from sensors.records import Imu, LeftOut, Log
from sensors.vehicle import ImuSpec, Vector3, Vehicle

Floats = NDArray[np.float64]

log_ = logging.getLogger(__name__)

IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
FIXES = ("sensor_msgs/msg/NavSatFix", "gps_msgs/msg/GPSFix", "gps_common/msg/GPSFix")
TYPES = (IMU, *FIXES, ODOMETRY, "geometry_msgs/msg/PoseWithCovarianceStamped", TWIST)
TF = "tf2_msgs/msg/TFMessage"
READ_ERRORS = (
    AnyReaderError,
    Reader1Error,
    Reader2Error,
    SerdeError,
    TypesysError,
    OSError,
    ValueError,
    KeyError,
    AssertionError,
    IndexError,
)
"""What rosbags raises on files that are damaged or something else."""
MAX_TILT_DEG = 30.0
"""An IMU without a known mounting whose mean acceleration is nearer to its z axis than this has z up."""

ROBOT_IMU = ImuSpec(
    name="industrial-mems",
    gyro_noise_deg_per_sqrt_h=0.5,
    accel_noise_m_per_s_per_sqrt_h=0.1,
    gyro_bias_instability_deg_per_h=20.0,
    accel_bias_instability_mg=0.5,
    gyro_turn_on_bias_deg_per_h=1800.0,
    accel_turn_on_bias_mg=20.0,
)
"""A bag does not say how good its IMU is: figures common for MEMS units on robots."""


def load(src: Path, topics: Mapping[str, str] | None = None) -> Log:
    """Log of a bag; topics: sensor (imu, gnss, gnss_velocity, pose_fixes, wheel, reference) -> topic."""
    chosen = dict(topics or {})
    check_choice(chosen)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag.mcap"
        found = _transcribe(src, path, chosen)
        try:
            log = read_log(path, chosen)
        except EgolocError as error:
            raise EgolocError(
                str(error).replace(str(path), str(src)).replace("under [topics]", "with topics")
            ) from None
    return _finish(src, log, found)


class _Found(msgspec.Struct):
    """What the transcription noticed: frames of IMU and GNSS, static transforms, messages that cannot be read."""

    frame_of: dict[str, str] = {}
    static: StaticTransforms = {}
    unreadable: dict[tuple[str, str], int] = {}


def _transcribe(src: Path, path: Path, chosen: Mapping[str, str]) -> _Found:
    """Copy the messages of the known types as ROS 2 CDR."""
    found = _Found()
    store = get_typestore(Stores.ROS2_HUMBLE)
    try:
        with AnyReader([src], default_typestore=store) as reader, path.open("wb") as stream:
            writer = Writer(stream, use_statistics=True)
            writer.start()
            wanted = [c for c in reader.connections if c.msgtype in TYPES]
            if not wanted:
                seen = ", ".join(sorted({c.msgtype for c in reader.connections})) or "no topics"
                raise EgolocError(f"{src}: expected messages such as {IMU} or {FIXES[0]}, the bag has {seen}")
            _copy(reader, writer, wanted, chosen, found)
            statics = [c for c in reader.connections if c.msgtype == TF and c.topic.endswith("tf_static")]
            for _, _, message in _messages(reader, statics, found) if statics else ():
                read_static(message, found.static)
            writer.finish()  # type: ignore[no-untyped-call]
    except EgolocError:
        raise
    except READ_ERRORS as error:
        text = " ".join(str(error).split())
        raise EgolocError(f"{src}: expected a ROS 1 bag or ROS 2 bag folder with an index: {text}") from None
    return found


def _messages(reader: AnyReader, connections: list[Connection], found: _Found) -> Iterator[tuple[Connection, int, Any]]:
    """Deserialized messages; one that cannot be read is counted."""
    for connection, log_time, raw in reader.messages(connections=connections):
        try:
            yield connection, log_time, reader.deserialize(raw, connection.msgtype)
        except READ_ERRORS:
            key = (connection.topic, "message cannot be deserialized")
            found.unreadable[key] = found.unreadable.get(key, 0) + 1


def _copy(
    reader: AnyReader, writer: Writer, connections: list[Connection], chosen: Mapping[str, str], found: _Found
) -> None:
    """Write each message under its own schema; odometry in a frame other than map becomes a twist."""
    channels: dict[tuple[str, str], int] = {}
    poses = {chosen.get("reference"), chosen.get("pose_fixes")}
    standard = get_typestore(Stores.ROS2_HUMBLE)
    for connection, log_time, original in _messages(reader, connections, found):
        store, kind, message = reader.typestore, connection.msgtype, original
        frame = message.header.frame_id.lstrip("/")
        sensor = "imu" if kind == IMU else "gnss" if kind in FIXES else ""
        if connection.topic == chosen.get(sensor, connection.topic):
            found.frame_of.setdefault(sensor, frame)
        if kind == ODOMETRY and frame not in MAP_FRAMES and connection.topic not in poses:
            store, kind, message = standard, TWIST, _twist(standard, original)
        key = (connection.topic, kind)
        if key not in channels:
            text = store.generate_msgdef(kind, ros_version=2)[0]
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channels[key] = writer.register_channel(connection.topic, "cdr", schema)
        data = bytes(store.serialize_cdr(message, kind))
        writer.add_message(channels[key], log_time, data, publish_time=log_time)


def _twist(store: Typestore, odometry: Any) -> Any:
    """The odometry's twist, which is in its child frame."""
    types = store.types
    stamp, twist = odometry.header.stamp, odometry.twist
    frame = odometry.child_frame_id.lstrip("/")
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=stamp.sec, nanosec=stamp.nanosec),
        frame_id=frame if frame in BODY_FRAMES else "base_link",
    )
    vector = types["geometry_msgs/msg/Vector3"]
    linear, angular = (vector(x=v.x, y=v.y, z=v.z) for v in (twist.twist.linear, twist.twist.angular))
    inner = types["geometry_msgs/msg/Twist"](linear=linear, angular=angular)
    with_cov = types["geometry_msgs/msg/TwistWithCovariance"](twist=inner, covariance=np.asarray(twist.covariance))
    return types[TWIST](header=header, twist=with_cov)


def _finish(src: Path, log: Log, found: _Found) -> Log:
    """Rotate the IMU into the body, and say what the bag tells of the vehicle and what it leaves open."""
    left_out = [LeftOut(topic, reason, count) for (topic, reason), count in found.unreadable.items()]
    vehicle, imu = Vehicle(imu=ROBOT_IMU), log.imu
    if imu is not None:
        R, vehicle = _extrinsics(src, imu, found, vehicle)
        imu = Imu(imu.t_ns, imu.arrival_ns, imu.gyro @ R.T, imu.accel @ R.T)
    frame = log.map_frame or (utm_frame(log.gnss.llh[0]) if log.gnss is not None else None)
    return replace(log, imu=imu, vehicle=vehicle, map_frame=frame, left_out=(*log.left_out, *left_out))


def _extrinsics(src: Path, imu: Imu, found: _Found, vehicle: Vehicle) -> tuple[Floats, Vehicle]:
    """R_body_imu and lever arms of /tf_static; without them a tilted IMU is levelled and its heading stays open."""
    imu_frame, gnss_frame = (found.frame_of.get(sensor, "") for sensor in ("imu", "gnss"))
    mounted = base_from(found.static, imu_frame)
    if mounted is not None:
        R, p_imu = mounted
        antenna = base_from(found.static, gnss_frame)
        lever = (0.0, 0.0, 0.0) if antenna is None else _vector(antenna[1] - p_imu)
        return R, msgspec.structs.replace(vehicle, gnss_lever_arm=lever, rear_axle=_vector(-p_imu))
    up = imu.accel.mean(axis=0)
    tilt = float(np.degrees(np.arccos(up[2] / np.linalg.norm(up))))
    if tilt < MAX_TILT_DEG:
        return np.eye(3), vehicle
    text = "%s: no /tf_static to %s and the IMU is tilted by %.0f deg: levelled, heading of its axes unknown"
    log_.warning(text, src, imu_frame or "the IMU", tilt)
    R_level: Floats = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()
    return R_level, msgspec.structs.replace(vehicle, land_vehicle=False)


def _vector(p: Floats) -> Vector3:
    return float(p[0]), float(p[1]), float(p[2])
