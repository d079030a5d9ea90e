"""Random events along a course: how often follows from the environments that a drive passes, how long is drawn."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.clock import seconds
from sensors.simulate.course import Course
from sensors.simulate.environment import Environment

Floats = NDArray[np.float64]
Rng = np.random.Generator


class Passage(NamedTuple):
    """The stretches that a drive passes: time (M + 1,) s since its start, place (M + 1,) m, kind (M,) index of the
    environment."""

    time: Floats
    place: Floats
    kind: NDArray[np.intp]


class Episodes(NamedTuple):
    """Intervals over time s or place m, sorted by begin (E,); a later one takes over from an earlier one that lasts."""

    begin: Floats
    end: Floats

    def at(self, x: Floats) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Of times or places x (N,): the last episode begun (N,), 0 before the first, and whether it lasts still."""
        if not len(self.begin):
            return np.zeros(len(x), np.intp), np.zeros(len(x), bool)
        last = np.searchsorted(self.begin, x, side="right") - 1
        row = np.maximum(last, 0)
        return row, (last >= 0) & (x < self.end[row])


def passage(course: Course) -> Passage:
    """When and where each of them is passed."""
    first, last = course.s[0], course.s[-1]
    inner = course.edges[(course.edges > first) & (course.edges < last)]
    place = np.concatenate(([first], inner, [last]))
    t = seconds(course.t_ns, course.t_ns[0])
    time = np.concatenate(([0.0], np.interp(inner, course.s, t), t[-1:]))
    return Passage(time, place, course.environment(0.5 * (place[1:] + place[:-1])))


def met(course: Course, rate: Callable[[Environment], float], rng: Rng, *, over_place: bool = False) -> Floats:
    """(E,) sorted s since the course's start, or m along it, of events whose rate depends on the environment.

    rate: events per hour, or per km.
    """
    way = passage(course)
    at, unit = (way.place, 1000.0) if over_place else (way.time, 3600.0)
    rates = np.array([rate(environment) for environment in course.environments]) / unit
    expected = np.concatenate(([0.0], np.cumsum(rates[way.kind] * np.diff(at))))
    count = rng.poisson(expected[-1])
    result: Floats = np.interp(np.sort(rng.random(count)) * expected[-1], expected, at)
    return result


def lasting(begin: Floats, mean: float, rng: Rng) -> Episodes:
    """Episodes of exponentially distributed length."""
    return Episodes(begin, begin + rng.exponential(mean, len(begin)))
