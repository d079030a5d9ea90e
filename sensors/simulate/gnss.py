"""Simulated GNSS-RTK: fixed, float, wrong and lost solutions, correlated errors, covariances as receivers state."""

import numpy as np
from numpy.typing import NDArray

from sensors.geodesy import ecef_from_llh, llh_from_ecef, rotation_ecef_enu
from sensors.records import GnssFix, GnssStatus, GnssVelocity
from sensors.rotation import wrap, yaw_from_q
from sensors.simulate import _sensor_kernels
from sensors.simulate.course import Course
from sensors.simulate.gnss_config import GnssSimulation
from sensors.simulate.noise import Delay, GaussMarkov, Rng
from sensors.simulate.rtk import RtkHistory
from sensors.simulate.trajectory import Motion
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]


class GnssSensor:
    """A receiver over one drive, some epochs at a time.

    The stated covariance is the variance that the errors of a fixed or float solution are drawn with; reflections and
    wrong ambiguities are not in it, as receivers do not know of them. float_sigma_m scales the same correlated process
    as fixed_sigma_m, so errors jump where the status changes.
    """

    def __init__(self, course: Course, vehicle: Vehicle, config: GnssSimulation, rng: Rng) -> None:
        """rng: its numbers go to what happens on the course, then to noise epoch by epoch."""
        self._vehicle, self._config = vehicle, config
        happening, slow, self._noise, late = rng.spawn(4)
        self._history = RtkHistory(course, config, happening)
        self._slow = GaussMarkov(slow, 3, 1.0 / config.rate_hz, config.correlation_s)
        self._delay = Delay(config.delay_s, config.jitter_s, late)

    def sense(self, motion: Motion) -> tuple[GnssFix, GnssVelocity]:
        """Positions and velocities of the antenna where the solution is not lost; motion: truth at the next epochs."""
        config, count = self._config, len(motion.t_ns)
        status, offset, doppler = self._history.at(motion.t_ns)
        sigma = np.where(status == GnssStatus.FIXED, config.fixed_sigma_m, config.float_sigma_m)
        sigmas = sigma[:, None] * np.array([1.0, 1.0, config.vertical_ratio])
        noise = self._noise.standard_normal((count, 7))
        share = config.correlated_fraction
        unit = np.sqrt(share) * self._slow.rows(count) + np.sqrt(1.0 - share) * noise[:, :3]
        velocity_sigmas = np.array([config.velocity_sigma, config.velocity_sigma, config.velocity_vertical_sigma])
        llh, vel_enu = motion.llh.copy(), motion.vel_enu.copy()
        _sensor_kernels.move_to_point(
            llh,
            vel_enu,
            motion.q_enu_body,
            motion.rate,
            np.array(self._vehicle.gnss_lever_arm),
            sigmas * unit + offset,
            velocity_sigmas * noise[:, 3:6] + doppler * np.linalg.norm(motion.vel_enu, axis=1)[:, None],
        )
        yaw, yaw_sigma = self._heading(motion, status, noise[:, 6])
        arrival_ns = self._delay.arrivals(motion.t_ns)
        cov = sigmas[:, :, None] ** 2 * np.eye(3)
        velocity_cov = np.broadcast_to(np.diag(velocity_sigmas**2), cov.shape)
        have = status > GnssStatus.NONE
        fixes = GnssFix(motion.t_ns, arrival_ns, llh, cov, status, yaw, yaw_sigma)
        velocities = GnssVelocity(motion.t_ns, arrival_ns, vel_enu, velocity_cov)
        return (fixes, velocities) if have.all() else (fixes[have], velocities[have])

    def _heading(self, motion: Motion, status: NDArray[np.int8], noise: Floats) -> tuple[Floats, Floats]:
        """Dual-antenna yaw and its sigma, rad, NaN where there is none."""
        sigma = np.radians(self._config.yaw_sigma_deg)
        have = (status == GnssStatus.FIXED) & self._config.dual_antenna
        if not have.any():
            return np.full(len(status), np.nan), np.full(len(status), np.nan)
        yaw = wrap(yaw_from_q(motion.q_enu_body) + sigma * noise)
        return np.where(have, yaw, np.nan), np.where(have, sigma, np.nan)


def displaced(llh: Floats, offset_enu: Floats) -> Floats:
    """(N, 3) places offset_enu (N, 3) m away from llh (N, 3)."""
    return llh_from_ecef(ecef_from_llh(llh) + (rotation_ecef_enu(llh) @ offset_enu[..., None])[..., 0])
