"""Exact truth of a simulated drive: C^4 splines of speed, yaw, grade and roll, and the motion that follows on WGS-84.

The vehicle moves along its own x axis: v_enu = v (cos yaw cos grade, sin yaw cos grade, sin grade), pitch = -grade (a
positive pitch lowers the nose), so the non-holonomic constraint holds exactly at the body's origin.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb, factorial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors._kernels import EARTH_RATE
from sensors.clock import seconds
from sensors.geodesy import ecef_from_llh, llh_from_ecef, rotation_ecef_enu
from sensors.rotation import matrix_from_q
from sensors.simulate import _kernels

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

KNOT_S = 0.5
"""Spacing of the spline's knots, s: it smooths steps of the control points over about a second."""
MARGIN_S = 1.0
"""The truth reaches this far beyond both ends of the drive, s."""
CHUNK = 65_536
"""Rows that are evaluated at a time."""
STAGES = 8
"""Gauss nodes an interval: the place is integrated to order 16."""
BLOCK = 1024
"""Intervals whose polynomials are made at a time."""
BEFORE = 1
"""Intervals before a block that means over an IMU's interval may reach into."""
BLOCKS_KEPT = 3
"""Blocks whose polynomials are kept: sensors ask for the same times one after the other."""


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Control points of quintic B-splines, KNOT_S apart; the first belongs to two knots before start_s.

    speed: (K + 5,) m/s; yaw: (K + 5,) rad, unwrapped; grade: (K + 5,) rad, uphill positive; roll: (K + 5,) rad.
    """

    start_s: float
    speed: Floats
    yaw: Floats
    grade: Floats
    roll: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Truth at t_ns (N,).

    llh: (N, 3); vel_enu: (N, 3) m/s; q_enu_body: (N, 4) xyzw; rate: (N, 3) rad/s, of the body against inertial space,
    body axes; specific_force: (N, 3) m/s^2, body axes.
    """

    t_ns: Nanoseconds
    llh: Floats
    vel_enu: Floats
    q_enu_body: Floats
    rate: Floats
    specific_force: Floats

    def rate_to_earth(self) -> Floats:
        """(N, 3) rad/s, angular rate of the body against the earth, body axes."""
        lat = self.llh[:, 0]
        earth = EARTH_RATE * np.stack((np.zeros_like(lat), np.cos(lat), np.sin(lat)), axis=-1)
        result: Floats = self.rate - np.einsum("nji,nj->ni", matrix_from_q(self.q_enu_body), earth)
        return result

    def place_of(self, lever_arm: ArrayLike) -> Floats:
        """(N, 3) llh of a point of the vehicle; lever_arm: (3,) m, body axes."""
        arm = np.asarray(lever_arm, np.float64)
        if not arm.any():
            return self.llh
        arm_ecef = rotation_ecef_enu(self.llh) @ (matrix_from_q(self.q_enu_body) @ arm)[..., None]
        return llh_from_ecef(ecef_from_llh(self.llh) + arm_ecef[..., 0])

    def velocity_of(self, lever_arm: ArrayLike) -> Floats:
        """(N, 3) m/s, ENU velocity of a point of the vehicle; lever_arm: (3,) m, body axes."""
        arm = np.asarray(lever_arm, np.float64)
        turning = np.cross(self.rate_to_earth(), arm)
        result: Floats = self.vel_enu + np.einsum("nij,nj->ni", matrix_from_q(self.q_enu_body), turning)
        return result


class Truth:
    """The exact motion of one drive at any time between its margins.

    It keeps the control points and the place at every knot (56 bytes each); the polynomials of a block of intervals are
    made when a time in it is asked for.
    """

    def __init__(self, profile: Profile, start_llh: ArrayLike, start_ns: int, stages: int = STAGES) -> None:
        """start_llh: (3,) place at the profile's start; start_ns: Unix time of its zero seconds."""
        self.start_ns = start_ns
        self._start_s = profile.start_s
        self._control = np.stack((profile.speed, profile.yaw, profile.grade, profile.roll), axis=-1)
        nodes, weights = np.polynomial.legendre.leggauss(stages)
        powers = _integrals(nodes)
        at_nodes = np.vander(nodes, stages + 1, increasing=True) @ powers
        self._quadrature = (KNOT_S, nodes, weights, at_nodes, powers)
        self._knots = np.empty((len(self._control) - 4, 3))
        self._knots[0] = start_llh
        self._tables: dict[int, tuple[Floats, Floats]] = {}
        for first in range(0, len(self._knots) - 1, BLOCK):
            self._integrate(first, min(first + BLOCK, len(self._knots) - 1), with_place=False)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time at which the truth is known, margins included."""
        first = self.start_ns + round(self._start_s * 1e9)
        return first, first + round((len(self._knots) - 1) * KNOT_S * 1e9)

    @property
    def knots(self) -> Floats:
        """(K + 1, 3) llh at the knots, KNOT_S apart from the start of span_ns on."""
        return self._knots

    def at(self, t_ns: Nanoseconds) -> Motion:
        """Truth at increasing t_ns (N,)."""
        count = len(t_ns)
        llh, vel_enu, q = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 4))
        for rows, t, table in self._blocks(t_ns):
            _kernels.kinematics(*table, KNOT_S, t, llh[rows], vel_enu[rows], q[rows])
        return Motion(t_ns, llh, vel_enu, q, *self.inertial(t_ns))

    def chunks(self, t_ns: Nanoseconds) -> Iterator[tuple[slice, Motion]]:
        """Truth at increasing t_ns (N,), some rows at a time: memory stays at the size of the result."""
        for begin in range(0, len(t_ns), CHUNK):
            rows = slice(begin, begin + CHUNK)
            yield rows, self.at(t_ns[rows])

    def forward_speed(self, t_ns: Nanoseconds, lever_arm: ArrayLike = (0.0, 0.0, 0.0)) -> Floats:
        """(N,) m/s along the vehicle's axis of a point of it at increasing t_ns (N,); lever_arm: (3,) m, body axes."""
        speed = np.empty(len(t_ns))
        for rows, t, (shape, _, start_s) in self._blocks(t_ns):
            _kernels.speeds(shape, start_s, KNOT_S, t, speed[rows])
        _, left, up = np.asarray(lever_arm, np.float64)
        if left or up:
            for rows, motion in self.chunks(t_ns):
                rate = motion.rate_to_earth()
                speed[rows] += rate[:, 1] * up - rate[:, 2] * left
        return speed

    def inertial(self, t_ns: Nanoseconds) -> tuple[Floats, Floats]:
        """Rate (N, 3) rad/s and specific force (N, 3) m/s^2 in body axes at increasing t_ns (N,)."""
        return self._inertial(t_ns, np.zeros(1), np.ones(1))

    def inertial_means(self, t_ns: Nanoseconds, interval_s: float) -> tuple[Floats, Floats]:
        """Means of rate and specific force over the interval that ends at increasing t_ns (N,), by Gauss-Legendre."""
        self._check(t_ns[:1] - round(interval_s * 1e9))
        nodes, weights = np.polynomial.legendre.leggauss(3)
        return self._inertial(t_ns, 0.5 * interval_s * (nodes - 1.0), 0.5 * weights)

    def _inertial(self, t_ns: Nanoseconds, nodes: Floats, weights: Floats) -> tuple[Floats, Floats]:
        gyro, accel = np.zeros((len(t_ns), 3)), np.zeros((len(t_ns), 3))
        for rows, t, table in self._blocks(t_ns):
            _kernels.inertial_means(*table, KNOT_S, t, nodes, weights, gyro[rows], accel[rows])
        return gyro, accel

    def _blocks(self, t_ns: Nanoseconds) -> Iterator[tuple[slice, Floats, tuple[Floats, Floats, float]]]:
        """Rows of each block of intervals, their times s, and the block's tables with the time s of their first row."""
        if not len(t_ns):
            return
        self._check(t_ns)
        t = seconds(t_ns, self.start_ns)
        block = np.minimum((t - self._start_s) / (KNOT_S * BLOCK), (len(self._knots) - 2) // BLOCK).astype(np.intp)
        begins = np.flatnonzero(np.diff(block, prepend=-1))
        if (np.diff(block[begins]) < 0).any():
            raise ValueError("truth: expected increasing times")
        for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(t)], strict=True):
            first = max(int(block[begin]) * BLOCK - BEFORE, 0)
            shape, place = self._table(int(block[begin]))
            yield slice(begin, end), t[begin:end], (shape, place, self._start_s + first * KNOT_S)

    def _table(self, block: int) -> tuple[Floats, Floats]:
        """shape (L, 4, 6) and place (L, 3, STAGES + 1) of a block and of the intervals just before it."""
        if block not in self._tables:
            first, last = block * BLOCK, min((block + 1) * BLOCK, len(self._knots) - 1)
            while len(self._tables) >= BLOCKS_KEPT:
                self._tables.pop(next(iter(self._tables)))
            self._tables[block] = self._integrate(max(first - BEFORE, 0), last)
        return self._tables[block]

    def _integrate(self, first: int, last: int, *, with_place: bool = True) -> tuple[Floats, Floats]:
        """Tables of some intervals from the place at the first knot; writes the places at those after it."""
        shape = np.empty((last - first, 4, 6))
        _kernels.spline_pieces(self._control[first : last + 5], SPLINE, shape)
        place = np.empty((last - first if with_place else 0, 3, len(self._quadrature[1]) + 1))
        _kernels.integrate_place(shape, self._knots[first : last + 1], *self._quadrature, place)
        return shape, place

    def _check(self, t_ns: Nanoseconds) -> None:
        first, last = self.span_ns
        if len(t_ns) and not (first <= t_ns.min() and t_ns.max() <= last):
            raise ValueError(f"truth is known from {first} to {last} ns, asked from {t_ns.min()} to {t_ns.max()}")


def _spline() -> Floats:
    """(6, 6) ascending powers of z in [-1, 1] of the six control points of an interval of a quintic B-spline."""
    # truncated powers: B(x) = sum over k < x of (-1)^k C(6, k) (x - k)^5 / 5!, at x = (z + 1) / 2 + piece
    pieces = np.zeros((6, 6))
    for piece in range(6):
        for k in range(piece + 1):
            shifted = np.polynomial.Polynomial((piece - k + 0.5, 0.5)) ** 5
            pieces[piece] += (-1) ** k * comb(6, k) / factorial(5) * shifted.coef
    return pieces[::-1].copy()


SPLINE = _spline()


def _integrals(nodes: Floats) -> Floats:
    """(S + 1, S) ascending powers of the integral from -1 of the polynomial through values at the nodes (S,)."""
    count = len(nodes)
    order = np.arange(1, count + 1)
    through: Floats = np.linalg.inv(np.vander(nodes, count, increasing=True)) / order[:, None]
    at_minus_one = np.where(order % 2, -1.0, 1.0) @ through
    return np.vstack((-at_minus_one, through))
