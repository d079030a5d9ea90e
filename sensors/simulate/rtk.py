"""When an RTK solution is fixed, float or lost, and when it is wrong: its history over a drive."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.clock import seconds
from sensors.records import GnssStatus
from sensors.simulate.course import Course
from sensors.simulate.encounters import Episodes, lasting, met, stretches
from sensors.simulate.gnss_config import GnssSimulation

Floats = NDArray[np.float64]
Rng = np.random.Generator


class Solution(NamedTuple):
    """status: (N,) GnssStatus; offset_enu: (N, 3) m, by which reflections or wrong ambiguities displace it."""

    status: NDArray[np.int8]
    offset_enu: Floats


class _Displaced(NamedTuple):
    """Episodes (E,) and the offset (E, 3) of each, m."""

    episodes: Episodes
    offset_enu: Floats

    def at(self, x: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        row, now = self.episodes.at(x)
        offset = np.zeros((len(x), 3))
        offset[now] = self.offset_enu[row[now]]
        return offset, now


class RtkHistory:
    """Fixed, unless something happens: losses and blocked stretches end in float, reflections come in float."""

    def __init__(self, course: Course, config: GnssSimulation, rng: Rng) -> None:
        """Draws everything that happens on the course."""
        self._start_ns = int(course.t_ns[0])
        lost = lasting(met(course, lambda e: config.lost_per_hour + e.sky.lost_per_hour, rng), config.lost_s, rng)
        self._lost = _merged(lost, _blocked(course))
        refixing = Episodes(self._lost.end, self._lost.end + rng.exponential(config.refix_s, len(self._lost.end)))
        fallen = met(course, lambda e: config.float_per_hour + e.sky.float_per_hour, rng)
        self._float = _merged(lasting(fallen, config.float_s, rng), refixing)
        self._reflected = _reflections(course, config, rng)
        self._wrong = _wrong_fixes(course, config, rng)

    def at(self, t_ns: NDArray[np.int64]) -> Solution:
        """What the receiver has at t_ns (N,)."""
        t = seconds(t_ns, self._start_ns)
        offset, reflected = self._reflected.at(t)
        wrong, is_wrong = self._wrong.at(t)
        status = np.full(len(t), GnssStatus.FIXED, np.int8)
        status[self._float.at(t)[1] | reflected] = GnssStatus.FLOAT
        offset = np.where((is_wrong & (status == GnssStatus.FIXED))[:, None], wrong, offset)
        status[self._lost.at(t)[1]] = GnssStatus.NONE
        return Solution(status, offset)


def _merged(one: Episodes, other: Episodes) -> Episodes:
    """Both, as a union without overlaps."""
    begin, end = (np.concatenate(pair) for pair in zip(one, other, strict=True))
    order = np.argsort(begin, kind="stable")
    begin, end = begin[order], np.maximum.accumulate(end[order])
    new = np.ones(len(begin), bool)
    new[1:] = begin[1:] > end[:-1]
    last = np.append(new[1:], True) if len(new) else new
    return Episodes(begin[new], end[last])


def _blocked(course: Course) -> Episodes:
    """Stretches without any signal."""
    way = stretches(course)
    hidden = np.array([environment.sky.blocked for environment in course.environments])[way.kind]
    return Episodes(way.time[:-1][hidden], way.time[1:][hidden])


def _reflections(course: Course, config: GnssSimulation, rng: Rng) -> _Displaced:
    """Jumps by the detour of a reflected signal: a distance of two exponential parts in any direction."""
    episodes = lasting(met(course, lambda e: e.sky.multipath_per_hour, rng), config.multipath_s, rng)
    place = np.interp(episodes.begin, seconds(course.t_ns, course.t_ns[0]), course.s)
    scale = np.array([e.sky.multipath_m for e in course.environments])[course.environment(place)]
    count = len(place)
    distance, angle = scale * rng.gamma(2.0, 0.5, count), rng.uniform(0.0, 2 * np.pi, count)
    up = config.vertical_ratio * scale * 0.5 * rng.standard_normal(count)
    return _Displaced(episodes, np.stack((distance * np.cos(angle), distance * np.sin(angle), up), axis=-1))


def _wrong_fixes(course: Course, config: GnssSimulation, rng: Rng) -> _Displaced:
    """Ambiguities fixed to wrong integers, until they are fixed again."""
    begin = met(course, lambda e: config.wrong_fix_per_hour + e.sky.wrong_fix_per_hour, rng)
    episodes = lasting(begin, config.wrong_fix_s, rng)
    sigma = config.wrong_fix_m * np.array([1.0, 1.0, config.vertical_ratio])
    return _Displaced(episodes, sigma * rng.standard_normal((len(begin), 3)))
