"""Gathered columns -> columns of records, and which rows a record cannot hold, with the reason.

GNSS status: NavSatStatus -1 none, 0 single, 1 (SBAS) DGNSS, 2 (GBAS) float, or fixed where its known covariance claims
5 cm or better (the message does not tell them apart); GPSStatus also 18, 33 DGNSS, 19 fixed, 20 float.
Covariance of unknown type: GPSFix err_horz, err_vert where given, else DEFAULT_SIGMA by status.
Heading: GPSFix ``dip`` (deg clockwise from north; the third of its device angles) where ``err_dip`` is positive.
Altitude is taken as height above the ellipsoid.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from sensors.mcap.columns import Topic
from sensors.mcap.decoded import Decoded, build
from sensors.mcap.modes import PoseModes
from sensors.mcap.tags import decode_tags
from sensors.records import (
    GnssFix,
    GnssStatus,
    GnssVelocity,
    Imu,
    PoseFix,
    Trajectory,
    WheelSpeed,
    sound_modes,
)
from sensors.rotation import wrap, yaw_from_q
from sensors.sanity import (
    MAX_ALTITUDE,
    MAX_COORDINATE,
    MAX_FORCE,
    MAX_RATE,
    MAX_SPEED,
    covariance_valid,
    finite_rows,
    rows_within,
    sane,
)

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


SIGMA_95 = 1.959963984540054
"""95 % of a normal variable lies within this many sigmas."""
RADIUS_95 = 2.447746830680816
"""95 % of a circular normal pair lies within this many sigmas."""
DEFAULT_SIGMA = {
    GnssStatus.NONE: (100.0, 200.0),
    GnssStatus.SINGLE: (3.0, 6.0),
    GnssStatus.DGNSS: (1.0, 2.0),
    GnssStatus.FLOAT: (0.4, 0.8),
    GnssStatus.FIXED: (0.02, 0.04),
}
"""Status -> sigma of each horizontal axis and of height, m, where the message gives none."""
DEFAULT_VELOCITY_SIGMA = (0.1, 0.2)
"""Horizontal and vertical, m/s, where a GPSFix gives none."""
_FIXED_SIGMA = 0.05
_STATUS = {-1: 0, 0: 1, 1: 2, 2: 3, 18: 2, 19: 4, 20: 3, 33: 2}
MAX_LATITUDE = 89.99
"""Nearer the pole there is hardly an east, deg."""


def decode_imu(topic: Topic) -> Decoded:
    """sensor_msgs/Imu; a first covariance element of -1 marks a quantity that is not measured."""
    gyro, accel = topic.column("gyro"), topic.column("accel")
    valid = {
        **sane("angular_velocity", gyro, MAX_RATE, "rad/s"),
        **sane("linear_acceleration", accel, MAX_FORCE, "m/s^2"),
        "angular_velocity is marked as not measured (covariance -1)": topic.column("gyro_known") != -1,
        "linear_acceleration is marked as not measured (covariance -1)": topic.column("accel_known") != -1,
    }
    return build(Imu, topic, {"gyro": gyro, "accel": accel}, valid, late=False)


def decode_gnss(topic: Topic) -> Decoded:
    """NavSatFix or GPSFix."""
    degrees, raw, known = topic.column("llh"), topic.integers("status"), topic.integers("cov_type") != 0
    status = np.full(len(raw), GnssStatus.SINGLE, np.int8)
    for code, value in _STATUS.items():
        status[raw == code] = value
    status[raw < -1] = GnssStatus.NONE
    given = topic.column("cov").reshape(-1, 3, 3)
    claimed = np.maximum(given[:, 0, 0], given[:, 1, 1])
    status[(raw == 2) & known & (claimed > 0) & (claimed <= _FIXED_SIGMA**2)] = GnssStatus.FIXED
    cov = np.where(known[:, None, None], given, _default_covariance(topic, status))
    valid = {
        "latitude, longitude or altitude is not finite": finite_rows(degrees),
        "latitude or longitude is out of range": rows_within(degrees[:, :2], (MAX_LATITUDE, 360.0)),
        "latitude and longitude are both zero": (degrees[:, 0] != 0.0) | (degrees[:, 1] != 0.0),
        f"altitude is beyond {MAX_ALTITUDE:g} m": rows_within(degrees[:, 2:], (MAX_ALTITUDE,)),
        **covariance_valid("position_covariance", cov),
    }
    llh = np.column_stack((np.radians(degrees[:, :2]), degrees[:, 2]))
    columns = {"llh": llh, "cov_enu": cov, "status": status}
    if topic.has_column("heading"):
        columns["yaw"], columns["yaw_sigma"] = _yaw(topic.column("heading"))
    return build(GnssFix, topic, columns, valid)


def _default_covariance(topic: Topic, status: NDArray[np.int8]) -> Floats:
    """(N, 3, 3) covariances by the 95 % errors of a GPSFix where they are positive, else by status."""
    sigma = np.array([DEFAULT_SIGMA[s] for s in GnssStatus])[status]
    if topic.has_column("err"):
        err = topic.column("err") / (RADIUS_95, SIGMA_95)
        sigma = np.where(np.isfinite(err) & (err > 0), err, sigma)
    cov = np.zeros((len(status), 3, 3))
    cov[:, 0, 0] = cov[:, 1, 1] = sigma[:, 0] ** 2
    cov[:, 2, 2] = sigma[:, 1] ** 2
    return cov


def _yaw(heading: Floats) -> tuple[Floats, Floats]:
    """Yaw and its sigma, rad, from heading and 95 % error, deg; NaN where the error is not positive."""
    given = finite_rows(heading) & (heading[:, 1] > 0)
    yaw = np.where(given, wrap(np.pi / 2 - np.radians(np.where(given, heading[:, 0], 0.0))), np.nan)
    return yaw, np.where(given, np.radians(np.where(given, heading[:, 1], 0.0)) / SIGMA_95, np.nan)


def decode_gnss_velocity(topic: Topic) -> Decoded | None:
    """TwistWithCovarianceStamped in ENU axes, or the speed, track and climb of a GPSFix."""
    if topic.has_column("motion"):
        return _decode_motion(topic)
    vel, cov = topic.column("vel"), topic.column("cov").reshape(-1, 3, 3)
    valid = sane("twist.linear", vel, MAX_SPEED, "m/s") | covariance_valid("twist.covariance", cov)
    return build(GnssVelocity, topic, {"vel_enu": vel, "cov_enu": cov}, valid)


def _decode_motion(topic: Topic) -> Decoded | None:
    """Velocities of a GPSFix; none at all as long as none was filled in. A speed of zero needs no track."""
    speed, track, climb = topic.column("motion").T
    track = np.where(speed == 0.0, 0.0, track)
    finite = np.isfinite(speed) & np.isfinite(track) & np.isfinite(climb)
    topic.moved |= bool(speed[finite].any() or climb[finite].any())
    if not topic.moved:
        return None
    speed, climb, angle = (np.where(finite, x, 0.0) for x in (speed, climb, np.radians(track)))
    err = topic.column("motion_err") / SIGMA_95
    given = np.isfinite(err) & (err > 0)
    along = np.where(given[:, 0], err[:, 0], DEFAULT_VELOCITY_SIGMA[0])
    across = np.maximum(along, np.where(given[:, 1], speed * np.radians(err[:, 1]), 0.0))
    up = np.where(given[:, 2], err[:, 2], DEFAULT_VELOCITY_SIGMA[1])
    sine, cosine = np.sin(angle), np.cos(angle)
    cov = np.zeros((len(speed), 3, 3))
    cov[:, 0, 0] = (sine * along) ** 2 + (cosine * across) ** 2
    cov[:, 1, 1] = (cosine * along) ** 2 + (sine * across) ** 2
    cov[:, 0, 1] = cov[:, 1, 0] = sine * cosine * (along**2 - across**2)
    cov[:, 2, 2] = up**2
    vel = np.column_stack((speed * sine, speed * cosine, climb))
    valid = {
        "speed, track or climb is not finite": finite,
        f"speed or climb is beyond {MAX_SPEED:g} m/s": rows_within(vel, (MAX_SPEED,) * 3),
        **covariance_valid("err_speed or err_climb", cov),
    }
    return build(GnssVelocity, topic, {"vel_enu": vel, "cov_enu": cov}, valid)


def decode_pose_fixes(topic: Topic) -> Decoded:
    """PoseWithCovarianceStamped (or Odometry) in map coordinates; z, roll and pitch are not used."""
    p, cov = topic.column("p"), topic.column("cov").reshape(-1, 3, 3)
    q, rotates = _unit(topic.column("q"))
    valid = {
        **sane("pose.position", p[:, :2], MAX_COORDINATE, "m"),
        "pose.orientation is not a unit quaternion": rotates,
        **covariance_valid("pose.covariance of x, y, yaw", cov),
    }
    pose = np.column_stack((p[:, :2], yaw_from_q(q)))
    return build(PoseFix, topic, {"pose": pose, "cov": cov}, valid)


def decode_pose_modes(topic: Topic) -> Decoded:
    """egoloc_msgs/PoseModes."""
    modes, weights = topic.column("modes").reshape(-1, 2, 3), topic.column("weights")
    given = weights[:, :, None] != 0.0
    used = np.where(given, modes, np.nan)
    valid = {
        **sane("modes", np.where(given, modes[:, :, :2], 0.0).reshape(-1, 4), MAX_COORDINATE, "m"),
        "weights are no falling masses of modes": sound_modes(used, weights),
    }
    used[:, :, 2] = wrap(used[:, :, 2])
    return build(PoseModes, topic, {"modes": used, "weights": weights}, valid)


def decode_wheel(topic: Topic) -> Decoded:
    """TwistWithCovarianceStamped in body axes: linear.x and its variance."""
    speed, variance = topic.column("speed"), topic.column("variance")
    measured = np.isfinite(variance) & (variance > 0)
    valid = sane("twist.linear.x", speed[:, None], MAX_SPEED, "m/s")
    valid["twist.covariance[0] is not positive"] = measured
    sigma = np.sqrt(np.where(measured, variance, 1.0))
    return build(WheelSpeed, topic, {"speed": speed, "sigma": sigma}, valid)


def decode_reference(topic: Topic) -> Decoded:
    """Odometry (or PoseWithCovarianceStamped) in map coordinates.

    A quaternion that is no rotation (zeros, NaN) is an unknown attitude. A negative variance is an unknown sigma, and
    so are the zeros of a covariance that is not filled in at all; the horizontal sigma is the larger of x and y.
    """
    p = topic.column("p")
    q, _ = _unit(topic.column("q"))
    variance = topic.column("variance")
    x, y, z, yaw = variance.T
    filled_in = (x != 0) | (y != 0) | (z != 0) | (yaw != 0)
    sigma = np.empty((len(p), 2))
    for k, chosen in enumerate((np.where(np.minimum(x, y) >= 0, np.maximum(x, y), -1.0), yaw)):
        known = filled_in & np.isfinite(chosen) & (chosen >= 0)
        sigma[:, k] = np.sqrt(np.where(known, chosen, np.nan))
    valid = sane("pose.position", p, MAX_COORDINATE, "m")
    return build(Trajectory, topic, {"p_map": p, "q_map_body": q, "sigma": sigma}, valid, late=False)


DECODERS: Mapping[str, Callable[[Topic], Decoded | None]] = {
    "imu": decode_imu,
    "gnss": decode_gnss,
    "gnss_velocity": decode_gnss_velocity,
    "pose_fixes": decode_pose_fixes,
    "pose_modes": decode_pose_modes,
    "wheel": decode_wheel,
    "reference": decode_reference,
    "scene": decode_tags,
    "mode": decode_tags,
}


def _unit(q: Floats) -> tuple[Floats, Mask]:
    """(N, 4) quaternions of unit length, NaN where the length is not 1 within 1 %, and which of them are rotations."""
    norm = np.sqrt(np.einsum("ij,ij->i", q, q))
    error = np.abs(norm - 1.0)
    rotates: Mask = error < 0.01
    unit = q.copy()
    rough = rotates & (error > 1e-6)
    unit[rough] /= norm[rough, None]
    unit[~rotates] = np.nan
    return unit, rotates
