"""Raw counts of NovAtel's IMUs: scale factors and rates by IMU type.

Source: OEM7 manual, RAWIMUSX, "Raw IMU Scale Factors" and output rates; the numbers of the types from INSCONFIG. The
scale factors agree with NovAtel's ROS driver (oem7_imu.cpp).
"""

from dataclasses import dataclass

import numpy as np

from sensors.vehicle import ImuSpec

_DEG = float(np.pi / 180)
_ARCSEC = _DEG / 3600
_FOOT = 0.3048
_MG = 9.80665e-3


@dataclass(frozen=True, slots=True)
class RawScale:
    """gyro: rad, accel: m/s of one count of an increment; rate_hz: samples a second."""

    name: str
    gyro: float
    accel: float
    rate_hz: float


def _epson(name: str, gyro_deg: float, accel_mg: float, rate: float) -> RawScale:
    """Epson parts give rates in 1/65536 of a figure, per sample."""
    return RawScale(name, gyro_deg / 65536 * _DEG / rate, accel_mg / 65536 * _MG / rate, rate)


RAW_SCALES = {
    1: RawScale("HG1700_AG11", 2**-33, 2**-27 * _FOOT, 100),
    4: RawScale("HG1700_AG17", 2**-33, 2**-26 * _FOOT, 100),
    5: RawScale("HG1900_CA29", 2**-33, 2**-27 * _FOOT, 100),
    8: RawScale("LN200", 2**-19, 2**-14, 200),
    11: RawScale("HG1700_AG58", 2**-33, 2**-27 * _FOOT, 100),
    12: RawScale("HG1700_AG62", 2**-33, 2**-26 * _FOOT, 100),
    13: RawScale("IMAR_FSAS", 0.1 * 2**-8 * _ARCSEC, 0.05 * 2**-15, 200),
    16: RawScale("KVH_COTS", 0.1 / (3600 * 256), 0.05 * 2**-15, 100),
    20: RawScale("HG1930_AA99", 2**-33, 2**-27 * _FOOT, 100),
    26: RawScale("ISA100C", 1e-9, 2e-8, 200),
    27: RawScale("HG1900_CA50", 2**-33, 2**-27 * _FOOT, 100),
    28: RawScale("HG1930_CA50", 2**-33, 2**-27 * _FOOT, 100),
    31: RawScale("ADIS16488", 720 * 2**-31 * _DEG, 200 * 2**-31, 200),
    32: RawScale("STIM300", 2**-21 * _DEG, 2**-22, 125),
    33: RawScale("KVH_1750", 0.1 / (3600 * 256), 0.05 * 2**-15, 200),
    41: _epson("EPSON_G320", 0.008, 0.2, 125),
    52: RawScale("LITEF_MICROIMU", 1e-9, 2e-8, 200),
    56: RawScale("STIM300D", 2**-21 * _DEG, 2**-22, 125),
    58: RawScale("HG4930_AN01", 2**-33, 2**-29, 100),
    61: _epson("EPSON_G370", 0.0151515, 0.4, 200),
    62: _epson("EPSON_G320_200HZ", 0.008, 0.2, 200),
    68: RawScale("HG4930_AN04", 2**-33, 2**-29, 100),
    69: RawScale("HG4930_AN04_400HZ", 2**-33, 2**-29, 400),
}
"""IMU type of RAWIMUSX and INSCONFIG -> scale."""

TYPE_BY_NAME = {scale.name: number for number, scale in RAW_SCALES.items()}


def imu_spec(scale: RawScale) -> ImuSpec:
    """Datasheet figures; those of the G320N stand in for the better units whose figures are not entered here."""
    return ImuSpec(name=scale.name.lower().replace("_", "-"), samples="increment")
