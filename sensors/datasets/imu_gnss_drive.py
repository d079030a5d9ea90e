"""A drive of imu_gnss_fusion (github.com/yongkyuns/imu_gnss_fusion): phone-grade IMU and u-blox GNSS as gzipped CSV.

Frames, checked on the drives: ``reference_mount`` holds the Euler angles of R_body_imu = Rz(yaw) Ry(pitch) Rx(roll)
to a forward-left-up vehicle (the receiver's own sensor-fusion alignment; it converges, so the second half's median
counts); ``reference_attitude`` is roll, pitch nose up and heading clockwise from north. Times count from the start of
the recording, whose date is unknown: t_s = 0 becomes ORIGIN_NS.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sensors.clock import NS_PER_S
from sensors.datasets.calibration import Calibration, calibrate
from sensors.datasets.map_trajectory import q_from_aerospace, trajectory_from_llh
from sensors.datasets.text_columns import read_columns
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, utm_frame
from sensors.records import GnssFix, GnssStatus, GnssVelocity, Imu, LeftOut, Log, Trajectory
from sensors.rotation import interpolate_q
from sensors.screening import screen
from sensors.vehicle import ImuSpec, Vehicle

Floats = NDArray[np.float64]
Columns = dict[str, Floats]

ORIGIN_NS = 946_684_800 * NS_PER_S
"""2000-01-01T00:00:00 UTC."""
NOISE_M = 0.05
"""Short-term noise of a position (the receiver smooths; its claimed 0.2 to 0.5 m are slow errors)."""
REFERENCE_SIGMA = (1.0, float(np.radians(2.0)))
"""The reference is the receiver's own dead reckoning: 0.3 to 1.6 m off GNSS; yaw as its mount wandered."""

PHONE_IMU = ImuSpec(
    name="phone-mems",
    gyro_noise_deg_per_sqrt_h=0.42,
    accel_noise_m_per_s_per_sqrt_h=0.3,
    gyro_bias_instability_deg_per_h=30.0,
    accel_bias_instability_mg=1.0,
    gyro_turn_on_bias_deg_per_h=3600.0,
    accel_turn_on_bias_mg=40.0,
)
"""Gyro noise as in Bosch's BMI160 datasheet (7 mdeg/s/sqrt(Hz)), a part common in phones; the recordings do not name
theirs. Accelerometer: three times its 180 ug/sqrt(Hz), for the car's vibration. Biases: the drives show up to
0.7 deg/s and 15 mg."""

_GNSS = [
    "t_s",
    "lat_deg",
    "lon_deg",
    "height_m",
    "vn_mps",
    "ve_mps",
    "vd_mps",
    "pos_std_n_m",
    "pos_std_e_m",
    "pos_std_d_m",
    "vel_std_n_mps",
    "vel_std_e_mps",
    "vel_std_d_mps",
]
_IMU = ["t_s", "gx_radps", "gy_radps", "gz_radps", "ax_mps2", "ay_mps2", "az_mps2"]
_ANGLES = ["t_s", "roll_deg", "pitch_deg", "yaw_deg"]
_POSITION = ["t_s", "lat_deg", "lon_deg", "height_m"]


def load(src: Path) -> Log:
    """Log of a drive's folder."""
    raw, imu_left = _imu(src)
    gnss, velocity, gnss_left = _gnss(src)
    frame = utm_frame(gnss.llh[0])
    found = calibrate(raw, gnss, velocity, NOISE_M)
    R = _mounting(src, found)
    vehicle = Vehicle(
        imu=PHONE_IMU,
        gnss_lever_arm_sigma_m=0.5,
        rear_axle=found.rear_axle,
        gnss_delay_s=round(found.position_delay_s, 4),
        gnss_velocity_delay_s=round(found.velocity_delay_s, 4),
        land_vehicle=R is not None,
    )
    imu = raw if R is None else Imu(raw.t_ns, raw.arrival_ns, raw.gyro @ R.T, raw.accel @ R.T)
    reference, reference_left = _reference(src, frame)
    left_out = (*imu_left, *gnss_left, *reference_left)
    return Log(imu, gnss, velocity, None, None, reference, vehicle, frame, left_out)


def read_mount(path: Path) -> Floats | None:
    """(3, 3) R_body_imu that the receiver had converged to, None where it never did."""
    mount = read_columns(path, _ANGLES)
    angles = np.stack([mount[name] for name in ("yaw_deg", "pitch_deg", "roll_deg")], axis=1)
    late = angles[len(angles) // 2 :]
    late = late[np.abs(late).sum(axis=1) > 0]
    if not len(late):
        return None
    result: Floats = Rotation.from_euler("ZYX", late, degrees=True).mean().as_matrix()
    return result


def _mounting(src: Path, found: Calibration) -> Floats | None:
    """R_body_imu of the recording, else what its motion shows."""
    path = _path(src, "reference_mount")
    mounting = read_mount(path) if path.is_file() else None
    if mounting is None and found.mounting is not None:
        return found.mounting.R_body_imu
    return mounting


def _path(src: Path, name: str) -> Path:
    """Gzipped file, else the plain one."""
    if not src.is_dir():
        raise EgolocError(f"{src}: expected the folder of a drive")
    zipped = src / f"{name}.csv.gz"
    return zipped if zipped.is_file() else src / f"{name}.csv"


def _stack(columns: Columns, names: list[str]) -> Floats:
    return np.stack([columns[name] for name in names], axis=1)


def _stamps(t_s: Floats) -> NDArray[np.int64]:
    return ORIGIN_NS + np.rint(np.nan_to_num(t_s) * 1e9).astype(np.int64)


def _imu(src: Path) -> tuple[Imu, tuple[LeftOut, ...]]:
    path = _path(src, "imu")
    columns = read_columns(path, _IMU)
    values = _stack(columns, _IMU)
    t_ns = _stamps(columns["t_s"])
    keep, left_out = screen(path.name, t_ns, t_ns, {"not finite": np.all(np.isfinite(values), axis=1)})
    return Imu(t_ns[keep], t_ns[keep], values[keep, 1:4], values[keep, 4:7]), left_out


def _gnss(src: Path) -> tuple[GnssFix, GnssVelocity, tuple[LeftOut, ...]]:
    path = _path(src, "gnss")
    columns = read_columns(path, _GNSS)
    values = _stack(columns, _GNSS)
    t_ns = _stamps(columns["t_s"])
    checks = {
        "not finite": np.all(np.isfinite(values), axis=1),
        "sigma is not positive": (values[:, 7:13] > 0).all(axis=1),
    }
    keep, left_out = screen(path.name, t_ns, t_ns, checks)
    if not keep.any():
        raise EgolocError(f"{path}: no usable row of {len(values)}")
    v, t = values[keep], t_ns[keep]
    llh = np.stack((np.radians(v[:, 1]), np.radians(v[:, 2]), v[:, 3]), axis=1)
    vel_enu = np.stack((v[:, 5], v[:, 4], -v[:, 6]), axis=1)
    status = np.full(len(t), GnssStatus.SINGLE, np.int8)
    return GnssFix(t, t, llh, _cov(v[:, 7:10]), status), GnssVelocity(t, t, vel_enu, _cov(v[:, 10:13])), left_out


def _cov(sigma_ned: Floats) -> Floats:
    """(N, 3, 3) ENU covariance of north, east, down sigmas."""
    result: Floats = np.eye(3) * (sigma_ned[:, [1, 0, 2], None] ** 2)
    return result


def _reference(src: Path, frame: MapFrame) -> tuple[Trajectory | None, tuple[LeftOut, ...]]:
    """Positions with the attitude interpolated onto them; the attitude is unknown before the receiver aligned."""
    path, attitude_path = _path(src, "reference_position"), _path(src, "reference_attitude")
    if not path.is_file():
        return None, ()
    values = _stack(read_columns(path, _POSITION), _POSITION)
    t_ns = _stamps(values[:, 0])
    keep, left_out = screen(path.name, t_ns, t_ns, {"not finite": np.all(np.isfinite(values), axis=1)})
    t = t_ns[keep]
    llh = np.stack((np.radians(values[keep, 1]), np.radians(values[keep, 2]), values[keep, 3]), axis=1)
    q = _attitude(attitude_path, t) if attitude_path.is_file() else None
    return trajectory_from_llh(frame, t, llh, q, np.tile(REFERENCE_SIGMA, (len(t), 1))), left_out


def _attitude(path: Path, t_ns: NDArray[np.int64]) -> Floats:
    """(N, 4) q_enu_body at t_ns, NaN before the first angle that is not zero and after the last row."""
    values = _stack(read_columns(path, _ANGLES), _ANGLES)
    known = np.all(np.isfinite(values), axis=1)
    known &= np.cumsum(np.abs(values[:, 1:]).sum(axis=1) > 0) > 0
    values = values[known]
    roll, pitch, heading = np.radians(values[:, 1:]).T
    t_known, rows = np.unique(_stamps(values[:, 0]), return_index=True)
    if len(t_known) < 2:
        return np.full((len(t_ns), 4), np.nan)
    q = interpolate_q(t_ns, t_known, q_from_aerospace(roll, pitch, heading)[rows])
    q[(t_ns < t_known[0]) | (t_ns > t_known[-1])] = np.nan
    return q
