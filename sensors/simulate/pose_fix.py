"""Simulated EgoVM pose fixes: map x, y, yaw with the covariance that the errors are drawn with."""

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sensors.bounds import Fraction, NonNegative, Positive, check_order
from sensors.geodesy import MapFrame, map_from_llh
from sensors.records import PoseFix
from sensors.rotation import wrap, yaw_from_q
from sensors.simulate.noise import Rng, correlated, delayed, gauss_markov
from sensors.simulate.reference import attitude_in_map
from sensors.simulate.trajectory import Motion
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]

GRID_M = 5.0
"""Spacing at which the varying longitudinal sigma is drawn along the road."""


class PoseFixSimulation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Map matching: sharp across the road, less so along it, blind along it where no landmark stands."""

    use: bool = True
    """Simulate pose fixes at all."""
    rate_hz: Positive = 10.0
    """Rate of the fixes, Hz."""
    phase_s: NonNegative = 0.03
    """First fix after the start (cameras do not share the IMU's clock), s."""
    delay_s: NonNegative = 0.12
    """From exposure to the fix's arrival, s."""
    jitter_s: NonNegative = 0.003
    """Standard deviation of that delay, s."""
    longitudinal_min_m: Positive = 0.03
    """Longitudinal sigma among many landmarks, m."""
    longitudinal_max_m: Positive = 0.10
    """Longitudinal sigma among few landmarks, m."""
    longitudinal_scale_m: Positive = 80.0
    """Distance over which the longitudinal sigma changes, m."""
    lateral_m: Positive = 0.03
    """Lateral sigma, m."""
    yaw_deg: Positive = 0.13
    """Yaw sigma, deg."""
    blind_per_hour: NonNegative = 24.0
    """How often the longitudinal direction is not observed, 1/h."""
    blind_min_s: Positive = 3.0
    """Shortest of these stretches, s."""
    blind_max_s: Positive = 9.0
    """Longest of these stretches, s."""
    blind_sigma_min_m: Positive = 0.5
    """Smallest longitudinal sigma there, m."""
    blind_sigma_max_m: Positive = 0.9
    """Largest longitudinal sigma there, m."""
    correlated_fraction: Fraction = 0.3
    """Share of each variance that is correlated in time (errors of the map); 0: white errors, -."""
    correlation_s: NonNegative = 2.0
    """Correlation time of that share, s."""

    def __post_init__(self) -> None:
        for name in ("longitudinal_{}_m", "blind_{}_s", "blind_sigma_{}_m"):
            check_order(self, name.format("min"), name.format("max"))


def simulate_pose_fixes(
    motion: Motion, frame: MapFrame, vehicle: Vehicle, config: PoseFixSimulation, rng: Rng
) -> PoseFix:
    """Fixes of the vehicle's pose point at every time of motion, covariance aligned with the true heading."""
    count, step_s = len(motion.t_ns), 1.0 / config.rate_hz
    yaw = yaw_from_q(attitude_in_map(motion, frame))
    sigmas = np.empty((count, 3))
    sigmas[:, 0] = _longitudinal_sigma(motion, config, rng)
    sigmas[:, 1], sigmas[:, 2] = config.lateral_m, np.radians(config.yaw_deg)
    unit = [correlated(rng, count, step_s, config.correlation_s, config.correlated_fraction) for _ in range(3)]
    axes = np.zeros((count, 3, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = np.cos(yaw)
    axes[:, 1, 0] = np.sin(yaw)
    axes[:, 0, 1] = -axes[:, 1, 0]
    axes[:, 2, 2] = 1.0
    pose = np.column_stack((map_from_llh(frame, motion.place_of(vehicle.pose_lever_arm))[:, :2], yaw))
    pose += (axes @ (sigmas * np.stack(unit, axis=-1))[..., None])[..., 0]
    pose[:, 2] = wrap(pose[:, 2])
    root = axes * sigmas[:, None, :]
    arrival_ns = delayed(motion.t_ns, config.delay_s, config.jitter_s, rng)
    return PoseFix(motion.t_ns, arrival_ns, pose, root @ np.swapaxes(root, 1, 2))


def _longitudinal_sigma(motion: Motion, config: PoseFixSimulation, rng: Rng) -> Floats:
    """(N,) m: log-uniform along the road, much larger on blind stretches."""
    seconds = (motion.t_ns - motion.t_ns[:1]) * 1e-9
    moved = np.diff(seconds, prepend=0.0) * np.linalg.norm(motion.vel_enu, axis=1)
    along = np.cumsum(moved)
    nodes = int(along[-1] / GRID_M) + 2 if len(along) else 0
    landmarks = gauss_markov(rng, nodes, GRID_M, config.longitudinal_scale_m)
    scarcity = ndtr(np.interp(along, np.arange(nodes) * GRID_M, landmarks)) if nodes else along
    sigma = config.longitudinal_min_m * (config.longitudinal_max_m / config.longitudinal_min_m) ** scarcity
    for begin, end, blind_sigma in _blind_stretches(seconds[-1] if nodes else 0.0, config, rng):
        sigma[(seconds >= begin) & (seconds < end)] = blind_sigma
    return sigma


def _blind_stretches(duration_s: float, config: PoseFixSimulation, rng: Rng) -> NDArray[np.float64]:
    """(B, 3) begin s, end s and longitudinal sigma m of each stretch, at Poisson times."""
    begin = np.sort(rng.random(rng.poisson(config.blind_per_hour * duration_s / 3600)) * duration_s)
    length = rng.uniform(config.blind_min_s, config.blind_max_s, len(begin))
    sigma = rng.uniform(config.blind_sigma_min_m, config.blind_sigma_max_m, len(begin))
    return np.column_stack((begin, begin + length, sigma))
