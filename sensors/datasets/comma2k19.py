"""A one-minute segment of comma2k19 (github.com/commaai/comma2k19): phone IMU, u-blox, wheel speeds, fused global pose.

Numpy arrays in files without ending. Facts checked on a segment: IMU and camera axes are forward, right, down and agree
(rates correlate at 0.98 and more without lag); quaternions are wxyz and turn camera axes into ECEF; stamps are boot
time, which frame_gps_times ties to GPS time; the u-blox utc_timestamp is in ms. The phone looks down the road at
its own angle: the body's forward axis is the mean direction of travel seen by the camera, a constant of the segment.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S, WEEK_NS, utc_from_gps
from sensors.datasets.imu_gnss_drive import PHONE_IMU
from sensors.datasets.map_trajectory import trajectory_from_llh
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_ecef, rotation_ecef_enu, utm_frame
from sensors.records import GnssFix, GnssStatus, GnssVelocity, Imu, LeftOut, Log, Trajectory, WheelSpeed
from sensors.rotation import matrix_from_q, q_from_matrix
from sensors.screening import screen
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

FRD = np.diag([1.0, -1.0, -1.0])
"""Forward-right-down to forward-left-up, and back."""
GNSS_SIGMA = np.array([1.0, 1.0, 2.0])
"""The u-blox reports no accuracy. Against the pose: 0.4 m horizontal and 1.2 m vertical, slow errors, m, ENU."""
SPEED_SIGMA, BEARING_SIGMA, CLIMB_SIGMA = 0.3, np.radians(3.0), 2.0
"""Velocity is speed and bearing; climb is not reported and taken for 0, m/s, rad, m/s."""
MIN_BEARING_SPEED = 2.0
"""Below this the bearing is noise: no velocity is made of it, m/s."""
GNSS_DELAY_S, GNSS_VELOCITY_DELAY_S = -0.13, -0.07
"""Fixes carry the receiver's UTC. Against the pose they are true 0.12 to 0.14 s after it, speeds 0.07 s after it."""
WHEEL_SIGMA = 0.1
"""Scatter of the rear wheels about the pose's speed is 0.06, m/s; their scale (1 % low) comes from the GNSS speeds."""


def load(src: Path) -> Log:
    """Log of a segment's folder (processed_log/ and global_pose/)."""
    if not (src / "processed_log").is_dir():
        raise EgolocError(f"{src}: expected the folder of a segment, with processed_log and global_pose")
    boot_ns = _boot(src)
    gnss, velocity, gnss_left = _gnss(src, boot_ns)
    frame = utm_frame(gnss.llh[0])
    R_body_camera, reference, reference_left = _pose(src, boot_ns, frame)
    imu, imu_left = _imu(src, boot_ns, R_body_camera)
    wheel, wheel_left = _wheel(src, boot_ns, velocity)
    vehicle = Vehicle(
        imu=PHONE_IMU,
        gnss_lever_arm_sigma_m=0.5,
        gnss_delay_s=GNSS_DELAY_S,
        gnss_velocity_delay_s=GNSS_VELOCITY_DELAY_S,
    )
    left_out = (*imu_left, *gnss_left, *wheel_left, *reference_left)
    return Log(imu, gnss, velocity, None, wheel, reference, vehicle, frame, left_out)


def _array(src: Path, name: str, width: int) -> Floats:
    """(N, width) array; width 1 gives (N,)."""
    path = src / name
    try:
        array = np.load(path, allow_pickle=False)
    except FileNotFoundError as error:
        raise EgolocError(f"{path}: no such file") from error
    except (ValueError, EOFError, OSError) as error:
        raise EgolocError(f"{path}: expected a numpy array: {error}") from error
    array = np.asarray(array, np.float64).reshape(len(array), -1)
    if array.shape[1] != width or not len(array):
        raise EgolocError(f"{path}: expected shape (N, {width}), got {array.shape}")
    return array[:, 0] if width == 1 else array


def _boot(src: Path) -> int:
    """UTC of boot time 0, from the pose's two clocks."""
    boot, gps = _array(src, "global_pose/frame_times", 1), _array(src, "global_pose/frame_gps_times", 2)
    if len(boot) != len(gps):
        raise EgolocError(f"{src / 'global_pose'}: frame_times has {len(boot)} rows, frame_gps_times {len(gps)}")
    since = gps[:, 0].astype(np.int64) * WEEK_NS + np.rint((gps[:, 1] - boot) * 1e9).astype(np.int64)
    return int(utc_from_gps(np.array([int(np.median(since)) + int(boot[0] * 1e9)]))[0]) - int(boot[0] * 1e9)


def _ns(boot_ns: int, t_s: Floats) -> Nanoseconds:
    return boot_ns + np.rint(np.nan_to_num(t_s) * 1e9).astype(np.int64)


def _imu(src: Path, boot_ns: int, R_body_camera: Floats) -> tuple[Imu, tuple[LeftOut, ...]]:
    """Uncalibrated rates less the phone's own bias at the start: 4 deg/s, but no steps within the segment."""
    t = _array(src, "processed_log/IMU/gyro/t", 1)
    gyro, accel = (_array(src, f"processed_log/IMU/{name}/value", 3) for name in ("gyro_uncalibrated", "accelerometer"))
    if not len(t) == len(gyro) == len(accel):
        raise EgolocError(f"{src / 'processed_log/IMU'}: gyro has {len(gyro)} rows, accelerometer {len(accel)}")
    t_ns = _ns(boot_ns, t)
    finite = np.all(np.isfinite(np.column_stack((t, gyro, accel))), axis=1)
    keep, left_out = screen("IMU", t_ns, t_ns, {"not finite": finite})
    bias = _array(src, "processed_log/IMU/gyro_bias/value", 3)[0]
    gyro = gyro - np.where(np.isfinite(bias), bias, 0.0)
    R = R_body_camera @ FRD
    return Imu(t_ns[keep], t_ns[keep], gyro[keep] @ R.T, accel[keep] @ R.T), left_out


def _gnss(src: Path, boot_ns: int) -> tuple[GnssFix, GnssVelocity, tuple[LeftOut, ...]]:
    """u-blox fixes at the receiver's UTC; arrival is the boot time of the log."""
    value = _array(src, "processed_log/GNSS/live_gnss_ublox/value", 6)
    arrival = _ns(boot_ns, _array(src, "processed_log/GNSS/live_gnss_ublox/t", 1))
    lat, lon, speed, utc_ms, height, bearing = value.T
    t_ns = np.rint(np.nan_to_num(utc_ms)).astype(np.int64) * (NS_PER_S // 1000)
    keep, left_out = screen("live_gnss_ublox", t_ns, arrival, {"not finite": np.all(np.isfinite(value), axis=1)})
    if not keep.any():
        raise EgolocError(f"{src}: processed_log/GNSS/live_gnss_ublox: no usable row of {len(value)}")
    llh = np.stack((np.radians(lat), np.radians(lon), height), axis=1)[keep]
    cov = np.tile(np.diag(GNSS_SIGMA**2), (len(llh), 1, 1))
    fixes = GnssFix(t_ns[keep], arrival[keep], llh, cov, np.full(len(llh), GnssStatus.SINGLE, np.int8))
    moving = keep & (speed > MIN_BEARING_SPEED)
    vel, vel_cov = _velocity(speed[moving], np.radians(bearing[moving]))
    if (slow := int((keep & ~moving).sum())) > 0:
        left_out = (*left_out, LeftOut("live_gnss_ublox velocity", "too slow for a bearing", slow))
    return fixes, GnssVelocity(t_ns[moving], arrival[moving], vel, vel_cov), left_out


def _velocity(speed: Floats, bearing: Floats) -> tuple[Floats, Floats]:
    """(N, 3) ENU velocity and its covariance from speed and bearing (clockwise from north)."""
    sine, cosine, zero = np.sin(bearing), np.cos(bearing), np.zeros_like(speed)
    along = np.stack((sine, cosine, zero), axis=1)
    across = np.stack((cosine, -sine, zero), axis=1)
    cov = SPEED_SIGMA**2 * along[:, :, None] * along[:, None, :]
    cov = cov + ((speed * BEARING_SIGMA) ** 2)[:, None, None] * across[:, :, None] * across[:, None, :]
    cov[:, 2, 2] += CLIMB_SIGMA**2
    return speed[:, None] * along, cov


def _wheel(src: Path, boot_ns: int, velocity: GnssVelocity) -> tuple[WheelSpeed | None, tuple[LeftOut, ...]]:
    """Mean of the rear wheels (columns: front left, front right, rear left, rear right)."""
    folder = "processed_log/CAN/wheel_speed"
    if not (src / folder).is_dir():
        return None, ()
    t, value = _array(src, f"{folder}/t", 1), _array(src, f"{folder}/value", 4)
    if len(t) != len(value):
        raise EgolocError(f"{src / folder}: t has {len(t)} rows, value {len(value)}")
    t_ns, speed = _ns(boot_ns, t), value[:, 2:].mean(axis=1)
    keep, left_out = screen("wheel_speed", t_ns, t_ns, {"not finite": np.isfinite(speed) & np.isfinite(t)})
    speed = speed[keep] * _wheel_scale(t_ns[keep], speed[keep], velocity)
    return WheelSpeed(t_ns[keep], t_ns[keep], speed, np.full(len(speed), WHEEL_SIGMA)), left_out


def _wheel_scale(t_ns: Nanoseconds, speed: Floats, velocity: GnssVelocity) -> float:
    """Ratio of the GNSS speeds to the wheels' at the same times; 1 where they share less than 100 fixes."""
    t = velocity.t_ns - round(GNSS_VELOCITY_DELAY_S * 1e9)
    shared = (t > t_ns[0]) & (t < t_ns[-1])
    if shared.sum() < 100:
        return 1.0
    gnss = np.hypot(*velocity.vel_enu[shared, :2].T)
    return float(gnss.sum() / np.interp(t[shared], t_ns, speed).sum())


def _pose(src: Path, boot_ns: int, frame: MapFrame) -> tuple[Floats, Trajectory, tuple[LeftOut, ...]]:
    """R_body_camera (camera as forward-left-up) and the fused pose as reference of the body."""
    t = _array(src, "global_pose/frame_times", 1)
    ecef, v_ecef = (_array(src, f"global_pose/frame_{name}", 3) for name in ("positions", "velocities"))
    wxyz = _array(src, "global_pose/frame_orientations", 4)
    if not len(t) == len(ecef) == len(v_ecef) == len(wxyz):
        raise EgolocError(f"{src / 'global_pose'}: frame_times has {len(t)} rows, orientations {len(wxyz)}")
    t_ns = _ns(boot_ns, t)
    finite = np.all(np.isfinite(np.column_stack((t, ecef, v_ecef, wxyz))), axis=1)
    keep, left_out = screen("global_pose", t_ns, t_ns, {"not finite": finite})
    R_ecef_camera = matrix_from_q(wxyz[keep][:, [1, 2, 3, 0]]) @ FRD
    R_body_camera = _travel_axes(np.einsum("nji,nj->ni", R_ecef_camera, v_ecef[keep]))
    llh = llh_from_ecef(ecef[keep])
    R_enu_body = rotation_ecef_enu(llh).transpose(0, 2, 1) @ R_ecef_camera @ R_body_camera.T
    return R_body_camera, trajectory_from_llh(frame, t_ns[keep], llh, q_from_matrix(R_enu_body), None), left_out


def _travel_axes(velocity: Floats) -> Floats:
    """(3, 3) R_body_camera: forward along the mean direction of the velocities (N, 3), up nearest the camera's up."""
    forward = velocity[np.linalg.norm(velocity, axis=1) > 5.0].sum(axis=0)
    length = np.linalg.norm(forward)
    if length == 0.0:
        return np.eye(3)
    forward = forward / length
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    return np.stack((forward, left, np.cross(forward, left)))
