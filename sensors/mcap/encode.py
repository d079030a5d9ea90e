"""Records -> fields of ROS 2 messages, column by column.

GNSS (GPSFix): ENU covariance in position_covariance (type KNOWN); status by _GPS_STATUS; dual-antenna yaw as ``dip``,
deg clockwise from north, and its 95 % error as ``err_dip``, NaN where there is none; speed, track and climb are NaN,
for velocities have their own topic. Reference (Odometry): an unknown attitude is the quaternion (0, 0, 0, 0), an
unknown sigma the variance -1, as are the twist and whatever else the record does not hold. Pose fix and velocities:
axes that the record does not hold have variance UNMEASURED. Tags (String) have no header: their stamp is the log time.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.mcap import cdr
from sensors.mcap.decode import SIGMA_95
from sensors.mcap.schemas import schema_text
from sensors.mcap.tags import problem
from sensors.mcap.topics import GPS_FIX, IMU, ODOMETRY, POSE, POSE_MODES, STRING, TWIST
from sensors.records import GnssFix, GnssStatus, GnssVelocity, Imu, Log, PoseFix, Tags, Trajectory, WheelSpeed

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Fields = Mapping[str, NDArray[np.generic] | float]

UNMEASURED = 1e6
"""Variance of an axis that a record does not hold, m^2, rad^2 or (m/s)^2."""
_GPS_STATUS = {
    GnssStatus.NONE: -1,
    GnssStatus.SINGLE: 0,
    GnssStatus.DGNSS: 18,
    GnssStatus.FLOAT: 20,
    GnssStatus.FIXED: 19,
}
_COVARIANCE_KNOWN = 3
_SOURCE_GPS = 1
_SOURCE_POINTS = 2


TOPICS = (
    "/imu",
    "/gnss/fix",
    "/gnss/velocity",
    "/egovm/pose",
    "/wheel/speed",
    "/reference",
    "/scene",
    "/drive_mode",
    "/egovm/modes",
)
"""What we write, in the order of the channels."""


@dataclass(frozen=True, eq=False)
class Messages:
    """Messages of a topic with the same texts.

    fields: by path (``name[k]`` an array's element), each (N,) or one number for all.
    """

    topic: str
    schema: str
    texts: Mapping[str, str]
    fields: Fields
    t_ns: Ints
    log_time: Ints

    def rows(self) -> "Rows":
        """What turns chosen messages into bytes."""
        walk, data = cdr.template(cdr.parse_schema(self.schema, schema_text(self.schema)), dict(self.texts))
        return Rows(self, walk, np.frombuffer(data, np.uint8))


@dataclass(frozen=True, eq=False)
class Rows:
    """Messages with the place of their fields; template: (size,) bytes of a message with every field zero."""

    messages: Messages
    walk: cdr.Walk
    template: NDArray[np.uint8]

    def fill(self, out: NDArray[np.uint8], chosen: NDArray[np.intp]) -> None:
        """Serialize the chosen messages into the rows of out (len(chosen), size)."""
        out[:] = self.template
        for path, values in self.messages.fields.items():
            name, _, index = path.partition("[")
            place = self.walk.leaves[name]
            size = np.dtype(place.dtype).itemsize
            start = place.offset + size * (int(index[:-1]) if index else 0)
            column = np.asarray(values[chosen] if isinstance(values, np.ndarray) else values, place.dtype)
            out[:, start : start + size] = column.reshape(-1, 1).view(np.uint8)


def messages_of(log: Log) -> list[Messages]:
    """Every record of a log as messages of its topic (tags: for each text); records without rows are left out."""
    made = []
    if log.imu:
        made.append(_imu(log.imu))
    if log.gnss:
        made.append(_gnss(log.gnss))
    if log.gnss_velocity:
        made.append(_gnss_velocity(log.gnss_velocity))
    if log.pose_fixes:
        made.append(_pose_fixes(log.pose_fixes))
        if (known := log.pose_fixes.weights.any(axis=1)).any():
            made.append(_pose_modes(log.pose_fixes[known]))
    if log.wheel:
        made.append(_wheel(log.wheel))
    if log.reference:
        made.append(_reference(log.reference))
    if log.scene:
        made += _tags("/scene", log.scene)
    if log.mode:
        made += _tags("/drive_mode", log.mode)
    return made


def _messages(
    topic: str, schema: str, frame: str, t_ns: Ints, arrival_ns: Ints, fields: Fields, **texts: str
) -> Messages:
    """Add the header; EgolocError where a time does not fit its field."""
    sec, nanosec = np.divmod(t_ns, NS_PER_S)
    if abs(int(sec[0])) >= 1 << 31 or abs(int(sec[-1])) >= 1 << 31:
        raise EgolocError(f"{topic}: t_ns: expected stamps before 2038 (int32 seconds), got {t_ns[-1]}")
    if arrival_ns.min() < 0:
        raise EgolocError(f"{topic}: arrival_ns: expected times since 1970, got {arrival_ns.min()}")
    header = {"header.stamp.sec": sec, "header.stamp.nanosec": nanosec}
    return Messages(topic, schema, {"header.frame_id": frame, **texts}, header | dict(fields), t_ns, arrival_ns)


def _vector(path: str, values: Floats, axes: str = "xyz") -> dict[str, Floats]:
    return {f"{path}.{axis}": values[:, k] for k, axis in enumerate(axes)}


def _block(path: str, indices: tuple[int, ...], cov: Floats) -> dict[str, Floats]:
    """(N, 3, 3) covariances at rows and columns of a 6x6 matrix in row-major order."""
    return {f"{path}[{6 * a + b}]": cov[:, i, j] for i, a in enumerate(indices) for j, b in enumerate(indices)}


def _diagonal(path: str, indices: tuple[int, ...], value: float) -> dict[str, float]:
    return {f"{path}[{7 * k}]": value for k in indices}


def _imu(imu: Imu) -> Messages:
    fields: Fields = {
        "orientation.w": 1.0,
        "orientation_covariance[0]": -1.0,
        **_vector("angular_velocity", imu.gyro),
        **_vector("linear_acceleration", imu.accel),
    }
    return _messages("/imu", IMU, "body", imu.t_ns, imu.arrival_ns, fields)


def _gnss(gnss: GnssFix) -> Messages:
    codes = np.array([_GPS_STATUS[s] for s in GnssStatus], np.int16)
    with_yaw = np.isfinite(gnss.yaw) & np.isfinite(gnss.yaw_sigma)
    unknown = dict.fromkeys(("track", "speed", "climb", "pitch", "roll"), np.nan)
    fields: Fields = {
        "status.status": codes[gnss.status],
        "status.position_source": float(_SOURCE_GPS),
        "status.orientation_source": np.where(with_yaw, _SOURCE_POINTS, 0),
        "latitude": np.degrees(gnss.llh[:, 0]),
        "longitude": np.degrees(gnss.llh[:, 1]),
        "altitude": gnss.llh[:, 2],
        **unknown,
        "dip": np.where(with_yaw, (90.0 - np.degrees(gnss.yaw)) % 360.0, np.nan),
        "err_dip": np.where(with_yaw, np.degrees(gnss.yaw_sigma) * SIGMA_95, np.nan),
        **{f"position_covariance[{3 * i + j}]": gnss.cov_enu[:, i, j] for i in range(3) for j in range(3)},
        "position_covariance_type": float(_COVARIANCE_KNOWN),
    }
    return _messages("/gnss/fix", GPS_FIX, "gnss", gnss.t_ns, gnss.arrival_ns, fields)


def _gnss_velocity(velocity: GnssVelocity) -> Messages:
    fields: Fields = {
        **_vector("twist.twist.linear", velocity.vel_enu),
        **_block("twist.covariance", (0, 1, 2), velocity.cov_enu),
        **_diagonal("twist.covariance", (3, 4, 5), UNMEASURED),
    }
    return _messages("/gnss/velocity", TWIST, "enu", velocity.t_ns, velocity.arrival_ns, fields)


def _pose_fixes(fixes: PoseFix) -> Messages:
    fields: Fields = {
        **_vector("pose.pose.position", fixes.pose[:, :2], "xy"),
        "pose.pose.orientation.z": np.sin(fixes.pose[:, 2] / 2),
        "pose.pose.orientation.w": np.cos(fixes.pose[:, 2] / 2),
        **_block("pose.covariance", (0, 1, 5), fixes.cov),
        **_diagonal("pose.covariance", (2, 3, 4), UNMEASURED),
    }
    return _messages("/egovm/pose", POSE, "map", fixes.t_ns, fixes.arrival_ns, fields)


def _pose_modes(fixes: PoseFix) -> Messages:
    fields: Fields = {
        **{f"modes[{3 * k + i}]": fixes.modes[:, k, i] for k in range(2) for i in range(3)},
        **{f"weights[{k}]": fixes.weights[:, k] for k in range(2)},
    }
    return _messages("/egovm/modes", POSE_MODES, "map", fixes.t_ns, fixes.arrival_ns, fields)


def _wheel(wheel: WheelSpeed) -> Messages:
    fields: Fields = {
        "twist.twist.linear.x": wheel.speed,
        "twist.covariance[0]": wheel.sigma**2,
        **_diagonal("twist.covariance", (1, 2, 3, 4, 5), UNMEASURED),
    }
    return _messages("/wheel/speed", TWIST, "body", wheel.t_ns, wheel.arrival_ns, fields)


def _reference(reference: Trajectory) -> Messages:
    q = np.where(np.isfinite(reference.q_map_body).all(axis=1, keepdims=True), reference.q_map_body, 0.0)
    horizontal, yaw = np.where(np.isfinite(reference.sigma), reference.sigma**2, -1.0).T
    fields: Fields = {
        **_vector("pose.pose.position", reference.p_map),
        **_vector("pose.pose.orientation", q, "xyzw"),
        "pose.covariance[0]": horizontal,
        "pose.covariance[7]": horizontal,
        **_diagonal("pose.covariance", (2, 3, 4), -1.0),
        "pose.covariance[35]": yaw,
        "twist.covariance[0]": -1.0,
    }
    return _messages("/reference", ODOMETRY, "map", reference.t_ns, reference.arrival_ns, fields, child_frame_id="body")


def _tags(topic: str, tags: Tags) -> list[Messages]:
    made = []
    for text in np.unique(tags.text).tolist():
        if why := problem(text):
            raise EgolocError(f"{topic}: {why}, got {text[:40]!r}")
        t_ns = tags.t_ns[tags.text == text]
        if t_ns[0] < 0:
            raise EgolocError(f"{topic}: t_ns: expected times since 1970, got {t_ns[0]}")
        made.append(Messages(topic, STRING, {"data": text}, {}, t_ns, t_ns))
    return made
