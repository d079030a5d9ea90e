"""Simulated GNSS-RTK: fixed, float and lost stretches, time-correlated errors, honest covariances."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.bounds import Fraction, NonNegative, Positive
from sensors.geodesy import ecef_from_llh, llh_from_ecef, rotation_ecef_enu
from sensors.records import GnssFix, GnssStatus, GnssVelocity
from sensors.rotation import wrap, yaw_from_q
from sensors.simulate.noise import Rng, correlated, delayed
from sensors.simulate.trajectory import Motion
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]


class GnssSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An RTK receiver: fixed solutions alternate at random with float ones and with losses, which end in float."""

    use: bool = True
    """Simulate GNSS at all."""
    rate_hz: Positive = 10.0
    """Rate of positions and velocities, Hz."""
    delay_s: NonNegative = 0.05
    """From measurement to arrival, s."""
    jitter_s: NonNegative = 0.002
    """Standard deviation of that delay, s."""
    float_per_hour: NonNegative = 18.0
    """How often a fixed solution falls back to float, 1/h."""
    float_s: Positive = 6.0
    """Mean length of a float stretch, s."""
    lost_per_hour: NonNegative = 12.0
    """How often the solution is lost, 1/h."""
    lost_s: Positive = 5.0
    """Mean length of a loss, without any message, s."""
    refix_s: Positive = 4.0
    """Mean time in float after a loss, s."""
    fixed_sigma_m: Positive = 0.015
    """Fixed solution, each horizontal axis, m."""
    float_sigma_m: Positive = 0.4
    """Float solution, each horizontal axis, m."""
    vertical_ratio: Positive = 1.8
    """Vertical sigma over horizontal sigma, -."""
    correlated_fraction: Fraction = 0.7
    """Share of the position's variance that is correlated in time; 0: white errors, -."""
    correlation_s: NonNegative = 30.0
    """Correlation time of that share (first-order Gauss-Markov), s."""
    velocity_sigma: Positive = 0.03
    """Each horizontal axis of velocity, white, m/s."""
    velocity_vertical_sigma: Positive = 0.05
    """Vertical velocity, white, m/s."""
    dual_antenna: bool = False
    """Fixed solutions carry a heading from a second antenna."""
    yaw_sigma_deg: Positive = 0.2
    """That heading, white, deg."""


def simulate_gnss(motion: Motion, vehicle: Vehicle, config: GnssSimulation, rng: Rng) -> tuple[GnssFix, GnssVelocity]:
    """Positions and velocities of the antenna where the solution is not lost; motion: truth at the GNSS epochs.

    The stated covariance is the variance the errors are drawn with. float_sigma_m scales the same correlated process as
    fixed_sigma_m, so errors jump where the status changes, as a receiver's do.
    """
    status = rtk_schedule(motion.t_ns, config, rng)
    step_s = 1.0 / config.rate_hz
    sigma = np.where(status == GnssStatus.FIXED, config.fixed_sigma_m, config.float_sigma_m)
    sigmas = sigma[:, None] * np.array([1.0, 1.0, config.vertical_ratio])
    unit = [correlated(rng, len(status), step_s, config.correlation_s, config.correlated_fraction) for _ in range(3)]
    llh = displaced(motion.place_of(vehicle.gnss_lever_arm), sigmas * np.stack(unit, axis=-1))
    velocity_sigmas = np.array([config.velocity_sigma, config.velocity_sigma, config.velocity_vertical_sigma])
    vel_enu = motion.velocity_of(vehicle.gnss_lever_arm)
    vel_enu = vel_enu + velocity_sigmas * rng.standard_normal(vel_enu.shape)
    yaw, yaw_sigma = _heading(motion, status, config, rng)
    arrival_ns = delayed(motion.t_ns, config.delay_s, config.jitter_s, rng)
    cov = sigmas[:, :, None] ** 2 * np.eye(3)
    velocity_cov = np.broadcast_to(np.diag(velocity_sigmas**2), cov.shape)
    have = status > GnssStatus.NONE
    fixes = GnssFix(motion.t_ns, arrival_ns, llh, cov, status, yaw, yaw_sigma)[have]
    return fixes, GnssVelocity(motion.t_ns, arrival_ns, vel_enu, velocity_cov)[have]


def rtk_schedule(t_ns: NDArray[np.int64], config: GnssSimulation, rng: Rng) -> NDArray[np.int8]:
    """(N,) GnssStatus at t_ns: a continuous-time Markov chain that begins fixed; NONE is a loss."""
    if len(t_ns) == 0:
        return np.empty(0, np.int8)
    duration_s = (t_ns[-1] - t_ns[0]) * 1e-9
    upsets_per_s = (config.float_per_hour + config.lost_per_hour) / 3600
    begins, states = [0.0], [GnssStatus.FIXED]
    at = rng.exponential(1 / upsets_per_s) if upsets_per_s else np.inf
    while at < duration_s:
        if rng.random() * upsets_per_s * 3600 < config.lost_per_hour:
            begins.append(at)
            states.append(GnssStatus.NONE)
            at += rng.exponential(config.lost_s)
            mean_float_s = config.refix_s
        else:
            mean_float_s = config.float_s
        begins += [at, at + rng.exponential(mean_float_s)]
        states += [GnssStatus.FLOAT, GnssStatus.FIXED]
        at = begins[-1] + rng.exponential(1 / upsets_per_s)
    row = np.searchsorted(begins, (t_ns - t_ns[0]) * 1e-9, side="right") - 1
    result: NDArray[np.int8] = np.array(states, np.int8)[row]
    return result


def displaced(llh: Floats, offset_enu: Floats) -> Floats:
    """(N, 3) places offset_enu (N, 3) m away from llh (N, 3)."""
    return llh_from_ecef(ecef_from_llh(llh) + (rotation_ecef_enu(llh) @ offset_enu[..., None])[..., 0])


def _heading(motion: Motion, status: NDArray[np.int8], config: GnssSimulation, rng: Rng) -> tuple[Floats, Floats]:
    """Dual-antenna yaw and its sigma, rad, NaN where there is none."""
    sigma = np.radians(config.yaw_sigma_deg)
    have = (status == GnssStatus.FIXED) & config.dual_antenna
    yaw = wrap(yaw_from_q(motion.q_enu_body) + sigma * rng.standard_normal(len(status)))
    return np.where(have, yaw, np.nan), np.where(have, sigma, np.nan)
