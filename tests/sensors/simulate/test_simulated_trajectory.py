"""The truth against numerical differentiation and quadrature in ECEF and in an inertial frame."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sensors._kernels import EARTH_RATE, gravity_enu
from sensors.geodesy import ecef_from_llh, rotation_ecef_enu
from sensors.rotation import matrix_from_q, rpy_from_q
from sensors.simulate.drive import DriveConfig, city_truth
from sensors.simulate.trajectory import KNOT_S, MARGIN_S, Motion, Truth

Floats = NDArray[np.float64]

WINDOW = np.linspace(-0.24, 0.24, 241)
"""Seconds around the middle of a knot interval, inside which the splines are one polynomial."""


def middles(count: int) -> NDArray[np.int64]:
    """Middles of randomly chosen knot intervals of a 600 s drive, ns after its start."""
    rng = np.random.default_rng(5)
    return np.rint((rng.choice(1190, count, replace=False) + 0.5) * KNOT_S * 1e9).astype(np.int64)


def derivatives(truth: Truth, of: Callable[[Motion, Floats], Floats], middle_ns: int, degree: int = 10) -> Floats:
    """Value, first and second derivative in the middle of one interval, by a polynomial fit of (N, ...) columns."""
    motion = truth.at(truth.start_ns + middle_ns + np.rint(WINDOW * 1e9).astype(np.int64))
    columns = of(motion, middle_ns * 1e-9 + WINDOW).reshape(len(WINDOW), -1)
    base = columns[len(WINDOW) // 2]
    scaled = np.polynomial.chebyshev.Chebyshev
    fits = [scaled.fit(WINDOW, c, degree) for c in (columns - base).T]
    return np.array([[f(0.0) + b, f.deriv(1)(0.0), f.deriv(2)(0.0)] for f, b in zip(fits, base, strict=True)]).T


def middle(truth: Truth, middle_ns: int) -> Motion:
    return truth.at(np.array([truth.start_ns + middle_ns]))


def inertial_from_ecef(t: Floats) -> Floats:
    return Rotation.from_euler("z", EARTH_RATE * t[:, None]).as_matrix()


def test_velocity_is_the_derivative_of_the_place(truth: Truth) -> None:
    for at in middles(40):
        _, velocity, _ = derivatives(truth, lambda m, _: ecef_from_llh(m.llh), int(at))
        now = middle(truth, int(at))
        expected = rotation_ecef_enu(now.llh)[0] @ now.vel_enu[0]
        np.testing.assert_allclose(velocity, expected, rtol=0, atol=1e-7)


def test_rate_is_the_derivative_of_the_attitude_in_an_inertial_frame(truth: Truth) -> None:
    def attitude(m: Motion, t: Floats) -> Floats:
        return inertial_from_ecef(t) @ rotation_ecef_enu(m.llh) @ matrix_from_q(m.q_enu_body)

    for at in middles(40):
        value, slope, _ = derivatives(truth, attitude, int(at)).reshape(3, 3, 3)
        skew = value.T @ slope
        rate = np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]) / 2
        np.testing.assert_allclose(middle(truth, int(at)).rate[0], rate, rtol=0, atol=1e-10)


def test_specific_force_is_inertial_acceleration_less_gravitation(truth: Truth) -> None:
    def place(m: Motion, t: Floats) -> Floats:
        return np.einsum("nij,nj->ni", inertial_from_ecef(t), ecef_from_llh(m.llh))

    for at in middles(40):
        position, _, acceleration = derivatives(truth, place, int(at))
        now = middle(truth, int(at))
        lat, _, h = now.llh[0]
        north, up = gravity_enu(np.sin(lat), np.cos(lat), h)
        R_inertial_enu = inertial_from_ecef(np.array([at * 1e-9]))[0] @ rotation_ecef_enu(now.llh)[0]
        centrifugal = EARTH_RATE**2 * position * [1.0, 1.0, 0.0]
        gravitation = R_inertial_enu @ [0.0, north, up] - centrifugal
        R_inertial_body = R_inertial_enu @ matrix_from_q(now.q_enu_body)[0]
        force = R_inertial_body.T @ (acceleration - gravitation)
        np.testing.assert_allclose(now.specific_force[0], force, rtol=0, atol=1e-6)


def quadrature(truth: Truth, duration_s: float, step_s: float) -> Floats:
    """ECEF displacement: the integral of the ECEF velocity by 4-point Gauss-Legendre on each step."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    begin = np.arange(round(duration_s / step_s)) * step_s
    total = np.zeros(3)
    for node, weight in zip(nodes, weights, strict=True):
        motion = truth.at(truth.start_ns + np.rint((begin + step_s * (node + 1) / 2) * 1e9).astype(np.int64))
        total += 0.5 * step_s * weight * (rotation_ecef_enu(motion.llh) @ motion.vel_enu[..., None]).sum(axis=0)[:, 0]
    return total


def test_place_is_the_integral_of_velocity_to_a_micrometre_over_two_hours() -> None:
    truth = city_truth(7200.0, 11, DriveConfig())
    first, last = ecef_from_llh(truth.at(truth.start_ns + np.array([0, 7200]) * 10**9).llh)
    coarse, fine = quadrature(truth, 7200.0, 0.25), quadrature(truth, 7200.0, 0.125)
    assert np.linalg.norm(last - first) > 500.0
    assert np.linalg.norm(coarse - fine) < 1e-6
    assert np.linalg.norm(fine - (last - first)) < 1e-6


def test_vehicle_moves_along_its_own_axis(truth: Truth) -> None:
    motion = truth.at(truth.start_ns + np.arange(0, 600 * 10**9, 37 * 10**6))
    body = np.einsum("nji,nj->ni", matrix_from_q(motion.q_enu_body), motion.vel_enu)
    assert np.abs(body[:, 1:]).max() < 1e-13
    assert body[:, 0].min() > -1e-13
    assert (body[:100, 0] == 0.0).all()


def test_a_positive_pitch_lowers_the_nose(truth: Truth) -> None:
    motion = truth.at(truth.start_ns + np.arange(0, 600 * 10**9, 10**9))
    climbing = motion.vel_enu[:, 2] > 0.05
    assert climbing.any()
    assert (rpy_from_q(motion.q_enu_body[climbing])[:, 1] < 0).all()


def test_lever_arm_moves_with_the_derivative_of_its_place(truth: Truth) -> None:
    arm = (0.5, -0.4, 1.2)
    for at in middles(20):
        position, velocity, _ = derivatives(truth, lambda m, _: ecef_from_llh(m.place_of(arm)), int(at))
        now = middle(truth, int(at))
        R_ecef_enu = rotation_ecef_enu(now.llh)[0]
        expected = ecef_from_llh(now.llh)[0] + R_ecef_enu @ matrix_from_q(now.q_enu_body)[0] @ arm
        np.testing.assert_allclose(position, expected, rtol=0, atol=1e-8)
        np.testing.assert_allclose(velocity, R_ecef_enu @ now.velocity_of(arm)[0], rtol=0, atol=2e-7)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_city_drive_keeps_its_limits_and_stops(seed: int) -> None:
    truth = city_truth(1800.0, seed, DriveConfig())
    motion = truth.at(truth.start_ns + np.arange(0, 1800 * 50) * 20_000_000)
    speed = np.linalg.norm(motion.vel_enu, axis=1)
    turn = motion.rate_to_earth()[:, 2]
    assert 5.0 < speed.mean() < speed.max() < 15.01
    assert np.abs(np.diff(speed) / 0.02).max() < 2.5
    assert 2.0 < np.abs(speed * turn).max() < 3.0
    assert np.abs(np.tan(rpy_from_q(motion.q_enu_body)[:, 1])).max() < 0.04
    assert np.ptp(motion.llh[:, 2]) > 3.0
    edges = np.flatnonzero(np.diff(np.concatenate(([0], speed == 0.0, [0])).astype(int)))
    rests = np.diff(edges)[::2] * 0.02
    assert edges[0] == 0
    assert rests[0] >= 8.0
    assert len(rests) >= 8
    assert rests[1:-1].min() >= 4.9
    assert rests.max() < 33.0


def test_a_longer_drive_begins_with_the_shorter_one() -> None:
    t_ns = DriveConfig().start.unix_s * 10**9 + np.arange(0, 60 * 10**9, 10**9)
    short, long = (city_truth(d, 4, DriveConfig()).at(t_ns) for d in (60.0, 900.0))
    np.testing.assert_array_equal(short.llh, long.llh)
    np.testing.assert_array_equal(short.specific_force, long.specific_force)


def test_truth_is_known_only_between_its_margins(truth: Truth) -> None:
    first, last = truth.span_ns
    assert first == truth.start_ns - MARGIN_S * 1e9
    assert last >= truth.start_ns + (600 + MARGIN_S) * 1e9
    with pytest.raises(ValueError, match="truth is known from"):
        truth.at(np.array([last + 1]))
