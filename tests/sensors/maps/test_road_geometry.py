"""The reference line against closed forms that share no code with it, and the sampling's bound."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.special import fresnel

from sensors.errors import EgolocError
from sensors.maps.quantized import cm_from_m, m_from_cm
from sensors.maps.road_geometry import PlanView, Shape
from sensors.maps.road_sampling import refined, simplified
from sensors.maps.road_surface import CrossShape, Cubics, RoadSurface
from sensors.maps.vector_map import Floats


def _plan(
    shape: Shape, coefficients: ArrayLike, length: float, start: tuple[float, float, float] = (0, 0, 0)
) -> PlanView:
    row = np.zeros((1, 8))
    row[0, : np.size(coefficients)] = coefficients
    x, y, heading = np.array(start, float)[:, None]
    return PlanView(np.zeros(1), x, y, heading, np.array([length]), np.array([shape], np.int8), row)


def test_an_arc_is_a_circle() -> None:
    plan = _plan(Shape.CLOTHOID, (0.05, 0.05), 100.0, (10.0, -5.0, 0.7))
    s = np.linspace(0.0, 100.0, 301)
    centre = np.array([10.0, -5.0]) + 20.0 * np.array([-np.sin(0.7), np.cos(0.7)])
    circle = centre + 20.0 * np.column_stack((np.sin(0.7 + s / 20.0), -np.cos(0.7 + s / 20.0)))
    found = plan.at(s)
    np.testing.assert_allclose(found[:, :2], circle, atol=1e-10)
    np.testing.assert_allclose(found[:, 2], 0.7 + s / 20.0, atol=1e-12)


@pytest.mark.parametrize("end", [0.05, -0.02, 1e-7, 0.5])
def test_a_spiral_from_straight_is_the_fresnel_integrals(end: float) -> None:
    length = 80.0
    s = np.linspace(0.0, length, 200)
    scale = np.sqrt(np.pi * length / abs(end))
    sine, cosine = fresnel(s / scale)
    found = _plan(Shape.CLOTHOID, (0.0, end), length).at(s)
    np.testing.assert_allclose(found[:, 0], scale * cosine, atol=1e-6)
    np.testing.assert_allclose(found[:, 1], np.sign(end) * scale * sine, atol=1e-6)


def test_a_spiral_between_curvatures_is_the_integral_of_its_heading() -> None:
    def slope(s: float, _: Floats) -> list[float]:
        angle = -0.03 * s + 0.5 * (0.04 + 0.03) / 120.0 * s**2
        return [np.cos(angle), np.sin(angle)]

    s = np.linspace(0.0, 120.0, 50)
    oracle = solve_ivp(slope, (0.0, 120.0), [0.0, 0.0], t_eval=s, rtol=1e-11, atol=1e-11).y.T
    np.testing.assert_allclose(_plan(Shape.CLOTHOID, (-0.03, 0.04), 120.0).at(s)[:, :2], oracle, atol=1e-6)


def test_a_parametric_cubic_is_its_polynomials() -> None:
    u, v = (0.5, 1.0, -2e-3, 1e-5), (0.1, 0.2, 3e-3, -4e-5)
    s = np.linspace(0.0, 60.0, 61)
    found = _plan(Shape.PARAMETRIC, u + v, 60.0, (100.0, 200.0, np.pi / 2)).at(s)
    east = 100.0 - np.polynomial.Polynomial(v)(s)
    north = 200.0 + np.polynomial.Polynomial(u)(s)
    np.testing.assert_allclose(found[:, :2], np.column_stack((east, north)), atol=1e-10)
    step = np.gradient(np.unwrap(np.arctan2(np.gradient(north, s), np.gradient(east, s))), s)
    np.testing.assert_allclose(np.gradient(found[:, 2], s)[3:-3], step[3:-3], atol=1e-4)


def test_a_cubic_runs_by_its_own_length() -> None:
    abcd = (0.0, 0.1, 0.02, -2e-4)
    s = np.linspace(0.0, 70.0, 15)
    found = _plan(Shape.CUBIC, abcd, 70.0).at(s)
    np.testing.assert_allclose(found[:, 1], np.polynomial.Polynomial(abcd)(found[:, 0]), atol=1e-9)
    fine = np.linspace(0.0, found[-1, 0], 2_000_001)
    run = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(fine), np.diff(np.polynomial.Polynomial(abcd)(fine))))))
    np.testing.assert_allclose(np.interp(found[:, 0], fine, run), s, atol=1e-4)


def test_pieces_take_their_turns() -> None:
    both = [_plan(Shape.CLOTHOID, (0.0, 0.0), 10.0), _plan(Shape.CLOTHOID, (0.1, 0.1), 10.0, (10.0, 0.0, 0.0))]
    plan = PlanView(
        np.array([0.0, 10.0]),
        *(np.concatenate([getattr(p, name) for p in both]) for name in ("x", "y", "heading", "length", "shape")),
        np.concatenate([p.coefficients for p in both]),
    )
    found = plan.at(np.array([5.0, 10.0, 10.0 + 5.0 * np.pi]))
    np.testing.assert_allclose(found, [[5, 0, 0], [10, 0, 0], [20, 10, np.pi / 2]], atol=1e-9)


def test_the_cross_section_turns_about_the_reference_line() -> None:
    line = _plan(Shape.CLOTHOID, (0.0, 0.0), 100.0)
    at, t, level = np.full(2, 50.0), np.array([-4.0, 3.0]), np.zeros(2)
    roll = Cubics(np.zeros(1), np.array([[0.1, 0.0, 0.0, 0.0]]))
    rise = Cubics(np.array([0.0, 20.0]), np.array([[1.0, 0.0, 0.0, 0.0], [1.0, 0.02, 0.0, 0.0]]))
    banked = RoadSurface(line, 100.0, rise, roll).points(at, t, level)
    expected = [[50.0, k * np.cos(0.1), 1.6 + k * np.sin(0.1)] for k in t]  # the right side lies lower
    np.testing.assert_allclose(banked, expected, atol=1e-12)
    fall = Cubics(np.zeros(1), np.array([[0.02, 0.0, 0.0, 0.0]]))
    crowned = RoadSurface(line, 100.0, crossfall_right=fall).points(at, t, level)
    np.testing.assert_allclose(crowned[:, 2], [-4.0 * np.tan(0.02), 0.0], atol=1e-12)


def test_a_shape_is_linear_between_its_sections() -> None:
    flat = Cubics(np.array([-5.0]), np.zeros((1, 4)))
    roof = Cubics(np.array([-5.0, 0.0]), np.array([[0.0, 0.1, 0.0, 0.0], [0.5, -0.1, 0.0, 0.0]]))
    shape = CrossShape(np.array([10.0, 30.0]), (flat, roof))
    s, t = np.array([0.0, 20.0, 30.0, 90.0, 90.0]), np.array([0.0, 0.0, 0.0, 2.0, -9.0])
    np.testing.assert_allclose(shape.at(s, t), [0.0, 0.25, 0.5, 0.3, 0.0], atol=1e-12)


def _farthest(points: Floats, line: Floats) -> float:
    """Of points (N, 3) from a polyline."""
    off = np.full(len(points), np.inf)
    for a, b in pairwise(line):
        share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        off = np.minimum(off, np.linalg.norm(points - a - share[:, None] * (b - a), axis=1))
    return float(off.max())


def test_chords_stay_within_a_centimetre_and_are_few() -> None:
    surface = RoadSurface(_plan(Shape.CLOTHOID, (0.05, -0.05), 150.0), 150.0)

    def curves(s: Floats) -> Floats:
        return np.stack([surface.points(s, np.full(len(s), t), np.zeros(len(s))) for t in (-8.0, 0.0, 8.0)], axis=1)

    s = refined(curves, np.array([0.0, 150.0]))
    fine = curves(np.linspace(0.0, 150.0, 20_001))
    for row in range(3):
        line = simplified(curves(s)[:, row])
        assert _farthest(fine[:, row], line) < 0.0026
        rounded = m_from_cm(cm_from_m(line))  # as a map file has it
        assert _farthest(fine[:, row], rounded) < 0.01
        bend = np.linspace(0.05, -0.05, 1000)  # a chord of length c is c^2 bend / 8 off: the fewest of 2.5 mm
        fewest = 150.0 * np.sqrt(np.abs(bend * (1.0 - (-8.0, 0.0, 8.0)[row] * bend)) / (8.0 * 0.0025)).mean()
        assert len(line) < 2.0 * fewest  # splitting at the worst vertex can double it, no more


def test_a_straight_line_is_two_vertices_and_a_wild_one_is_refused() -> None:
    assert len(simplified(np.linspace((0.0, 0.0, 0.0), (1000.0, 0.0, 10.0), 50))) == 2

    def wild(s: Floats) -> Floats:
        return np.column_stack((s, 1e6 * np.sin(1e3 * s), s))[:, None]

    with pytest.raises(EgolocError, match="expected curves that 200000 vertices can follow"):
        refined(wild, np.array([0.0, 1e6]))
