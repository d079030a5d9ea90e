"""What befalls map matching on a drive: blind and degenerate stretches, look-alikes, gross errors, missing frames."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.simulate.course import Course
from sensors.simulate.events import Episodes, lasting, met
from sensors.simulate.pose_fix_config import PoseFixSimulation

Floats = NDArray[np.float64]
Rng = np.random.Generator

HALF_WINDOW = np.sqrt(3.0)
"""Half the width of a uniform distribution over its sigma."""


class _Drawn(NamedTuple):
    """Episodes (E,) with numbers (E, ...) of each."""

    episodes: Episodes
    numbers: Floats


class MatchingHistory:
    """Errors that are not noise. Times are s since the course's start, places m along it."""

    def __init__(self, course: Course, config: PoseFixSimulation, rng: Rng, modes_rng: Rng) -> None:
        """Draws everything that happens on the course; modes_rng: its numbers go to what fixes tell of second modes."""
        self._config = config
        self._blind = _blind(course, config, rng)
        self._degenerate = _degenerate(course, config, rng)
        self._dash = _aliases(met(course, lambda e: e.landmarks.dash_alias_per_km, rng, over_place=True), config, rng)
        self._lane = _aliases(met(course, lambda e: e.landmarks.lane_alias_per_km, rng, over_place=True), config, rng)
        gross = lasting(met(course, lambda e: config.gross_per_hour, rng), config.gross_s, rng)
        turn = rng.uniform(config.gross_yaw_min_deg, config.gross_yaw_max_deg, len(gross.begin))
        turn = np.radians(turn) * rng.choice((-1.0, 1.0), len(turn))
        shift = config.gross_longitudinal_m * rng.standard_normal(len(turn))
        self._gross = _Drawn(gross, np.stack((shift, turn), axis=-1))
        self._burst = lasting(met(course, lambda e: config.burst_per_hour, rng), config.burst_s, rng)
        self._second = tuple(_second_modes(course, config, (self._dash, self._lane), modes_rng))

    def blind_sigma(self, t: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """(N,) longitudinal sigma m where it is blind, and where."""
        row, now = self._blind.episodes.at(t)
        return _pick(self._blind.numbers, row, now), now

    def upset(self, t: Floats, s: Floats, sigma: Floats, error: Floats) -> None:
        """Change the stated sigma (N, 3) and the error (N, 3), along, left and yaw, where something happens."""
        self._lose_landmarks(s, sigma, error)
        for axis, (alias, distance) in enumerate(zip((self._dash, self._lane), _distances(self._config), strict=True)):
            row, now = alias.episodes.at(s)
            side, weight = _pick(alias.numbers, row, now).T
            error[:, axis] += side * distance
            if self._config.alias_covariance == "both":
                sigma[:, axis] = np.sqrt(sigma[:, axis] ** 2 + weight * (1.0 - weight) * distance**2)
        row, now = self._gross.episodes.at(t)
        error[:, [0, 2]] += _pick(self._gross.numbers, row, now)

    def second_mode(self, s: Floats) -> Floats:
        """(N, 3) at places s (N,): m along and left from the fix to the second mode that it tells, and its mass."""
        second = np.zeros((len(s), 3))
        for drawn in self._second:
            row, now = drawn.episodes.at(s)
            told = _pick(drawn.numbers, row, now)
            second = np.where(told[:, 2:] > 0.0, told, second)
        return second

    def dropped(self, t: Floats) -> NDArray[np.bool_]:
        """Times (N,) within a burst of missing frames."""
        return self._burst.at(t)[1]

    def _lose_landmarks(self, s: Floats, sigma: Floats, error: Floats) -> None:
        """On degenerate stretches the fix is the prior, and its sigma the window's of the level that is flat."""
        row, now = self._degenerate.episodes.at(s)
        if not now.any():
            return
        window, drift, sharpness = self._degenerate.numbers[row[now]].T
        drifted = drift * (s[now] - self._degenerate.episodes.begin[row[now]])
        error[now, 0] = np.clip(drifted, -HALF_WINDOW * window, HALF_WINDOW * window)
        sigma[now, 0] = sharpness * window


def _pick(numbers: Floats, row: NDArray[np.intp], now: NDArray[np.bool_]) -> Floats:
    """(N, ...) numbers of the episode where one lasts, else 0."""
    picked = np.zeros((len(row), *numbers.shape[1:]))
    picked[now] = numbers[row[now]]
    return picked


def _blind(course: Course, config: PoseFixSimulation, rng: Rng) -> _Drawn:
    begin = met(course, lambda e: config.blind_per_hour, rng)
    length = rng.uniform(config.blind_min_s, config.blind_max_s, len(begin))
    sigma = rng.uniform(config.blind_sigma_min_m, config.blind_sigma_max_m, len(begin))
    return _Drawn(Episodes(begin, begin + length), sigma)


def _degenerate(course: Course, config: PoseFixSimulation, rng: Rng) -> _Drawn:
    """Numbers (E, 3): sigma of the window m, drift of the prior m/m, stated sigma over the window's."""
    begin = met(course, lambda e: e.landmarks.degenerate_per_km, rng, over_place=True)
    mean = np.array([e.landmarks.degenerate_m for e in course.environments])[course.environment(begin)]
    shares = np.array(config.flat_shares)
    window = rng.choice(config.window_sigmas_m, len(begin), p=shares / shares.sum())
    drift = config.prior_drift * rng.standard_normal(len(begin))
    sharpness = rng.uniform(0.9, 1.0, len(begin))
    episodes = Episodes(begin, begin + mean * rng.exponential(1.0, len(begin)))
    return _Drawn(episodes, np.stack((window, drift, sharpness), axis=-1))


def _aliases(begin: Floats, config: PoseFixSimulation, rng: Rng) -> _Drawn:
    """Numbers (E, 2): side -1 or 1, and how much of the posterior lies in the wrong of its two modes.

    The fix is the heavier mode; the stated covariance is that of both.
    """
    weight = rng.uniform(0.5, 1.0, len(begin))
    side = rng.choice((-1.0, 1.0), len(begin))
    return _Drawn(lasting(begin, config.alias_m, rng), np.stack((side, weight), axis=-1))


def _distances(config: PoseFixSimulation) -> tuple[float, float]:
    """To the next look-alike along the road and to the left, m."""
    return config.dash_pitch_m, config.lane_width_m


def _second_modes(
    course: Course, config: PoseFixSimulation, aliases: tuple[_Drawn, _Drawn], rng: Rng
) -> Iterator[_Drawn]:
    """Numbers (E, 3): from the fix to its second mode along and left, m, and that mode's mass, 0 where it is not told.

    At a twin the fix is right; at an alias the truth is the second mode. Where both are, the last ones count.
    """
    rates = (lambda e: e.landmarks.dash_twin_per_km, lambda e: e.landmarks.lane_twin_per_km)
    twins = [_aliases(met(course, rate, rng, over_place=True), config, rng) for rate in rates]
    told = [rng.random(len(alias.numbers)) < config.alias_modes_fraction for alias in aliases]
    every = [np.ones(len(twin.numbers), np.bool_) for twin in twins]
    for drawn, sign, known in ((twins, 1.0, every), (aliases, -1.0, told)):
        for axis, distance in enumerate(_distances(config)):
            side, weight = drawn[axis].numbers.T
            numbers = np.zeros((len(side), 3))
            numbers[:, axis] = sign * distance * side
            numbers[:, 2] = np.where(known[axis], 1.0 - weight, 0.0)
            yield _Drawn(drawn[axis].episodes, numbers)
