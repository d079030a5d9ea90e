"""Predicted localizability: closed forms, invariance, and a Monte Carlo of real fits."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from scipy.stats import chi2

from sensors.geodesy import MapFrame
from sensors.maps.builder import Builder
from sensors.maps.evidence import CLASSES, Evidence, Model, evidence
from sensors.maps.localizability import chunks, information, judged, localizability
from sensors.maps.vector_map import NO_SURFELS, Elements, Floats, Kind, Style, Surfels, VectorMap
from sensors.simulate.city_map import city_map

MODEL = Model()
HERE, AHEAD = np.zeros((1, 2)), np.zeros(1)
Added = tuple[Kind, Any] | tuple[Kind, Any, Style]


def elements(*added: Added) -> Elements:
    builder = Builder("a test")
    for each in added:
        builder.add(*each)
    return builder.built(MapFrame("enu")).elements


def lines(*offsets: float, kind: Kind = Kind.LANE_LINE, style: Style = Style.SOLID, half: float = 500.0) -> Elements:
    return elements(*((kind, [(-half, y), (half, y)], style) for y in offsets))


def surfels(*rows: tuple[float, float, float, float, float]) -> Surfels:
    columns = np.array(rows)
    normal = columns[:, 2:] / np.linalg.norm(columns[:, 2:], axis=1, keepdims=True)
    return Surfels(columns[:, :2], np.zeros(len(rows)), normal, np.full((len(rows), 2), 0.01))


def info(found: Elements, model: Model = MODEL, patches: Surfels = NO_SURFELS) -> Floats:
    return localizability(found, patches, HERE, AHEAD, model).information[0]


def test_straight_lane_lines_tell_nothing_longitudinally() -> None:
    found = localizability(lines(1.75, -1.75), NO_SURFELS, HERE, AHEAD)
    assert found.information[0, 0] == pytest.approx(0.0, abs=1e-9)
    # the score of EgoVM is flat over its search: the spread of a uniform distribution
    assert found.sigma[0, 0] == pytest.approx(3.0 / math.sqrt(3.0))
    # 9 cells along, in each 10 pieces (8 in all of the ends) of two lines that share an error
    cells = np.array([5.0, *[10.0] * 7, 5.0]) * 2.0
    assert found.information[0, 1, 1] == pytest.approx((1.0 / (0.1**2 / cells + 0.1**2)).sum())
    assert found.sigma[0, 1] < 0.1
    assert math.degrees(found.sigma[0, 2]) < 1.0
    assert abs(found.weakest[0]) == pytest.approx(0.0, abs=1e-6)


def test_lines_across_the_road_tell_the_other_axis() -> None:
    found = localizability(lines(1.75), NO_SURFELS, HERE, np.array([np.pi / 2]))
    assert found.information[0, 1, 1] == pytest.approx(0.0, abs=1e-9)
    assert abs(found.weakest[0]) == pytest.approx(np.pi / 2)
    stop = localizability(elements((Kind.STOP_LINE, [(10.0, -1.7), (10.0, 1.7)])), NO_SURFELS, HERE, AHEAD)
    assert stop.sigma[0, 0] < 0.2


def test_one_pole_has_the_known_covariance() -> None:
    """At d straight ahead: longitudinal from it alone; lateral and yaw only together, but for the search."""
    d, variance = 20.0, MODEL.pole_m**2 + MODEL.shared_m**2
    found = localizability(elements((Kind.POLE, [(d, 0.0, 0.0), (d, 0.0, 5.0)])), NO_SURFELS, HERE, AHEAD)
    wanted = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, d], [0.0, d, d * d]]) / variance
    np.testing.assert_allclose(found.information[0], wanted, rtol=1e-9, atol=1e-9)
    search = np.array([3.0, 3.0, math.radians(3.0)]) ** 2 / 3.0
    covariance = np.linalg.inv(wanted + np.diag(1.0 / search))
    np.testing.assert_allclose(found.sigma[0] ** 2, covariance.diagonal(), rtol=1e-9)
    assert found.degenerate((0.6, 0.3, math.radians(1.0)), 1 / 3).tolist() == [[False, True, True]]


def test_two_poles_far_apart_tell_all() -> None:
    found = info(elements((Kind.POLE, [(30.0, 0.0)]), (Kind.POLE, [(-30.0, 0.0)])))
    variance = MODEL.pole_m**2 + MODEL.shared_m**2
    np.testing.assert_allclose(found, np.diag([2.0, 2.0, 2.0 * 30.0**2]) / variance, atol=1e-8)


def test_surfels_tell_along_the_horizontal_part_of_their_normal() -> None:
    wall = info(elements(), patches=surfels((10.0, 5.0, 1.0, 0.0, 0.0)))
    assert wall[0, 0] == pytest.approx(1.0 / (MODEL.surfel_m**2 + MODEL.shared_m**2))
    assert wall[1, 1] == 0.0
    assert wall[2, 2] == pytest.approx(25.0 * wall[0, 0])
    ground = surfels(*((x, y, 0.02, 0.03, 1.0) for x in range(-30, 30) for y in range(-9, 9)))
    assert not info(elements(), patches=ground).any()


def test_what_is_out_of_reach_or_not_to_be_seen_tells_nothing() -> None:
    assert not info(elements((Kind.POLE, [(40.1, 0.0)]), (Kind.POLE, [(0.0, -40.1)]))).any()
    assert info(elements((Kind.POLE, [(39.9, 39.9)]))).any()
    assert not info(lines(1.0, style=Style.VIRTUAL)).any()
    assert not info(elements((Kind.LANE_LINE, [(1.0, 1.0)]))).any()
    assert len(localizability(elements(), NO_SURFELS, HERE, AHEAD)) == 1


def test_ends_count_where_no_line_goes_on() -> None:
    going_on = elements((Kind.LANE_LINE, [(-500, 0), (10, 0)]), (Kind.LANE_LINE, [(500, 0), (10.2, 0)]))
    assert info(going_on)[0, 0] == pytest.approx(0.0, abs=1e-9)
    ending = elements((Kind.LANE_LINE, [(-500, 0), (10, 0)]))
    wanted = 1.0 / (MODEL.line_end_m**2 + MODEL.shared_m**2)
    assert info(ending)[0, 0] == pytest.approx(wanted)
    # the same line twice has no other to go on with: its ends stay ends
    twice = elements(*2 * [(Kind.LANE_LINE, [(-500, 0), (10, 0)])])
    assert wanted < info(twice)[0, 0] < 2.0 * wanted
    other_kind = elements((Kind.LANE_LINE, [(-500, 0), (10, 0)]), (Kind.ROAD_BOUNDARY, [(10, 0), (500, 0)]))
    assert info(other_kind)[0, 0] == pytest.approx(wanted)
    ring = [(0, 0), (1, 0), (1, 1), (0, 0)]
    assert len(evidence(elements((Kind.MARKING, ring)), NO_SURFELS, MODEL).weight) == 2 + 2  # the last edge is 1.4 m


def test_dashes_count_where_they_are_asked_for() -> None:
    dashed = lines(0.0, style=Style.DASHED)
    assert info(dashed)[0, 0] == pytest.approx(0.0, abs=1e-9)
    weak = replace(MODEL, dash_end_m=0.5, dash_period_m=10.0)
    per_cell = np.array([5.0, *[10.0] * 7, 5.0]) * 0.2 / 0.5**2
    assert info(dashed, weak)[0, 0] == pytest.approx((1.0 / (1.0 / per_cell + 0.1**2)).sum())
    assert info(lines(0.0), weak)[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_an_edge_round_the_earth_does_not_fill_memory() -> None:
    far = elements((Kind.ROAD_BOUNDARY, [(-2e7, 0.0), (2e7, 0.0)]), (Kind.POLE, [(5.0, 0.0)]))
    assert len(evidence(far, NO_SURFELS, MODEL).weight) == 10_000 + 2
    assert np.isfinite(info(far)).all()


def test_signs_are_at_the_middle_of_their_corners() -> None:
    face = [(10.0, 1.0, 2.0), (10.0, 3.0, 2.0), (10.0, 3.0, 4.0), (10.0, 1.0, 4.0), (10.0, 1.0, 2.0)]
    found = evidence(elements((Kind.SIGN, face), (Kind.SIGN, [(7.0, 7.0)])), NO_SURFELS, MODEL)
    np.testing.assert_allclose(found.place, [(10, 2), (7, 7), (10, 2), (7, 7)])


def test_how_finely_a_line_is_drawn_does_not_matter() -> None:
    coarse = elements((Kind.ROAD_BOUNDARY, [(-90.0, 2.0), (90.0, 2.0)]))
    fine = elements((Kind.ROAD_BOUNDARY, [(x, 2.0) for x in np.linspace(-90.0, 90.0, 721)]))
    np.testing.assert_allclose(info(fine), info(coarse), rtol=0.01, atol=0.5)


def test_repeating_elements_does_not_make_them_surer() -> None:
    once = lines(1.75, -1.75)
    many = lines(*50 * [1.75, -1.75])
    ratio = info(many)[1, 1] / info(once)[1, 1]
    assert 1.0 < ratio < 1.06
    assert info(many)[1, 1] <= 9.0 / MODEL.shared_m**2


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.floats(-np.pi, np.pi), st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
def test_turning_and_moving_the_world_changes_nothing(seed: int, angle: float, east: float, north: float) -> None:
    rng = np.random.default_rng(seed)
    xy, heading = rng.uniform(-20, 20, (5, 2)), rng.uniform(-np.pi, np.pi, 5)
    drawn = [rng.uniform(-60, 60, (n, 2)) for n in (2, 5, 4, 1, 1)]
    kinds = (Kind.LANE_LINE, Kind.ROAD_BOUNDARY, Kind.CROSSING, Kind.POLE, Kind.SIGN)
    patches = np.column_stack((rng.uniform(-60, 60, (30, 2)), rng.normal(size=(30, 3))))
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    move = lambda places: places @ turn.T + (east, north)  # noqa: E731
    turned = np.column_stack((move(patches[:, :2]), patches[:, 2:4] @ turn.T, patches[:, 4]))
    before = localizability(elements(*zip(kinds, drawn, strict=True)), surfels(*patches), xy, heading)
    there = elements(*((kind, move(places)) for kind, places in zip(kinds, drawn, strict=True)))
    after = localizability(there, surfels(*turned), move(xy), heading + angle)
    np.testing.assert_allclose(after.sigma, before.sigma, rtol=1e-6)
    scale = np.abs(before.information).max()
    np.testing.assert_allclose(after.information, before.information, rtol=1e-6, atol=1e-6 * scale)


def _scene() -> tuple[VectorMap, Floats, Floats]:
    """A junction's corner of a made-up city, and a pose in it."""
    city = city_map(1.0, 5)
    line = city.elements.vertices(0)
    step = line[1, :2] - line[0, :2]
    return city, line[3:4, :2], np.array([math.atan2(step[1], step[0])])


def _plain(found: Evidence, pose: Floats, yaw: float, model: Model) -> tuple[Floats, Floats, Floats]:
    """Jacobians (n, 3) and cells (n,) of what is seen, and the covariance (n, n) of its errors, without a kernel."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    to_body = np.array([[cos, sin], [-sin, cos]])
    r, n = (found.place - pose) @ to_body.T, found.normal @ to_body.T
    seen = (np.abs(r) <= model.reach_m).all(axis=1)
    r, n = r[seen], n[seen]
    jacobian = np.column_stack((n, r[:, 0] * n[:, 1] - r[:, 1] * n[:, 0]))
    cell = np.column_stack((found.group[seen], np.floor(r / model.cell_m + 0.5)))
    shared = (cell[:, None] == cell[None]).all(axis=2) * (n @ n.T) * model.shared_m**2
    return jacobian, cell, np.diag(1.0 / found.weight[seen]) + shared


def test_the_kernel_is_the_plain_formula() -> None:
    city, xy, heading = _scene()
    found = evidence(city.elements, city.surfels, MODEL)
    jacobian, cell, covariance = _plain(found, xy[0], heading[0], MODEL)
    assert len(np.unique(cell[:, 0])) == CLASSES
    wanted = jacobian.T @ np.linalg.solve(covariance, jacobian)
    np.testing.assert_allclose(information(found, xy, heading, MODEL)[0], wanted, rtol=1e-8, atol=1e-4)


def test_fits_to_noisy_observations_spread_as_predicted() -> None:
    """Gauss-Newton from simulated places of the pieces, each with its own error and its cell's, 600 times."""
    city, xy, heading = _scene()
    model = replace(MODEL, piece_m=3.0, surfel_m=0.3)
    found = evidence(city.elements, city.surfels.chosen(slice(0, None, 5)), model)
    covariance = _plain(found, xy[0], heading[0], model)[2]
    root, weight = np.linalg.cholesky(covariance), np.linalg.inv(covariance)
    cos, sin = math.cos(heading[0]), math.sin(heading[0])
    body = (found.place - xy[0]) @ np.array([[cos, -sin], [sin, cos]])
    n = found.normal @ np.array([[cos, -sin], [sin, cos]])
    seen = (np.abs(body) <= model.reach_m).all(axis=1)
    body, n = body[seen], n[seen]
    rng = np.random.default_rng(11)
    errors = []
    for _ in range(600):
        noise, pose = root @ rng.normal(size=len(body)), np.zeros(3)
        for _ in range(4):  # the true pose is 0: where the pieces are seen, less where the pose puts them
            c, s = math.cos(pose[2]), math.sin(pose[2])
            at = (body - pose[:2]) @ np.array([[c, -s], [s, c]])
            normal = n @ np.array([[c, -s], [s, c]])
            residual = ((body - at) * normal).sum(axis=1) + noise
            j = np.column_stack((normal, at[:, 0] * normal[:, 1] - at[:, 1] * normal[:, 0]))
            step = np.linalg.solve(j.T @ weight @ j, j.T @ weight @ -residual)
            pose = pose + np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])
        errors.append(pose)
    nees = np.einsum("ni,ij,nj->n", errors, information(found, xy, heading, model)[0], errors)
    low, high = chi2.ppf([0.001, 0.999], 3 * len(nees)) / len(nees)
    assert low < nees.mean() < high
    predicted = judged(information(found, xy, heading, model), model).sigma[0]
    low, high = np.sqrt(chi2.ppf([0.001, 0.999], len(errors)) / len(errors))
    spread = np.sqrt((np.array(errors) ** 2).mean(axis=0)) / predicted
    assert (low < spread).all()
    assert (spread < high).all()


def test_chunks_are_all_poses_once_and_near_each_other() -> None:
    xy = np.random.default_rng(3).uniform(-2000, 9000, (5000, 2))
    rows = list(chunks(xy))
    assert np.array_equal(np.sort(np.concatenate(rows)), np.arange(5000))
    assert max(np.ptp(xy[part], axis=0).max() for part in rows) <= 500.0
    assert list(chunks(np.empty((0, 2)))) == []
