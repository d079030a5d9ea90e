"""Random fields over the plane of a drive: hills, crossfall, and the errors of the map, each a sum of plane waves.

A field is a function of the place alone, so it is the same whenever the same place is passed and has no steps anywhere.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.simulate import _road_kernels

Floats = NDArray[np.float64]
Rng = np.random.Generator

BIAS_SCALE_M = 300.0
"""Distance at which the correlation of the map's errors has fallen to 1/e, m."""
BIAS_WAVES = 64
"""Waves in each error of the map: other parts of the network correlate by about 1/sqrt(2 BIAS_WAVES)."""
HILL_WAVES = 6
"""Waves in the hills and in the crossfall."""
_MATERN_3_2 = 2.146193
"""(1 + x) exp(-x) is 1/e here."""


@dataclass(frozen=True, slots=True, eq=False)
class Waves:
    """Sum of a cos(kx x + ky y + phase). amplitude, phase: (W,); number: (W, 2) 1/m."""

    amplitude: Floats
    number: Floats
    phase: Floats

    def at(self, xy: Floats) -> Floats:
        """(N,) values at places xy (N, 2) m."""
        values = np.empty(len(xy))
        _road_kernels.sum_of_waves(self.amplitude, self.number, self.phase, xy, values)
        return values


def hills(slope_max: float, rng: Rng) -> Waves:
    """Heights m with waves 250 m to 3 km long, nowhere steeper than slope_max."""
    share, number, phase = _long_waves(rng)
    return Waves(slope_max * share / np.linalg.norm(number, axis=1), number, phase)


def gentle(limit: float, rng: Rng) -> Waves:
    """Values within limit that change over 250 m to 3 km."""
    share, number, phase = _long_waves(rng)
    return Waves(limit * share, number, phase)


def map_errors(rng: Rng) -> tuple[Waves, Waves, Waves]:
    """Errors of a map along the road, to the left and in yaw, each of unit variance and independent of the others.

    The covariance is Matern's with smoothness 3/2, (1 + r/l) exp(-r/l), 1/e at BIAS_SCALE_M: a road of any shape leaves
    a place no faster than a straight one, so along a drive the correlation lasts at least as long.
    """
    along, left, yaw = (_matern(BIAS_SCALE_M / _MATERN_3_2, rng) for _ in range(3))
    return along, left, yaw


def _matern(scale_m: float, rng: Rng) -> Waves:
    """Waves drawn from the spectral density of the covariance, proportional to (1/l^2 + k^2)^(-5/2) in the plane."""
    # stratified, so that every draw has waves of all lengths
    share = (np.arange(BIAS_WAVES) + rng.random(BIAS_WAVES)) / BIAS_WAVES
    number = np.sqrt((1.0 - share) ** (-2.0 / 3.0) - 1.0) / scale_m
    amplitude = np.full(BIAS_WAVES, np.sqrt(2.0 / BIAS_WAVES))
    return Waves(amplitude, number[:, None] * _directions(BIAS_WAVES, rng), 2 * np.pi * rng.random(BIAS_WAVES))


def _long_waves(rng: Rng) -> tuple[Floats, Floats, Floats]:
    """Shares (W,) that sum to one, wave numbers (W, 2) 1/m and phases (W,)."""
    share = 0.5 + rng.random(HILL_WAVES)
    number = 2 * np.pi / (250.0 * 12.0 ** rng.random(HILL_WAVES))
    return share / share.sum(), number[:, None] * _directions(HILL_WAVES, rng), 2 * np.pi * rng.random(HILL_WAVES)


def _directions(count: int, rng: Rng) -> Floats:
    angle = 2 * np.pi * (np.arange(count) + rng.random(count)) / count
    return rng.permutation(np.stack((np.cos(angle), np.sin(angle)), axis=-1))
