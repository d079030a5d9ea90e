"""Error states besides the sixteen that are always there: which a configuration has, where they stand, their priors."""

import math
from typing import NamedTuple

import numpy as np

from fusion.config import FusionConfig
from fusion.state import ERROR_SIZE, LANE, Floats
from sensors.vehicle import Vehicle

OFF = -1


class Layout(NamedTuple):
    """First error state of each block, OFF where the configuration does without; size: of the error state.

    gnss_error (3): of the position's error that lasts, ENU, in its own sigmas; pose_error (3): the same of pose fixes,
    along, left and yaw; pose_yaw (1): constant yaw error of pose fixes, rad; gnss_arm (3): of the lever arm, body m;
    mounting (2): pitch and yaw of the vehicle's axes against the body's, rad; gnss_delay, pose_delay (1): by which a
    measurement is older than its corrected stamp, s; gyro_scale (1): scale error of the gyro about the vertical axis, -
    (a car hardly turns about the others); gyro_misalignment (2): the share of that turn which the others see, rad.
    """

    size: int = ERROR_SIZE
    gnss_error: int = OFF
    pose_error: int = OFF
    pose_yaw: int = OFF
    gyro_scale: int = OFF
    gyro_misalignment: int = OFF
    gnss_arm: int = OFF
    mounting: int = OFF
    gnss_delay: int = OFF
    pose_delay: int = OFF


_COUNT = {"gnss_error": 3, "pose_error": 3, "gnss_arm": 3, "mounting": 2, "gyro_misalignment": 2}
"""States of a block; one where it is not here."""


def layout_of(vehicle: Vehicle, config: FusionConfig) -> Layout:
    """The blocks in the order of Layout, one after the other."""
    place, first = {}, ERROR_SIZE
    for block, sigma in _priors(vehicle, config).items():
        if sigma > 0.0:
            place[block] = first
            first += _COUNT.get(block, 1)
    return Layout(size=-(-first // LANE) * LANE, **place)


def used(layout: Layout) -> int:
    """How many of the states there are, without what fills them up."""
    last = ERROR_SIZE
    for block, first in zip(Layout._fields[1:], layout[1:], strict=True):
        if first != OFF:
            last = max(last, first + _COUNT.get(block, 1))
    return last


def prior_variances(vehicle: Vehicle, config: FusionConfig) -> Floats:
    """(size,) variances of the blocks before anything is known of them; zero elsewhere."""
    layout = layout_of(vehicle, config)
    found = np.zeros(layout.size)
    for block, sigma in _priors(vehicle, config).items():
        first = getattr(layout, block)
        if first != OFF:
            found[first : first + _COUNT.get(block, 1)] = sigma * sigma
    return found


def _priors(vehicle: Vehicle, config: FusionConfig) -> dict[str, float]:
    """Sigma of each block's states; zero for a block that is not there."""
    gnss, pose, estimate = config.gnss, config.pose, config.estimate
    scale, skew = (estimate.gyro_scale_sigma_ppm, estimate.gyro_misalignment_sigma_deg) if estimate.gyro else (0.0, 0.0)
    known = vehicle.imu.gyro_misalignment_deg
    if not estimate.gyro and known < estimate.gyro_misalignment_from_deg:
        known = 0.0
    arm = (vehicle.gnss_lever_arm_sigma_m or estimate.lever_arm_sigma_m) if estimate.lever_arm else 0.0
    return {
        "gnss_error": float(gnss.use and gnss.lasting_share > 0.0),
        "pose_error": float(pose.use and pose.lasting_share > 0.0),
        "pose_yaw": math.radians(pose.yaw_offset_sigma_deg) if pose.use else 0.0,
        "gyro_scale": 1e-6 * (vehicle.imu.gyro_scale_ppm or scale),
        "gyro_misalignment": math.radians(known or skew),
        "gnss_arm": arm if gnss.use else 0.0,
        "mounting": math.radians(estimate.mounting_sigma_deg) if estimate.mounting and vehicle.land_vehicle else 0.0,
        "gnss_delay": estimate.delay_sigma_s if gnss.use and estimate.gnss_delay else 0.0,
        "pose_delay": estimate.delay_sigma_s if pose.use and estimate.pose_delay else 0.0,
    }
