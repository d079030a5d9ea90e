"""The reference at the times of estimates: cubic positions, attitude by short arcs, course where it has none.

A reference of 4 to 100 Hz is interpolated to millimetres (linear interpolation at 4 Hz errs by centimetres in a turn).
Gaps are not bridged: times inside one are not evaluated. A reference may come in pieces: what is asked of it is then
held back until it has passed far enough for the answer to be that of the whole.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from replay._kernels import attitude_between, sample_track
from sensors.clock import NS_PER_S
from sensors.pieces import joined
from sensors.records import Trajectory
from sensors.rotation import rotate, yaw_from_q

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

COURSE_BASE_NS = 250_000_000
"""Speed and course are taken over this long before and after: 1 cm of noise is then 3 cm/s."""
MIN_COURSE_SPEED = 1.0
"""Below this speed a course says nothing about heading, m/s."""
GAP_PERIODS = 2.5
GAP_NS = (250_000_000, 1_500_000_000)
"""A pause longer than GAP_PERIODS median periods, within these bounds, is a gap."""
JUDGED_NS = 240 * NS_PER_S
"""Whether a reference has headings, and its period, are judged by so much of its beginning."""
PAUSE_NS = 600 * NS_PER_S
"""In a pause longer than this a reference is over, until it begins again."""
LATE_NS = 120 * NS_PER_S
"""Rows come at most so much later than IMU samples of the same true time, a sensor's delay included."""
FOREVER_NS = 2**62
"""Later than any stamp."""


class Excluded(IntEnum):
    """Why an epoch has no reference to be scored against."""

    EVALUATED = 0
    OUTSIDE = 1
    """Before or after the reference, or where it pauses for longer than PAUSE_NS."""
    GAP = 2
    """Within a gap of the reference."""
    NO_HEADING = 3
    """The reference has a heading elsewhere, but not here."""
    SLOW = 4
    """The reference has no heading and moves too slowly for a course."""
    NOT_HIDDEN = 5
    """Outside the stretches of hidden GNSS."""


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


@dataclass(frozen=True, slots=True)
class Judgement:
    """What the beginning of a reference says of the whole: when it starts, the longest step that is no gap, and
    whether its attitude is used."""

    first_ns: int
    gap_ns: int
    has_heading: bool


def judge(beginning: Trajectory) -> Judgement:
    """Judge a reference of at least one row by its first JUDGED_NS."""
    first = int(beginning.t_ns[0])
    rows = beginning[: np.searchsorted(beginning.t_ns, first + JUDGED_NS, side="right")]
    return Judgement(first, gap_ns(rows.t_ns), has_heading(rows))


def sample(reference: Trajectory, t_ns: Nanoseconds, judged: Judgement | None = None) -> Samples:
    """The reference at times t_ns (N,), fastest in increasing order. judged: of the whole, where this is a part of it.

    Its attitude is used if half of the rows by which it is judged have one.
    """
    t_ns = np.ascontiguousarray(t_ns, np.int64)
    if not len(reference):
        return nothing(t_ns)
    judged = judged or judge(reference)
    known = reference.t_ns
    left, inside, p_map, velocity = sample_track(known, reference.p_map, t_ns, judged.gap_ns, COURSE_BASE_NS)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    if judged.has_heading:
        q = attitude_between(known, reference.q_map_body, t_ns, left)
        heading, why = yaw_from_q(q), Excluded.NO_HEADING
    else:
        q = np.full((len(t_ns), 4), np.nan)
        course = np.arctan2(velocity[:, 1], velocity[:, 0])
        heading, why = np.where(speed >= MIN_COURSE_SPEED, course, np.nan), Excluded.SLOW
    excluded = np.where(np.isfinite(heading), Excluded.EVALUATED, why).astype(np.int8)
    out = ~inside
    if out.any():
        excluded[out] = _why_not_inside(known, t_ns[out], left[out], judged.first_ns)
        q[out], heading[out] = np.nan, np.nan
    sigma = np.where(inside[:, None], reference.sigma[left], np.nan)
    return Samples(t_ns, p_map, q, heading, speed, sigma, excluded, has_heading=judged.has_heading)


def _why_not_inside(known: Nanoseconds, t_ns: Nanoseconds, left: NDArray[np.int64], first_ns: int) -> NDArray[np.int8]:
    """(N,) GAP or OUTSIDE, of times on no row and between no two that are close enough; left: the row before."""
    before_or_after = (t_ns < first_ns) | (t_ns > known[-1])
    step = known[np.minimum(left + 1, len(known) - 1)] - known[left]
    return np.where(before_or_after | (step > PAUSE_NS), Excluded.OUTSIDE, Excluded.GAP).astype(np.int8)


class Track:
    """A reference that comes piece by piece, and answers as if the whole of it were there.

    Times may be asked up to ``settled_ns``; with ``forget`` they are over, so that memory does not follow its length.
    """

    def __init__(self) -> None:
        self.judged: Judgement | None = None
        self._rows: Trajectory | None = None
        self._whole = False

    def add(self, rows: Trajectory | None) -> None:
        """Take the rows that follow."""
        if rows is not None and len(rows):
            self._rows = rows if self._rows is None else joined([self._rows, rows])

    def close(self) -> None:
        """Nothing follows."""
        self._whole = True
        self._judge(None)

    @property
    def is_empty(self) -> bool:
        """Whether no row has come."""
        return self._rows is None

    def settled_ns(self, now_ns: int) -> int:
        """Up to when its answers are those of the whole. now_ns: the latest IMU sample."""
        self._judge(now_ns)
        if self._whole:
            return FOREVER_NS
        if self._rows is None:
            return now_ns - LATE_NS
        if self.judged is None:
            return int(self._rows.t_ns[0]) - 1
        known = self._rows.t_ns
        if now_ns >= int(known[-1]) + PAUSE_NS + LATE_NS:
            return now_ns - LATE_NS
        return int(known[-2]) - COURSE_BASE_NS if len(known) > 1 else self.judged.first_ns - 1

    def sample(self, t_ns: Nanoseconds) -> Samples:
        """Itself at times t_ns (N,)."""
        return nothing(t_ns) if self._rows is None else sample(self._rows, t_ns, self.judged)

    def forget(self, t_ns: int) -> None:
        """Only times after t_ns will be asked: let go of rows before the one that their base begins at, less one."""
        if self._rows is not None and self.judged is not None:
            base = int(np.searchsorted(self._rows.t_ns, t_ns - COURSE_BASE_NS, side="right")) - 2
            if base > len(self._rows) // 2:  # so that a long one is not copied for every piece
                self._rows = self._rows[base:]

    def _judge(self, now_ns: int | None) -> None:
        """Judge the beginning once it is there."""
        if self.judged is None and self._rows is not None:
            end = int(self._rows.t_ns[0]) + JUDGED_NS
            if self._whole or self._rows.t_ns[-1] > end or (now_ns is not None and now_ns > end + LATE_NS):
                self.judged = judge(self._rows)


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
