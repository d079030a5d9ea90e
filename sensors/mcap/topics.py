"""Which topic feeds which sensor: by schema name, by frame_id where a schema has two roles, or by the user's choice."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from sensors.errors import EgolocError
from sensors.mcap.cdr import short_name
from sensors.mcap.columns import Topic, Wanted
from sensors.mcap.container import Definitions
from sensors.pieces import SENSORS

IMU = "sensor_msgs/Imu"
NAV_SAT_FIX = "sensor_msgs/NavSatFix"
GPS_FIX = "gps_msgs/GPSFix"
OLD_GPS_FIX = "gps_common/GPSFix"
ODOMETRY = "nav_msgs/Odometry"
POSE = "geometry_msgs/PoseWithCovarianceStamped"
TWIST = "geometry_msgs/TwistWithCovarianceStamped"
STRING = "std_msgs/String"
POSE_MODES = "egoloc_msgs/PoseModes"

PARTS = ("pose_modes",)
"""What completes the rows of another sensor with the same stamps, on a topic of its own (``sensors.mcap.modes``)."""

MAP_FRAMES = frozenset({"map", "world"})
"""frame_id of poses in map coordinates."""
ENU_FRAMES = MAP_FRAMES | {"enu"}
"""frame_id of a twist that is a GNSS velocity."""
BODY_FRAMES = frozenset({"body", "base_link", "base_footprint", "vehicle", "rear_axle"})
"""frame_id of a twist that is a wheel speed."""

LIDAR = "lidar"
CAMERA = "camera"
FRAMES = (LIDAR, CAMERA)
"""Keys of the topics that frames are read from (``sensors.mcap.frames``), which feed no columns."""

TAG_TOPICS = {"/scene": "scene", "/drive_mode": "mode"}
"""Topics of strings that are tags without being named; all other strings may be anything."""

_FEEDS = {
    IMU: ("imu",),
    NAV_SAT_FIX: ("gnss",),
    GPS_FIX: ("gnss", "gnss_velocity"),
    OLD_GPS_FIX: ("gnss", "gnss_velocity"),
    ODOMETRY: ("reference", "pose_fixes"),
    POSE: ("pose_fixes", "reference"),
    TWIST: ("gnss_velocity", "wheel"),
    STRING: ("scene", "mode"),
    POSE_MODES: PARTS,
}
"""Schema -> sensors that it can feed."""
_ON_REQUEST = {(ODOMETRY, "pose_fixes"), (POSE, "reference")}
"""Roles that a topic takes only where the user names it for them."""
FRAMED = frozenset({ODOMETRY, POSE, TWIST})
"""Schemas whose frame_id says in which axes their numbers are."""


def _xyz(path: str, axes: str = "xyz") -> tuple[str, ...]:
    return tuple(f"{path}.{axis}" for axis in axes)


def _elements(path: str, indices: Sequence[int]) -> tuple[str, ...]:
    return tuple(f"{path}[{k}]" for k in indices)


_STAMP = {"sec": ("header.stamp.sec",), "nanosec": ("header.stamp.nanosec",)}
_FIX = {
    "llh": ("latitude", "longitude", "altitude"),
    "cov": _elements("position_covariance", range(9)),
    "cov_type": ("position_covariance_type",),
    "status": ("status.status",),
}
_GPS_FIX = _FIX | {"heading": ("dip", "err_dip"), "err": ("err_horz", "err_vert")}
_GPS_VELOCITY = {"motion": ("speed", "track", "climb"), "motion_err": ("err_speed", "err_track", "err_climb")}
_POSE = {"p": _xyz("pose.pose.position"), "q": _xyz("pose.pose.orientation", "xyzw")}
_FULL_POSE = _POSE | {"cov": _elements("pose.covariance", (0, 1, 5, 6, 7, 11, 30, 31, 35))}
_REFERENCE = _POSE | {"variance": _elements("pose.covariance", (0, 7, 14, 35))}
_LINEAR = _xyz("twist.twist.linear")
_MODES = {"modes": _elements("modes", range(6)), "weights": _elements("weights", range(2))}
_COLUMNS: dict[tuple[str, str], Mapping[str, Sequence[str]]] = {
    (IMU, "imu"): {
        "gyro": _xyz("angular_velocity"),
        "accel": _xyz("linear_acceleration"),
        "gyro_known": ("angular_velocity_covariance[0]",),
        "accel_known": ("linear_acceleration_covariance[0]",),
    },
    (NAV_SAT_FIX, "gnss"): _FIX,
    (GPS_FIX, "gnss"): _GPS_FIX,
    (GPS_FIX, "gnss_velocity"): _GPS_VELOCITY,
    (OLD_GPS_FIX, "gnss"): _GPS_FIX,
    (OLD_GPS_FIX, "gnss_velocity"): _GPS_VELOCITY,
    (ODOMETRY, "reference"): _REFERENCE,
    (ODOMETRY, "pose_fixes"): _FULL_POSE,
    (POSE, "reference"): _REFERENCE,
    (POSE, "pose_fixes"): _FULL_POSE,
    (POSE_MODES, "pose_modes"): _MODES,
    (TWIST, "gnss_velocity"): {
        "vel": _LINEAR,
        "cov": _elements("twist.covariance", (0, 1, 2, 6, 7, 8, 12, 13, 14)),
    },
    (TWIST, "wheel"): {"speed": _LINEAR[:1], "variance": ("twist.covariance[0]",)},
}


def feeds(schema: str) -> tuple[str, ...]:
    """Sensors that a schema (``pkg/Type``) can feed."""
    return _FEEDS.get(schema, ())


def check_choice(chosen: Mapping[str, str]) -> None:
    """Raise unless every key names a sensor, or the LiDAR."""
    known = (*SENSORS, *PARTS, *FRAMES)
    for sensor in set(chosen) - set(known):
        raise EgolocError(f"topics.{sensor}: no such sensor, expected one of {', '.join(known)}")


def wanted_by(chosen: Mapping[str, str]) -> Callable[[str, str], Wanted | None]:
    """What to keep of a topic of a schema, given the topics that the user chose for sensors."""

    def wanted(topic: str, schema: str) -> Wanted | None:
        named = [sensor for sensor, name in chosen.items() if name == topic]
        sensors = [
            sensor
            for sensor in _FEEDS.get(schema, ())
            if sensor in named or (sensor not in chosen and (schema, sensor) not in _ON_REQUEST)
        ]
        if schema == STRING:
            mine = TAG_TOPICS.get(topic)
            return Wanted({}, ("data",)) if named or (mine is not None and mine not in chosen) else None
        if not sensors:
            return None
        columns = {name: paths for sensor in sensors for name, paths in _COLUMNS[schema, sensor].items()}
        return Wanted(_STAMP | columns, ("header.frame_id",) if schema in FRAMED else ())

    return wanted


@dataclass
class Roles:
    """sensors: sensor -> its topic; conflicts: sensor -> topics that could all feed it; ignored: topic -> reason."""

    sensors: dict[str, Topic] = field(default_factory=dict)
    conflicts: dict[str, list[Topic]] = field(default_factory=dict)
    ignored: dict[str, str] = field(default_factory=dict)


def assign(
    topics: Sequence[Topic], chosen: Mapping[str, str], definitions: Definitions, path: object, *, complete: bool = True
) -> Roles:
    """Give every sensor its topic. EgolocError where a chosen topic does not exist or cannot feed its sensor.

    complete: all topics are known; otherwise a chosen one may still come.
    """
    roles = Roles()
    for sensor, name in chosen.items():
        if complete or any(channel.topic == name for channel in definitions.channels.values()):
            roles.sensors[sensor] = _named(topics, sensor, name, definitions, path)
    offers: dict[str, list[Topic]] = {}
    for topic in topics:
        if topic.name not in chosen.values():
            sensor, reason = _offer(topic)
            if reason:
                roles.ignored[topic.name] = reason
            elif sensor in chosen:
                roles.ignored[topic.name] = f"{sensor} comes from {chosen[sensor]}"
            else:
                offers.setdefault(sensor, []).append(topic)
    for sensor, candidates in offers.items():
        if len(candidates) == 1:
            roles.sensors[sensor] = candidates[0]
        else:
            roles.conflicts[sensor] = candidates
    gnss = roles.sensors.get("gnss")
    if gnss is not None and gnss.has_column("motion") and "gnss_velocity" not in roles.sensors | roles.conflicts:
        roles.sensors["gnss_velocity"] = gnss
    return roles


def conflict(roles: Roles, path: object) -> str:
    """That two topics could feed one sensor, naming both; "" where none could."""
    for sensor, candidates in roles.conflicts.items():
        names = " and ".join(f"{topic.name} ({topic.schema.name})" for topic in candidates)
        return f"{path}: {sensor}: {names} could all feed it; name one under [topics]"
    return ""


def _named(topics: Sequence[Topic], sensor: str, name: str, definitions: Definitions, path: object) -> Topic:
    """The topic that the user chose for a sensor."""
    channel = next((c for c in definitions.channels.values() if c.topic == name), None)
    if channel is None:
        known = ", ".join(sorted({c.topic for c in definitions.channels.values()})[:20]) or "none"
        raise EgolocError(f"{path}: topics.{sensor}: no topic {name}; the log has {known}")
    found = [topic for topic in topics if topic.name == name]
    schema = definitions.schemas[channel.schema_id].name if channel.schema_id in definitions.schemas else "(none)"
    if not found or sensor not in _FEEDS.get(short_name(schema), ()):
        expected = ", ".join(s for s, feeds in _FEEDS.items() if sensor in feeds)
        raise EgolocError(f"{path}: topics.{sensor}: {name} has schema {schema}, expected one of {expected}")
    if found[0].unsupported:
        raise EgolocError(f"{path}: topics.{sensor}: {name}: {found[0].unsupported}")
    return max(found, key=lambda topic: topic.seen)


def is_plain_text(topic: Topic) -> bool:
    """Whether a topic of strings is no tag; any log may have such topics."""
    return short_name(topic.schema.name) == STRING and topic.wanted is None


def _offer(topic: Topic) -> tuple[str, str]:
    """(sensor that a topic feeds, "") or ("", why it feeds none)."""
    if is_plain_text(topic):
        return "", f"strings are tags on {' and '.join(TAG_TOPICS)} or where they are named under [topics]"
    if topic.unsupported:
        return "", topic.unsupported
    if topic.first is None:
        return "", "no messages" if topic.count == 0 else "no readable message"
    return _offer_by_frame(short_name(topic.schema.name), topic)


def _offer_by_frame(schema: str, topic: Topic) -> tuple[str, str]:
    if schema == TWIST:
        if topic.frame in ENU_FRAMES | BODY_FRAMES:
            return "gnss_velocity" if topic.frame in ENU_FRAMES else "wheel", ""
        names = f"{'/'.join(sorted(ENU_FRAMES))} (GNSS velocity) nor {'/'.join(sorted(BODY_FRAMES))} (wheel speed)"
        return "", f"frame_id {topic.frame!r} is neither {names}"
    if schema in {ODOMETRY, POSE} and topic.frame not in MAP_FRAMES:
        return "", f"frame_id {topic.frame!r} is not {' or '.join(sorted(MAP_FRAMES))}; name it under [topics] if it is"
    return TAG_TOPICS[topic.name] if schema == STRING else _FEEDS[schema][0], ""
