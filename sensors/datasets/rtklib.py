"""RTKLIB: a solution (.pos) and the IMU's CSV with its time tag file (.csv.tag) recorded beside it.

The latency that remains between the two clocks, the IMU's axes and the rear axle are estimated from the first half of
the drive (``sensors.datasets.calibration``); IMU grade and antenna are those of the rtk_drive recording, which no
file says.
"""

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.datasets.calibration import Calibration, calibrate
from sensors.datasets.rtklib_imu import read_imu
from sensors.datasets.rtklib_solution import read_solution
from sensors.errors import EgolocError
from sensors.geodesy import utm_frame
from sensors.records import Imu, Log
from sensors.vehicle import ImuSpec, Vehicle

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

NOISE_M = 0.01
"""Short-term noise of an RTK position."""
LEVER_ARM = (0.0, 0.05, 0.0)
"""Antenna from IMU in rtk_drive (its authors' configuration), a few cm; no file says it."""
LEVER_ARM_SIGMA_M = 0.12

MEMS_IN_CAR = ImuSpec(
    name="tdk-icm-45686-in-car",
    gyro_noise_deg_per_sqrt_h=3.0,
    accel_noise_m_per_s_per_sqrt_h=0.3,
    gyro_bias_instability_deg_per_h=20.0,
    accel_bias_instability_mg=0.5,
    gyro_misalignment_deg=0.5,
    gyro_turn_on_bias_deg_per_h=1800.0,
    accel_turn_on_bias_mg=20.0,
)
"""rtk_drive's IMU as mounted, not its datasheet (3.8 mdeg/s/sqrt(Hz) = 0.23 deg/sqrt(h), 70 ug/sqrt(Hz) = 0.04):
vibration aliases into the rates. Against the slope and course of the RTK track, over 1 to 15 s, pitch walks 17
deg/sqrt(h) and yaw at most 3. Biases: common for consumer MEMS. Misalignment: chosen on the first half, every 2.5 s
(without it 60 s hidden end 15 % further off, RMS)."""


def load(src: Path) -> Log:
    """Log of a folder with one .pos and one IMU .csv (with .csv.tag), or of that .pos file."""
    pos_path, imu_path = _files(src)
    gnss, velocity, gnss_left = read_solution(pos_path)
    frame = utm_frame(gnss.llh[0])
    if imu_path is None:
        return Log(gnss=gnss, gnss_velocity=velocity, map_frame=frame, left_out=gnss_left)
    raw, imu_left = read_imu(imu_path)
    found = calibrate(raw, gnss, velocity, NOISE_M) if len(velocity) == len(gnss) else None
    imu, vehicle = in_body(raw, found)
    left_out = (*gnss_left, *imu_left)
    return Log(imu=imu, gnss=gnss, gnss_velocity=velocity, vehicle=vehicle, map_frame=frame, left_out=left_out)


def in_body(raw: Imu, found: Calibration | None) -> tuple[Imu, Vehicle]:
    """IMU samples in body axes and what is known of the vehicle.

    Where the drive does not show the mounting, the IMU's own axes are taken for the body's and no vehicle is assumed.
    """
    vehicle = Vehicle(imu=MEMS_IN_CAR, gnss_lever_arm=LEVER_ARM, gnss_lever_arm_sigma_m=LEVER_ARM_SIGMA_M)
    if found is None:
        return raw, msgspec.structs.replace(vehicle, land_vehicle=False)
    vehicle = msgspec.structs.replace(
        vehicle,
        rear_axle=found.rear_axle,
        gnss_delay_s=round(found.position_delay_s, 4),
        gnss_velocity_delay_s=round(found.velocity_delay_s, 4),
        land_vehicle=found.mounting is not None,
    )
    R = np.eye(3) if found.mounting is None else found.mounting.R_body_imu
    return Imu(raw.t_ns, raw.arrival_ns, raw.gyro @ R.T, raw.accel @ R.T), vehicle


def _files(src: Path) -> tuple[Path, Path | None]:
    """The solution and the IMU file beside it."""
    if src.is_dir():
        solutions = sorted(src.glob("*.pos"))
        if len(solutions) != 1:
            raise EgolocError(f"{src}: expected one .pos file, got {len(solutions)}")
        pos = solutions[0]
    elif src.is_file():
        pos = src
    else:
        raise EgolocError(f"{src}: no such file or folder")
    imus = [path for path in sorted(pos.parent.glob("*.csv")) if path.with_name(path.name + ".tag").is_file()]
    if len(imus) > 1:
        raise EgolocError(f"{pos.parent}: expected one IMU .csv with a .csv.tag, got {', '.join(p.name for p in imus)}")
    return pos, imus[0] if imus else None
