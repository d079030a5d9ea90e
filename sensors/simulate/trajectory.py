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
    """The exact motion of one drive at any time between its margins."""

    def __init__(self, profile: Profile, start_llh: ArrayLike, start_ns: int, stages: int = STAGES) -> None:
        """start_llh: (3,) place at the profile's start; start_ns: Unix time of its zero seconds."""
        self.start_ns = start_ns
        self._start_s = profile.start_s
        columns = (profile.speed, profile.yaw, profile.grade, profile.roll)
        self._shape = np.stack([_polynomials(c) for c in columns], axis=1)
        nodes, weights = np.polynomial.legendre.leggauss(stages)
        powers = _integrals(nodes)
        at_nodes = np.vander(nodes, stages + 1, increasing=True) @ powers
        llh = np.asarray(start_llh, np.float64)
        self._place = _kernels.integrate_place(self._shape, llh, KNOT_S, nodes, weights, at_nodes, powers)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time at which the truth is known, margins included."""
        first = self.start_ns + round(self._start_s * 1e9)
        return first, first + round(len(self._shape) * KNOT_S * 1e9)

    def at(self, t_ns: Nanoseconds) -> Motion:
        """Truth at t_ns (N,)."""
        t = self._seconds(t_ns)
        llh, vel_enu, q = np.empty((len(t), 3)), np.empty((len(t), 3)), np.empty((len(t), 4))
        _kernels.kinematics(self._shape, self._place, self._start_s, KNOT_S, t, llh, vel_enu, q)
        return Motion(t_ns, llh, vel_enu, q, *self._inertial(t, np.zeros(1), np.ones(1)))

    def chunks(self, t_ns: Nanoseconds) -> Iterator[tuple[slice, Motion]]:
        """Truth at t_ns (N,), some rows at a time: memory stays at the size of the result."""
        for begin in range(0, len(t_ns), CHUNK):
            rows = slice(begin, begin + CHUNK)
            yield rows, self.at(t_ns[rows])

    def inertial(self, t_ns: Nanoseconds) -> tuple[Floats, Floats]:
        """Rate (N, 3) rad/s and specific force (N, 3) m/s^2 in body axes at t_ns (N,)."""
        t = self._seconds(t_ns)
        return self._inertial(t, np.zeros(1), np.ones(1))

    def inertial_means(self, t_ns: Nanoseconds, interval_s: float) -> tuple[Floats, Floats]:
        """Means of rate and specific force over the interval that ends at t_ns (N,), by Gauss-Legendre."""
        t = self._seconds(t_ns)
        self._seconds(t_ns[:1] - round(interval_s * 1e9))
        nodes, weights = np.polynomial.legendre.leggauss(3)
        return self._inertial(t, 0.5 * interval_s * (nodes - 1.0), 0.5 * weights)

    def _inertial(self, t: Floats, nodes: Floats, weights: Floats) -> tuple[Floats, Floats]:
        gyro, accel = np.zeros((len(t), 3)), np.zeros((len(t), 3))
        _kernels.inertial_means(self._shape, self._place, self._start_s, KNOT_S, t, nodes, weights, gyro, accel)
        return gyro, accel

    def _seconds(self, t_ns: Nanoseconds) -> Floats:
        first, last = self.span_ns
        if len(t_ns) and not (first <= t_ns.min() and t_ns.max() <= last):
            raise ValueError(f"truth is known from {first} to {last} ns, asked from {t_ns.min()} to {t_ns.max()}")
        return seconds(t_ns, self.start_ns)


def _polynomials(control: Floats) -> Floats:
    """(K, 6) ascending powers of z in [-1, 1] on each interval of a quintic B-spline with (K + 5,) control points."""
    # truncated powers: B(x) = sum over k < x of (-1)^k C(6, k) (x - k)^5 / 5!, at x = (z + 1) / 2 + piece
    pieces = np.zeros((6, 6))
    for piece in range(6):
        for k in range(piece + 1):
            shifted = np.polynomial.Polynomial((piece - k + 0.5, 0.5)) ** 5
            pieces[piece] += (-1) ** k * comb(6, k) / factorial(5) * shifted.coef
    # around a nearby control point, so that a constant has exactly zero slope
    near = control[2:-3]
    powers: Floats = (np.lib.stride_tricks.sliding_window_view(control, 6) - near[:, None]) @ pieces[::-1]
    powers[:, 0] += near
    return powers


def _integrals(nodes: Floats) -> Floats:
    """(S + 1, S) ascending powers of the integral from -1 of the polynomial through values at the nodes (S,)."""
    count = len(nodes)
    order = np.arange(1, count + 1)
    through: Floats = np.linalg.inv(np.vander(nodes, count, increasing=True)) / order[:, None]
    at_minus_one = np.where(order % 2, -1.0, 1.0) @ through
    return np.vstack((-at_minus_one, through))
