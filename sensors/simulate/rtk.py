"""When an RTK solution is fixed, float or lost, and when it is wrong: its history over a drive."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.clock import seconds
from sensors.records import GnssStatus
from sensors.simulate.course import Course
from sensors.simulate.events import Episodes, lasting, met, passage
from sensors.simulate.gnss_config import GnssSimulation

Floats = NDArray[np.float64]
Rng = np.random.Generator


class Solution(NamedTuple):
    """status: (N,) GnssStatus; offset_enu: (N, 3) m, by which reflections or wrong ambiguities displace the position;
    doppler_enu: (N, 3), by which reflections change the velocity, as a share of the speed."""

    status: NDArray[np.int8]
    offset_enu: Floats
    doppler_enu: Floats


class _Displaced(NamedTuple):
    """Episodes (E,) and the offset (E, 3) m of each, its velocity error (E, 3) as a share of the speed."""

    episodes: Episodes
    offset_enu: Floats
    doppler_enu: Floats

    def at(self, x: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        row, now = self.episodes.at(x)
        offset, doppler = np.zeros((len(x), 3)), np.zeros((len(x), 3))
        offset[now], doppler[now] = self.offset_enu[row[now]], self.doppler_enu[row[now]]
        return offset, doppler, now


class RtkHistory:
    """Fixed, unless something happens: losses, blocked stretches and reflections end in float; a wrong fix ends where
    any of these begins."""

    def __init__(self, course: Course, config: GnssSimulation, rng: Rng) -> None:
        """Draws everything that happens on the course."""
        self._start_ns = int(course.t_ns[0])
        lost = lasting(met(course, lambda e: config.lost_per_hour + e.sky.lost_per_hour, rng), config.lost_s, rng)
        self._lost = _merged(lost, _blocked(course))
        self._reflected = _reflections(course, config, rng)
        gone = np.sort(np.concatenate((self._lost.end, self._reflected.episodes.end)))
        refixing = Episodes(gone, gone + rng.exponential(config.refix_s, len(gone)))
        fallen = met(course, lambda e: config.float_per_hour + e.sky.float_per_hour, rng)
        self._float = _merged(lasting(fallen, config.float_s, rng), refixing)
        broken = _merged(_merged(self._lost, self._reflected.episodes), self._float)
        self._wrong = _wrong_fixes(course, config, rng, broken)

    def at(self, t_ns: NDArray[np.int64]) -> Solution:
        """What the receiver has at t_ns (N,)."""
        t = seconds(t_ns, self._start_ns)
        offset, doppler, reflected = self._reflected.at(t)
        wrong, _, is_wrong = self._wrong.at(t)
        status = np.full(len(t), GnssStatus.FIXED, np.int8)
        status[self._float.at(t)[1] | reflected] = GnssStatus.FLOAT
        offset = np.where((is_wrong & (status == GnssStatus.FIXED))[:, None], wrong, offset)
        status[self._lost.at(t)[1]] = GnssStatus.NONE
        return Solution(status, offset, doppler)


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
    way = passage(course)
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
    offset = np.stack((distance * np.cos(angle), distance * np.sin(angle), up), axis=-1)
    return _Displaced(episodes, offset, config.multipath_doppler * rng.standard_normal((count, 3)))


def _wrong_fixes(course: Course, config: GnssSimulation, rng: Rng, broken: Episodes) -> _Displaced:
    """Ambiguities fixed to wrong integers, until they are fixed again: at the latest when the solution is broken."""
    begin = met(course, lambda e: config.wrong_fix_per_hour + e.sky.wrong_fix_per_hour, rng)
    noticed = lasting(begin, config.wrong_fix_s, rng)
    # what is drawn while it is broken begins when it is fixed again
    next_break = np.append(broken.begin, np.inf)[np.searchsorted(broken.begin, begin, side="right")]
    sigma = config.wrong_fix_m * np.array([1.0, 1.0, config.vertical_ratio])
    offset = sigma * rng.standard_normal((len(begin), 3))
    return _Displaced(Episodes(begin, np.minimum(noticed.end, next_break)), offset, np.zeros_like(offset))
