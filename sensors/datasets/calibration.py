"""What a recording does not tell of itself, estimated from its first half: clock offset, mounting, rear axle.

Only the first half of a drive is used, so that the second half can judge the result.
"""

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.datasets.clock_offset import ClockOffset, estimate_clock_offset, velocity_lag
from sensors.datasets.inertial_fit import Strapdown, Window, fit_window, moving_windows, strapdown
from sensors.datasets.mounting import Mounting, estimate_mounting
from sensors.errors import EgolocError
from sensors.geodesy import enu_from_llh
from sensors.records import GnssFix, GnssVelocity, Imu
from sensors.vehicle import Vector3

Floats = NDArray[np.float64]

log = logging.getLogger(__name__)

CLOCK_WINDOW_S = 6.0
"""Length of the windows for the clock: long enough for a few turns or stops, short against bias drift."""
MOUNTING_WINDOW_S = 8.0
"""Length of the windows for the mounting, which need the heading; they overlap by half."""
MIN_SPEED_CHANGE = 1.5
"""A window whose speed changes less says little about time and heading, m/s."""
MAX_CLOCK_SIGMA_S = 0.02
"""An offset less certain than this, or within two of its sigmas of zero, is not applied."""
MIN_HALF_NS = 30_000_000_000
"""Less than this shows nothing."""
MAX_AXIS_SIGMA_DEG = 3.0
"""A mounting less certain than this is not applied."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Estimates, None where the drive does not show them."""

    position_clock: ClockOffset | None
    velocity_delay_s: float
    mounting: Mounting | None

    @property
    def position_delay_s(self) -> float:
        """Delay of positions, 0 where it is not known."""
        return 0.0 if self.position_clock is None else self.position_clock.delay_s

    @property
    def rear_axle(self) -> Vector3:
        """Rear axle in body axes, at the IMU unless it is significantly behind or ahead."""
        m = self.mounting
        if m is None or abs(m.ahead_m) < 2 * m.ahead_sigma_m:
            return (0.0, 0.0, 0.0)
        return (round(-m.ahead_m, 2), 0.0, 0.0)


def calibrate(imu: Imu, gnss: GnssFix, velocity: GnssVelocity, noise_m: float) -> Calibration:
    """Estimates from the first half of the time that IMU and GNSS share; imu in its own axes, one velocity per fix.

    noise_m: short-term noise of a position; slow errors are taken up by the free start of each window.
    """
    first = max(imu.t_ns[0], gnss.t_ns[0])
    middle = first + (min(imu.t_ns[-1], gnss.t_ns[-1]) - first) // 2
    if middle - first < MIN_HALF_NS:
        log.info("IMU and GNSS share less than a minute: nothing is estimated")
        return Calibration(None, 0.0, None)
    path = strapdown(imu[imu.t_ns <= middle])
    rows = (gnss.t_ns >= first) & (gnss.t_ns <= middle)
    gnss, velocity = gnss[rows], velocity[rows]
    enu = enu_from_llh(gnss.llh, gnss.llh[0])
    sigma = noise_m * np.broadcast_to([1.0, 1.0, 2.0], enu.shape)
    speed = np.hypot(*velocity.vel_enu[:, :2].T)
    clock = _clock(path, gnss.t_ns, enu, sigma, speed)
    delay = 0.0 if clock is None else clock.delay_s
    lag = velocity_lag(gnss.t_ns, enu, velocity.vel_enu)
    mounting = _mounting(path, imu.gyro[imu.t_ns <= middle], gnss.t_ns, enu, sigma, speed, delay)
    return Calibration(clock, delay + lag, mounting)


def _clock(path: Strapdown, t_ns: NDArray[np.int64], enu: Floats, sigma: Floats, speed: Floats) -> ClockOffset | None:
    windows = moving_windows(t_ns, speed, CLOCK_WINDOW_S, MIN_SPEED_CHANGE)
    try:
        clock = estimate_clock_offset(path, t_ns, enu, sigma, windows, "position")
    except EgolocError as error:
        log.info("%s; no delay is applied", error)
        return None
    applied = 2 * clock.sigma_s < min(abs(clock.delay_s), 2 * MAX_CLOCK_SIGMA_S)
    text = "GNSS positions are true %.3f s (sigma %.3f s) before their stamp on the IMU's clock: %s"
    log.info(text, clock.delay_s, clock.sigma_s, "applied" if applied else "not certain enough, not applied")
    return clock if applied else None


def _mounting(
    path: Strapdown,
    gyro: Floats,
    t_ns: NDArray[np.int64],
    enu: Floats,
    sigma: Floats,
    speed: Floats,
    delay_s: float,
) -> Mounting | None:
    windows = moving_windows(t_ns, speed, MOUNTING_WINDOW_S, MIN_SPEED_CHANGE, MOUNTING_WINDOW_S / 2)
    found = (fit_window(path, t_ns, enu, sigma, rows, delay_s, "position") for rows in windows)
    fits: list[Window] = [fit for fit in found if fit is not None]
    try:
        mounting = estimate_mounting(path, gyro, t_ns, delay_s, fits)
    except EgolocError as error:
        log.info("%s", error)
        return None
    log.info("mounting: yaw and pitch to %.1f and %.1f deg, %d windows", *mounting.sigma_deg, mounting.windows)
    return mounting if max(mounting.sigma_deg) < MAX_AXIS_SIGMA_DEG else None
