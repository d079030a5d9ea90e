"""KITTI sequence 00 (raw drive 2011_10_03_drive_0027) as the gtsam wheel ships it in ``gtsam/Data``.

KittiEquivBiasedImu.txt (Time dt accelX .. omegaZ, 100 Hz), its _metadata.txt (extrinsics and noise) and
KittiGps_converted.txt (Time,X,Y,Z in local metres, 1 Hz). Checked on the drive: accelerations and rates are
forward-left-up (+9.8 m/s^2 up; yaw rate and course rate, forward acceleration and speed correlate at 0.98 and more),
and the direction of travel lies within a degree of x. X, Y, Z are right-handed with Z up and are taken for east, north,
up: nothing in the files shows where north is, and only the earth rate depends on it. Source: Geiger et al., IJRR 2013.
"""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.datasets.text_columns import numbers, read_table
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map
from sensors.records import GnssFix, GnssStatus, Imu, LeftOut, Log
from sensors.screening import screen
from sensors.vehicle import ImuSpec, Vehicle

Floats = NDArray[np.float64]

ORIGIN_NS = 1_317_600_000 * NS_PER_S
"""2011-10-03T00:00:00: stamps are seconds of the day of the drive, taken for UTC."""
FRAME = MapFrame("enu", (49.0, 8.4, 115.0))
"""Karlsruhe. The files do not give their datum; only gravity and the earth rate depend on it."""
DELAY_S = -0.055
"""Positions are true this long after their stamp on the IMU's clock: windows of 8 s (``clock_offset``) say -0.055
before 199 s, -0.051 up to 309 s and -0.061 after, each +- 0.005."""
SIGMA_ENU = (0.05, 0.05, 0.1)
"""Of positions over seconds, m: those windows leave 2 cm. Over minutes they are worse: where the drive passes a place
twice, heights differ by 0.5 m (RMS)."""
LINEAR = 1e-6
"""Second differences of all six columns stay below this in rows that are a straight line between two real ones: eight
pauses of 1.6 s were filled so (of all other rows 99 % differ by more than 0.01)."""
BIAS_TIME_CONSTANT_S = 1000.0
TURN_ON = (5e-5, 0.1)
"""Gyro rad/s and accelerometer m/s^2 biases at the start, as gtsam's own example of this drive assumes."""
GYRO_SCALE_PPM, GYRO_MISALIGNMENT_DEG = 1000.0, 0.05
"""The files say nothing of either: figures usual for an inertial unit of this class."""

_IMU = "KittiEquivBiasedImu.txt"
_METADATA = "KittiEquivBiasedImu_metadata.txt"
_GPS = "KittiGps_converted.txt"
_EXTRINSICS = ("BodyPtx", "BodyPty", "BodyPtz", "BodyPrx", "BodyPry", "BodyPrz")
_ACCEL, _GYRO, _TIMES = ("accelX", "accelY", "accelZ"), ("omegaX", "omegaY", "omegaZ"), ("Time",)
_FIGURES = ("AccelerometerSigma", "GyroscopeSigma", "AccelerometerBiasSigma", "GyroscopeBiasSigma", "AverageDeltaT")


def load(src: Path) -> Log:
    """Log of the folder gtsam/Data."""
    if not src.is_dir():
        raise EgolocError(f"{src}: expected the folder gtsam/Data")
    vehicle = Vehicle(imu=_imu_spec(src / _METADATA), gnss_delay_s=DELAY_S)
    imu, imu_left = _imu(src / _IMU)
    gnss, gnss_left = _gnss(src / _GPS)
    return Log(imu=imu, gnss=gnss, vehicle=vehicle, map_frame=FRAME, left_out=(*imu_left, *gnss_left))


def _read(path: Path, wanted: tuple[str, ...], delimiter: str = " ") -> Floats:
    """(N, len(wanted)) columns by name."""
    header, rows = read_table(path, delimiter)
    missing = [name for name in wanted if name not in header]
    if missing:
        raise EgolocError(f"{path}: column {missing[0]}: not there, the header has {', '.join(header)}")
    values: Floats = numbers(path, header, rows)[:, [header.index(name) for name in wanted]]
    return values


def _stamps(seconds: Floats) -> NDArray[np.int64]:
    return ORIGIN_NS + np.rint(np.nan_to_num(seconds) * 1e9).astype(np.int64)


def _rows(path: Path, values: Floats) -> tuple[NDArray[np.int64], Floats, tuple[LeftOut, ...]]:
    """Stamps and columns (N, C) of the usable rows; the first column is the time in seconds."""
    t_ns = _stamps(values[:, 0])
    keep, left_out = screen(path.name, t_ns, t_ns, {"not finite": np.all(np.isfinite(values), axis=1)})
    if not keep.any():
        raise EgolocError(f"{path}: no usable row of {len(values)}")
    return t_ns[keep], values[keep, 1:], left_out


def _imu(path: Path) -> tuple[Imu, tuple[LeftOut, ...]]:
    """The IMU. Column dt repeats the stamps (in the first row it holds the time itself) and is not read."""
    t_ns, values, left_out = _rows(path, _read(path, (*_TIMES, *_GYRO, *_ACCEL)))
    kept = np.ones(len(values), bool)
    kept[1:-1] = np.abs(np.diff(values, 2, axis=0)).max(axis=1) > LINEAR
    if not kept.all():
        left_out = (*left_out, LeftOut(path.name, "filled in along a straight line", int((~kept).sum())))
    return Imu(t_ns[kept], t_ns[kept], values[kept, :3], values[kept, 3:]), left_out


def _gnss(path: Path) -> tuple[GnssFix, tuple[LeftOut, ...]]:
    """Positions of the IMU, as status fixed: over the seconds of a hidden stretch they are near the truth."""
    t_ns, enu, left_out = _rows(path, _read(path, (*_TIMES, "X", "Y", "Z"), ","))
    cov = np.tile(np.diag(np.square(SIGMA_ENU)), (len(t_ns), 1, 1))
    status = np.full(len(t_ns), GnssStatus.FIXED, np.int8)
    return GnssFix(t_ns, t_ns, llh_from_map(FRAME, enu), cov, status), left_out


def _imu_spec(path: Path) -> ImuSpec:
    """Noise densities (m/s^2/sqrt(Hz), rad/s/sqrt(Hz)) and bias random walks (per sample, as gtsam's example reads
    them) in datasheet units; the walk becomes the Gauss-Markov process of the same growth."""
    values = _read(path, (*_EXTRINSICS, *_FIGURES))
    if len(values) != 1 or values[0, :6].any():
        raise EgolocError(f"{path}: {_EXTRINSICS[0]}: expected one row of figures with the IMU at the body's origin")
    accel, gyro, accel_walk, gyro_walk, period = values[0, 6:].tolist()
    if not period > 0:
        raise EgolocError(f"{path}: AverageDeltaT: expected seconds above 0, got {period}")
    growth = math.sqrt(BIAS_TIME_CONSTANT_S / (2.0 * period))
    deg_per_h, mg = math.degrees(3600.0), 9.80665e-3
    return ImuSpec(
        name="kitti-oxts-rt3003",
        gyro_noise_deg_per_sqrt_h=math.degrees(gyro) * 60.0,
        accel_noise_m_per_s_per_sqrt_h=accel * 60.0,
        gyro_bias_instability_deg_per_h=gyro_walk * growth * deg_per_h,
        accel_bias_instability_mg=accel_walk * growth / mg,
        bias_time_constant_s=BIAS_TIME_CONSTANT_S,
        gyro_turn_on_bias_deg_per_h=TURN_ON[0] * deg_per_h,
        accel_turn_on_bias_mg=TURN_ON[1] / mg,
        gyro_scale_ppm=GYRO_SCALE_PPM,
        gyro_misalignment_deg=GYRO_MISALIGNMENT_DEG,
    )
