"""Makes logs and foreign MCAP files: messages encoded by mcap-ros2-support, files written by the mcap package."""

import io
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2._dynamic import serialize_dynamic

from sensors.geodesy import MapFrame
from sensors.mcap.schemas import schema_text
from sensors.records import GnssFix, GnssVelocity, Imu, Log, PoseFix, Trajectory, WheelSpeed
from sensors.vehicle import Vehicle

START_NS = 1_700_000_000_000_000_000


class Sent(NamedTuple):
    """One message: topic, schema ``pkg/Type``, value or bytes, log time."""

    topic: str
    schema: str
    value: dict[str, Any] | bytes
    log_time: int


def header(t_ns: int, frame: str = "body") -> dict[str, Any]:
    return {"stamp": {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}, "frame_id": frame}


def vector(values: Iterable[float], axes: str = "xyz") -> dict[str, float]:
    return dict(zip(axes, map(float, values), strict=True))


def imu_value(t_ns: int, gyro: Iterable[float], accel: Iterable[float], frame: str = "body") -> dict[str, Any]:
    return {
        "header": header(t_ns, frame),
        "orientation": vector((0, 0, 0, 1), "xyzw"),
        "orientation_covariance": [0.0] * 9,
        "angular_velocity": vector(gyro),
        "angular_velocity_covariance": [0.0] * 9,
        "linear_acceleration": vector(accel),
        "linear_acceleration_covariance": [0.0] * 9,
    }


def imu_messages(count: int = 50, frame: str = "body", topic: str = "/imu", seed: int = 1) -> list[Sent]:
    """Samples 10 ms apart, logged 1 ms after their stamp."""
    values = np.random.default_rng(seed).normal(size=(count, 6))
    times = [START_NS + k * 10_000_000 for k in range(count)]
    return [
        Sent(topic, "sensor_msgs/Imu", imu_value(t, row[:3], row[3:], frame), t + 1_000_000)
        for t, row in zip(times, values, strict=True)
    ]


def nested(paths: dict[str, Any]) -> dict[str, Any]:
    """{"a.b": 1} -> {"a": {"b": 1}}."""
    tree: dict[str, Any] = {}
    for path, value in paths.items():
        *above, last = path.split(".")
        node = tree
        for name in above:
            node = node.setdefault(name, {})
        node[last] = value
    return tree


def text_of(schema: str) -> str:
    """The text of a schema, also of the one that egoloc reads and does not write."""
    return NAV_SAT_FIX if schema == "sensor_msgs/NavSatFix" else schema_text(schema)


def encode(schema: str, value: dict[str, Any]) -> bytes:
    """CDR bytes of a message, by mcap-ros2-support."""
    package, name = schema.split("/")
    full = f"{package}/msg/{name}"
    data: bytes = serialize_dynamic(full, text_of(schema))[full](value)
    return data


def mcap_bytes(
    messages: Iterable[Sent], texts: dict[str, str] | None = None, encoding: str = "cdr", **options: Any
) -> bytes:
    """A file by the mcap package's writer; texts replaces schema texts."""
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start("ros2", "test")
    channels: dict[str, int] = {}
    for number, message in enumerate(messages):
        if message.topic not in channels:
            package, name = message.schema.split("/")
            text = (texts or {}).get(message.schema) or text_of(message.schema)
            schema = writer.register_schema(f"{package}/msg/{name}", "ros2msg", text.encode())
            channels[message.topic] = writer.register_channel(message.topic, encoding, schema)
        data = message.value if isinstance(message.value, bytes) else encode(message.schema, message.value)
        writer.add_message(channels[message.topic], message.log_time, data, message.log_time, number)
    writer.finish()
    return stream.getvalue()


def definite(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3, 3) positive definite matrices."""
    a = rng.normal(size=(count, 3, 3))
    return a @ a.transpose(0, 2, 1) + np.eye(3)


def full_log(count: int = 400) -> Log:
    """Every record, with awkward values: unknown attitudes and sigmas, rows without yaw, every GNSS status."""
    rng = np.random.default_rng(3)
    fast = START_NS + np.arange(count, dtype=np.int64) * 10_000_000
    slow = START_NS + 123 + np.arange(count // 10, dtype=np.int64) * 100_000_000
    n = len(slow)
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q[::7] = np.nan
    sigma = np.abs(rng.normal(size=(count, 2)))
    sigma[::5, 0] = np.nan
    sigma[::3, 1] = np.nan
    yaw = rng.uniform(-np.pi, np.pi, n)
    yaw[::4] = np.nan
    llh = np.column_stack((rng.uniform(-1.5, 1.5, n), rng.uniform(-np.pi, np.pi, n), rng.normal(size=n) * 100))
    pose = np.column_stack((rng.normal(size=(n, 2)) * 1e3, rng.uniform(-np.pi, np.pi, n)))
    return Log(
        imu=Imu(fast, fast + 1_000, rng.normal(size=(count, 3)), rng.normal(size=(count, 3))),
        gnss=GnssFix(
            slow, slow + 50_000_000, llh, definite(rng, n), (np.arange(n) % 5).astype(np.int8), yaw, yaw * 0 + 0.01
        ),
        gnss_velocity=GnssVelocity(slow, slow + 50_000_000, rng.normal(size=(n, 3)), definite(rng, n)),
        pose_fixes=PoseFix(slow, slow + 120_000_000, pose, definite(rng, n)),
        wheel=WheelSpeed(fast, fast, rng.normal(size=count), np.abs(rng.normal(size=count)) + 0.01),
        reference=Trajectory(fast, fast, rng.normal(size=(count, 3)) * 100, q, sigma),
        vehicle=Vehicle(gnss_lever_arm=(0.1, -0.2, 1.3), gnss_delay_s=0.05),
        map_frame=MapFrame("utm", (456_000.0, 5_427_000.0, 0.0), 32),
    )


SMALL = {"chunk_size": 4000}
VARIANTS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "none": {"compression": CompressionType.NONE},
    "without checksums": {"enable_crcs": False},
    "none without checksums": {"compression": CompressionType.NONE, "enable_crcs": False},
    "unchunked": {"use_chunking": False},
    "unchunked with checksum": {"use_chunking": False, "enable_data_crcs": True},
    "unindexed": {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
    "no summary": {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "use_summary_offsets": False,
        "repeat_channels": False,
        "repeat_schemas": False,
    },
}


def gyro_of(messages: list[Sent]) -> np.ndarray:
    values = [m.value["angular_velocity"] for m in messages if isinstance(m.value, dict)]
    return np.array([[v["x"], v["y"], v["z"]] for v in values])


def imu_of(log: Log) -> Imu:
    assert log.imu is not None
    return log.imu


NAV_SAT_FIX = """std_msgs/Header header
sensor_msgs/NavSatStatus status
float64 latitude
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 position_covariance_type
================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================
MSG: sensor_msgs/NavSatStatus
int8 STATUS_NO_FIX=-1
int8 status
uint16 service"""
COV = (4.0, 0.5, 0.1, 0.5, 5.0, 0.2, 0.1, 0.2, 9.0)


def stamp(k: int) -> int:
    return START_NS + k * 100_000_000


def nav_sat(k: int, status: int = 0, cov: Any = COV, kind: int = 3, **fields: float) -> Sent:
    value = nested({"latitude": 49.0, "longitude": 8.0, "altitude": 100.0 + k, "status.status": status} | fields)
    value |= {"header": header(stamp(k), "gps"), "position_covariance": list(cov), "position_covariance_type": kind}
    return Sent("/fix", "sensor_msgs/NavSatFix", value, stamp(k))


def gps(k: int, status: int = 19, cov: Any = COV, kind: int = 3, topic: str = "/gps", **fields: float) -> Sent:
    value = nested({"latitude": 49.0, "longitude": 8.0, "altitude": 100.0, "status.status": status} | fields)
    value["status"]["header"] = header(0, "")
    value |= {"header": header(stamp(k), "gps"), "position_covariance": list(cov), "position_covariance_type": kind}
    return Sent(topic, "gps_msgs/GPSFix", value, stamp(k))


def block(indices: tuple[int, ...], values: Any) -> list[float]:
    cov = np.zeros((6, 6))
    cov[np.ix_(indices, indices)] = np.reshape(values, (len(indices), len(indices)))
    return cov.ravel().tolist()


def twist(k: int, frame: str, linear: Any = (3, 4, 5), cov: Any = COV, topic: str = "/twist") -> Sent:
    value = {"header": header(stamp(k), frame)}
    value["twist"] = {"twist": {"linear": vector(linear)}, "covariance": block((0, 1, 2), cov)}
    return Sent(topic, "geometry_msgs/TwistWithCovarianceStamped", value, stamp(k))


def pose(
    k: int, p: Any = (1, 2, 3), q: Any = (0, 0, 0.6, 0.8), cov: Any = COV, frame: str = "map", odometry: bool = False
) -> Sent:
    value: dict[str, Any] = {"header": header(stamp(k), frame)}
    inner = {"position": vector(p), "orientation": vector(q, "xyzw")}
    value["pose"] = {"pose": inner, "covariance": block((0, 1, 5), cov)}
    if odometry:
        return Sent("/odom", "nav_msgs/Odometry", value | {"child_frame_id": "body"}, stamp(k))
    return Sent("/pose", "geometry_msgs/PoseWithCovarianceStamped", value, stamp(k))
