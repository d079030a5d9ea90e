"""Simulated EgoVM pose fixes: map x, y, yaw with the covariance that a network would state."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sensors.clock import seconds
from sensors.geodesy import MapFrame, map_from_llh
from sensors.records import PoseFix
from sensors.rotation import wrap
from sensors.simulate.course import Course
from sensors.simulate.matching import MatchingHistory
from sensors.simulate.noise import Delay, GaussMarkov, Rng, gauss_markov
from sensors.simulate.pose_fix_config import PoseFixSimulation
from sensors.simulate.reference import yaw_in_map
from sensors.simulate.trajectory import Motion
from sensors.vehicle import Vehicle

Floats = NDArray[np.float64]

GRID_M = 5.0
"""Spacing at which sigmas and the errors bound to the place are drawn along the road."""


class PoseFixSensor:
    """Map matching over one drive, some frames at a time.

    Without the events of MatchingHistory the stated covariance is the variance that the errors are drawn with: a share
    from the map, one bound to the place in this drive, one correlated in time, the rest white. While the vehicle
    stands, what is bound to the place stands still.
    """

    def __init__(
        self,
        course: Course,
        frame: MapFrame,
        vehicle: Vehicle,
        config: PoseFixSimulation,
        rng: Rng,
        *,
        night: bool = False,
    ) -> None:
        """rng: its numbers go to what happens on the course, then to noise frame by frame."""
        self._course, self._frame, self._vehicle, self._config = course, frame, vehicle, config
        self._night = config.night_factor if night else 1.0
        happening, slow, self._white, late, self._frames, modes = rng.spawn(6)
        self._history = MatchingHistory(course, config, happening, modes)
        nodes = int((course.s[-1] - course.s[0]) / GRID_M) + 2
        self._nodes = course.s[0] + GRID_M * np.arange(nodes)
        self._log_sigma = _log_sigmas(nodes, config, happening)
        self._features = GaussMarkov(happening, 3, GRID_M, config.feature_scale_m).rows(nodes)
        self._scarcity = np.array([e.landmarks.scarcity for e in course.environments])
        self._slow = GaussMarkov(slow, 3, 1.0 / config.rate_hz, config.correlation_s)
        self._delay = Delay(config.delay_s, config.jitter_s, late)

    def sense(self, motion: Motion) -> PoseFix:
        """Fixes of the vehicle's pose point; motion: truth at the next frames. Dropped frames are left out."""
        config, t_ns = self._config, motion.t_ns
        t, s = seconds(t_ns, self._course.t_ns[0]), self._course.place(t_ns)
        sigma = self._sigmas(t, s)
        error = sigma * self._unit_errors(s)
        offset = np.radians(config.yaw_offset_deg)
        error[:, 2] += offset
        sigma[:, 2] = np.hypot(sigma[:, 2], offset)
        self._history.upset(t, s, sigma, error)
        dropped = (self._frames.random(len(t)) < config.dropped_fraction) | self._history.dropped(t)
        place = map_from_llh(self._frame, motion.place_of(self._vehicle.pose_lever_arm))
        yaw = yaw_in_map(motion, self._frame)
        fixes = _fixes(t_ns, self._delay.arrivals(t_ns), place, yaw, sigma, error)
        fixes = _with_modes(fixes, yaw, self._history.second_mode(s))
        return fixes[~dropped] if dropped.any() else fixes

    def _sigmas(self, t: Floats, s: Floats) -> Floats:
        """(N, 3) m, m, rad, as the scene allows."""
        sigma: Floats = np.exp(np.stack([np.interp(s, self._nodes, column) for column in self._log_sigma.T], axis=-1))
        sigma[:, 0] *= self._scarcity[self._course.environment(s)]
        sigma *= self._night
        blind_sigma, blind = self._history.blind_sigma(t)
        sigma[blind, 0] = blind_sigma[blind]
        return sigma

    def _unit_errors(self, s: Floats) -> Floats:
        """(N, 3) of unit variance."""
        config = self._config
        timed, mapped, seen = config.correlated_fraction, config.map_fraction, config.feature_fraction
        unit: Floats = np.sqrt(max(1.0 - timed - mapped - seen, 0.0)) * self._white.standard_normal((len(s), 3))
        unit += np.sqrt(timed) * self._slow.rows(len(s))
        if mapped:
            unit += np.sqrt(mapped) * self._course.map_bias(s)
        if seen:
            features = [np.interp(s, self._nodes, column) for column in self._features.T]
            unit += np.sqrt(seen) * np.stack(features, axis=-1)
        return unit


def _log_sigmas(nodes: int, config: PoseFixSimulation, rng: Rng) -> Floats:
    """(nodes, 3) logarithm of the sigmas m, m, rad: longitudinal evenly between its ends, the others normal."""
    low, high = np.log(config.longitudinal_min_m), np.log(config.longitudinal_max_m)
    along = low + (high - low) * ndtr(gauss_markov(rng, nodes, GRID_M, config.longitudinal_scale_m))
    spread = GaussMarkov(rng, 2, GRID_M, config.spread_scale_m).rows(nodes)
    left = np.log(config.lateral_m) + config.lateral_spread * spread[:, 0]
    yaw = np.log(np.radians(config.yaw_deg)) + config.yaw_spread * spread[:, 1]
    return np.stack((along, left, yaw), axis=-1)


def _fixes(
    t_ns: NDArray[np.int64], arrival_ns: NDArray[np.int64], place: Floats, yaw: Floats, sigma: Floats, error: Floats
) -> PoseFix:
    """Fixes with errors and sigmas (N, 3) along, left and in yaw of a vehicle at place (N, 3) with yaw (N,)."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    along, left, turn = error.T
    x = place[:, 0] + cosine * along - sine * left
    y = place[:, 1] + sine * along + cosine * left
    variance = sigma**2
    cov = np.zeros((len(t_ns), 3, 3))
    cov[:, 0, 0] = cosine**2 * variance[:, 0] + sine**2 * variance[:, 1]
    cov[:, 1, 1] = sine**2 * variance[:, 0] + cosine**2 * variance[:, 1]
    cov[:, 0, 1] = cov[:, 1, 0] = cosine * sine * (variance[:, 0] - variance[:, 1])
    cov[:, 2, 2] = variance[:, 2]
    return PoseFix(t_ns, arrival_ns, np.stack((x, y, wrap(yaw + turn)), axis=-1), cov)


def _with_modes(fixes: PoseFix, yaw: Floats, second: Floats) -> PoseFix:
    """The fixes with second modes: second (N, 3) m along and left of the true yaw (N,), and their mass, 0: none."""
    along, left, mass = second.T
    if not mass.any():
        return fixes
    cosine, sine = np.cos(yaw), np.sin(yaw)
    modes = np.stack((fixes.pose, fixes.pose), axis=1)
    modes[:, 1, 0] += cosine * along - sine * left
    modes[:, 1, 1] += sine * along + cosine * left
    modes[mass == 0.0] = np.nan
    return replace(
        fixes, modes=modes, weights=np.where(mass[:, None] > 0.0, np.stack((1.0 - mass, mass), axis=-1), 0.0)
    )
