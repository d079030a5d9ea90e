"""The reference at the times of estimates: cubic positions, attitude by short arcs, course where it has none.

A reference of 4 to 100 Hz is interpolated to millimetres (linear interpolation at 4 Hz errs by centimetres in a turn).
Gaps are not bridged: times inside one are not evaluated.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from replay._kernels import sample_track
from sensors.records import Trajectory
from sensors.rotation import interpolate_q, rotate, yaw_from_q

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

COURSE_BASE_NS = 250_000_000
"""Speed and course are taken over this long before and after: 1 cm of noise is then 3 cm/s."""
MIN_COURSE_SPEED = 1.0
"""Below this speed a course says nothing about heading, m/s."""
GAP_PERIODS = 2.5
GAP_NS = (250_000_000, 1_500_000_000)
"""A pause longer than GAP_PERIODS median periods, within these bounds, is a gap."""


class Excluded(IntEnum):
    """Why an epoch has no reference to be scored against."""

    EVALUATED = 0
    OUTSIDE = 1
    """Before or after the reference."""
    GAP = 2
    """Within a gap of the reference."""
    NO_HEADING = 3
    """The reference has a heading elsewhere, but not here."""
    SLOW = 4
    """The reference has no heading and moves too slowly for a course."""
    NOT_HIDDEN = 5
    """Outside the stretches of hidden GNSS."""


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """What a run is scored against: a trajectory of one point of the body (m, body frame).

    stretches: (S, 2) int64, the only times that are scored; None: all.
    """

    trajectory: Trajectory
    point: tuple[float, float, float]
    stretches: Nanoseconds | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """A reference sampled at t_ns (N,), at the point it is given for; NaN outside it and in its gaps.

    p_map (N, 3) m; q_map_body (N, 4) xyzw, NaN throughout where has_heading is False; heading (N,) rad, of the
    attitude or else the course, NaN where neither is known; speed (N,) m/s, horizontal; sigma (N, 2) m and rad, NaN
    where unknown; excluded (N,) int8 Excluded.
    """

    t_ns: Nanoseconds
    p_map: Floats
    q_map_body: Floats
    heading: Floats
    speed: Floats
    sigma: Floats
    excluded: NDArray[np.int8]
    has_heading: bool

    def axes(self) -> tuple[Floats, Floats]:
        """Cosine and sine of the heading, each (N,)."""
        return np.cos(self.heading), np.sin(self.heading)


def sample(reference: Trajectory, t_ns: Nanoseconds) -> Samples:
    """The reference at times t_ns (N,), in any order. Its heading is used if half of its rows have one."""
    t_ns = np.ascontiguousarray(t_ns, np.int64)
    if not len(reference):
        return nothing(t_ns)
    known, gap = reference.t_ns, gap_ns(reference.t_ns)
    left, inside, p_map, velocity = sample_track(known, reference.p_map, t_ns, gap, COURSE_BASE_NS)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    attitude = has_heading(reference)
    if attitude:
        q = interpolate_q(t_ns, known, reference.q_map_body)
        heading, why = yaw_from_q(q), Excluded.NO_HEADING
    else:
        q = np.full((len(t_ns), 4), np.nan)
        course = np.arctan2(velocity[:, 1], velocity[:, 0])
        heading, why = np.where(speed >= MIN_COURSE_SPEED, course, np.nan), Excluded.SLOW
    excluded = np.where(np.isfinite(heading), Excluded.EVALUATED, why).astype(np.int8)
    excluded[~inside] = Excluded.GAP
    excluded[(t_ns < known[0]) | (t_ns > known[-1])] = Excluded.OUTSIDE
    q[~inside], heading[~inside] = np.nan, np.nan
    sigma = np.where(inside[:, None], reference.sigma[left], np.nan)
    return Samples(t_ns, p_map, q, heading, speed, sigma, excluded, has_heading=attitude)


def lever(samples: Samples, arm: ArrayLike, R_map_estimate: Floats | None = None) -> Floats:
    """(N, 3) a vector in the body seen in map axes, by the reference's attitude.

    Where the reference has none: by the estimate's, (N, 3, 3) R_map_body, or else by a level body at its course.
    """
    vector = np.asarray(arm, np.float64)
    if not vector.any():
        return np.zeros((len(samples.t_ns), 3))
    if samples.has_heading:
        return rotate(samples.q_map_body, vector)
    if R_map_estimate is not None:
        result: Floats = R_map_estimate @ vector
        return result
    cosine, sine = samples.axes()
    x, y, z = vector
    return np.stack((cosine * x - sine * y, sine * x + cosine * y, np.full(len(cosine), z)), axis=-1)


def along_left(samples: Samples, difference: Floats) -> Floats:
    """(N, 2) components along and left of the reference heading of map vectors (N, 2 or 3)."""
    cosine, sine = samples.axes()
    x, y = difference[:, 0], difference[:, 1]
    return np.stack((cosine * x + sine * y, cosine * y - sine * x), axis=-1)


def gap_ns(t_ns: Nanoseconds) -> int:
    """The pause above which a reference with these stamps is not interpolated."""
    if len(t_ns) < 2:
        return GAP_NS[0]
    return int(np.clip(GAP_PERIODS * float(np.median(np.diff(t_ns))), *GAP_NS))


def has_heading(reference: Trajectory) -> bool:
    """Whether at least half of the rows have an attitude."""
    return bool(len(reference) and np.isfinite(reference.q_map_body[:, 3]).mean() >= 0.5)


def nothing(t_ns: Nanoseconds) -> Samples:
    """Samples of no reference at all."""
    n = len(t_ns)
    outside = np.full(n, Excluded.OUTSIDE, np.int8)
    p_map, q, heading, speed, sigma = (np.full((n, *shape), np.nan) for shape in ((3,), (4,), (), (), (2,)))
    return Samples(t_ns, p_map, q, heading, speed, sigma, outside, has_heading=False)


def only(samples: Samples, chosen: NDArray[np.bool_]) -> Samples:
    """The samples with all but the chosen (N,) excluded as not hidden."""
    excluded = np.where(chosen, samples.excluded, Excluded.NOT_HIDDEN).astype(np.int8)
    p_map, q, heading, speed, sigma = (
        np.where(chosen.reshape(-1, *[1] * (column.ndim - 1)), column, np.nan)
        for column in (samples.p_map, samples.q_map_body, samples.heading, samples.speed, samples.sigma)
    )
    return Samples(samples.t_ns, p_map, q, heading, speed, sigma, excluded, has_heading=samples.has_heading)


def errors(samples: Samples, difference: Floats) -> Floats:
    """(N, 2) map vectors (N, 2 or 3) along and left of the reference heading; NaN where excluded."""
    return np.where(samples.excluded[:, None] == Excluded.EVALUATED, along_left(samples, difference), np.nan)


def evaluated_only(samples: Samples, error: Floats) -> Floats:
    """(N,) errors; NaN where excluded."""
    return np.where(samples.excluded == Excluded.EVALUATED, error, np.nan)
