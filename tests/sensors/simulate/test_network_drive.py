"""Drives over a road network: geometry of the way, limits kept, places on the roads, shares, determinism."""

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.rotation import rpy_from_q
from sensors.simulate import scenarios
from sensors.simulate.corners import Corners, round_off
from sensors.simulate.drive import plan
from sensors.simulate.driver import Driver
from sensors.simulate.following import offsets
from sensors.simulate.itinerary import Itinerary, itinerary
from sensors.simulate.network import Network, build_network
from sensors.simulate.plane import Plane
from sensors.simulate.planning import PlannedDrive, plan_drive
from sensors.simulate.route import CityPlan, Route
from tests.sensors.simulate.roads import ENVIRONMENTS, PLAN, START_LLH, START_NS

Floats = NDArray[np.float64]
SEEDS = range(4)


@pytest.fixture(scope="module")
def network() -> Network:
    return build_network(PLAN, ENVIRONMENTS, 0)


@pytest.fixture(scope="module", params=SEEDS)
def way(network: Network, request: pytest.FixtureRequest) -> Itinerary:
    return itinerary(network, 30_000.0, request.param)


def planned(seed: int, **limits: float) -> PlannedDrive:
    return plan_drive(PLAN, ENVIRONMENTS, Driver(), START_LLH, START_NS, seed, **limits)


def samples(drive: PlannedDrive, rate_hz: float) -> NDArray[np.int64]:
    return START_NS + np.arange(int(drive.duration_s * rate_hz)) * round(1e9 / rate_hz)


def route_of(lengths: list[float], curvature: list[float]) -> Route:
    edges = np.concatenate(([0.0], np.cumsum(lengths)))
    none = np.empty(0)
    return Route(edges, np.array(curvature), np.full(len(lengths), 10.0), none, none, edges, edges * 0, edges * 0)


def test_the_place_on_a_route_has_a_closed_form() -> None:
    quarter = route_of([100.0, 10 * np.pi, 50.0], [0.0, 1 / 20.0, 0.0])
    np.testing.assert_allclose(
        quarter.place(np.array([0.0, 60.0, 100.0, 100.0 + 5 * np.pi, 100.0 + 10 * np.pi, 150.0 + 10 * np.pi])),
        [[0, 0], [60, 0], [100, 0], [100 + 20 * np.sin(np.pi / 4), 20 - 20 * np.cos(np.pi / 4)], [120, 20], [120, 70]],
        atol=1e-9,
    )
    circle = route_of([2 * np.pi * 30.0], [-1 / 30.0])
    np.testing.assert_allclose(circle.place(np.array([2 * np.pi * 30.0, np.pi * 30.0]), 1.0)[0], 0.0, atol=1e-9)


def test_a_right_angle_is_rounded_off_by_its_setback_and_sharper_turns_keep_the_radius() -> None:
    xy = np.array([[0.0, 0.0], [200.0, 0.0], [200.0, 100.0]])
    curves = round_off(Corners(xy, np.zeros(3), np.array([0.0, 12.0, 0.0])))
    np.testing.assert_allclose(np.diff(curves.edges), [188.0, 6 * np.pi, 88.0])
    np.testing.assert_allclose(curves.curvature, [0.0, 1 / 12.0, 0.0])
    along = np.interp([188.0, 200.0, 212.0], curves.polyline, curves.rounded)
    np.testing.assert_allclose(along, [188.0, 188 + 3 * np.pi, 188 + 6 * np.pi])
    back = np.array([[0.0, 0.0], [200.0, 0.0], [200.0 - 100 / np.sqrt(2), 100 / np.sqrt(2)]])
    sharp = round_off(Corners(back, np.zeros(3), np.array([0.0, 12.0, 0.0])))
    assert sharp.curvature[1] == pytest.approx(1 / 12.0)
    bend = round_off(Corners(xy, np.array([0.0, 40.0, 0.0]), np.zeros(3)))
    assert bend.curvature[1] == pytest.approx(1 / 40.0)
    # no more than the shorter street leaves room for
    tight = round_off(Corners(xy, np.array([0.0, 400.0, 0.0]), np.zeros(3)))
    assert tight.curvature[1] == pytest.approx(1 / 45.0)


def test_a_way_is_continuous_and_ends_where_its_roads_end(way: Itinerary) -> None:
    route = way.route
    s = np.arange(0.0, route.edges[-1], 0.5)
    step = np.linalg.norm(np.diff(way.place(s), axis=0), axis=1)
    assert step.max() <= 0.5 + 1e-9
    assert step.min() > 0.499
    turn = np.abs(np.diff(route.heading(s)))
    assert turn.max() <= 0.5 * np.abs(route.curvature).max() + 1e-12
    assert 4.0 < 1 / np.abs(route.curvature).max() < 25.0
    np.testing.assert_allclose(way.place(route.edges[-1:])[0], way.way.corners.xy[-1], atol=1e-6)


def test_no_way_leaves_the_network(network: Network, way: Itinerary) -> None:
    graph, s = network.graph, np.arange(0.0, way.route.edges[-1], 5.0)
    line = way.line(s)
    edge = np.searchsorted(network.line, line, side="right") - 1
    into = line - network.line[edge]
    on_road = np.empty((len(s), 2))
    for row, (e, at) in enumerate(zip(edge, into, strict=True)):
        corners = graph.vertices[graph.first[e] : graph.first[e + 1]]
        reached = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))))
        on_road[row] = [np.interp(at, reached, column) for column in corners.T]
    off = np.linalg.norm(way.place(s) - on_road, axis=1)
    # rounding off a corner leaves it by less than its setback; highways are wider
    assert off[~graph.highway[edge]].max() < 35.0
    assert np.median(off) < 0.5
    roads = way.way.roads
    head, tail = graph.ends[roads // 2, 1 - roads % 2], graph.ends[roads // 2, roads % 2]
    np.testing.assert_array_equal(head[:-1], tail[1:])
    assert (roads[1:] != roads[:-1] ^ 1).all()


def test_stretches_of_the_way_are_those_of_the_network(network: Network, way: Itinerary) -> None:
    s = np.arange(0.0, way.route.edges[-1], 3.0)
    here = way.kind[np.searchsorted(way.edges, s, side="right") - 1]
    there = network.stretches.kind[network.stretches.piece(way.line(s))]
    assert np.mean(here == there) > 0.9999
    limit = network.stretches.speed_limit[network.stretches.piece(way.line(s))]
    assert np.mean(way.route.speed_limit[way.route.element(s)] == limit) > 0.9999
    assert (np.diff(way.edges) > 0).all()
    assert (way.kind[1:] != way.kind[:-1]).all()


def test_lights_are_red_at_junctions_as_often_as_the_environment_says(network: Network) -> None:
    ways = [itinerary(network, 60_000.0, seed) for seed in range(8)]
    passed, red = np.zeros(len(network.names)), np.zeros(len(network.names))
    for way in ways:
        node = way.way.node[1:-1]
        at = way.curves.begins[1:-1][(node >= 0) & network.junction[node]] - 5.0
        passed += np.bincount(way.kind[np.searchsorted(way.edges, at, side="right") - 1], minlength=len(red))
        stops = way.route.stop_at
        red += np.bincount(way.kind[np.searchsorted(way.edges, stops, side="right") - 1], minlength=len(red))
        assert np.isin(np.round(stops, 6), np.round(at, 6)).all()
        assert ((way.route.stop_for >= 5.0) & (way.route.stop_for <= 30.0)).all()
        assert np.diff(stops).min() > 20.0
    share = dict(zip(network.names, red / np.maximum(passed, 1), strict=True))
    assert share["city"] == pytest.approx(0.3, abs=0.05)
    assert share["highway"] == share["tunnel"] == 0.0


@pytest.mark.parametrize("seed", SEEDS)
def test_a_drive_keeps_its_limits_and_its_roads(network: Network, seed: int) -> None:
    drive = planned(seed, length_km=30.0)
    way = itinerary(network, 31_000.0, seed)
    knots = Plane(START_LLH).llh(
        np.column_stack((way.place(drive.course.s), np.interp(drive.course.s, way.route.slope_at, way.height)))
    )
    off = offsets(drive.truth.knots, knots)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.5
    assert np.abs(off[:, 2]).max() < 0.5
    motion = drive.truth.at(samples(drive, 20.0))
    speed = np.linalg.norm(motion.vel_enu, axis=1)
    turn = motion.rate_to_earth()[:, 2]
    assert np.abs(np.diff(speed) * 20.0).max() < 2.4
    assert np.abs(speed * turn).max() < 2.5
    assert np.abs(np.tan(rpy_from_q(motion.q_enu_body)[:, 1])).max() < 0.1
    # the spline changes its speed over a second, on both sides of where the limit does
    place = drive.course.place(motion.t_ns)
    near = place[:, None] + np.linspace(-1.0, 1.0, 21) * np.maximum(speed, 1.0)[:, None]
    limit = way.route.speed_limit[way.route.element(near.ravel())].reshape(near.shape).max(axis=1)
    assert (speed <= 1.01 * limit).all()
    assert 6.0 < speed[speed > 0].mean() < 20.0
    assert (speed[:140] == 0.0).all()


def test_a_length_ends_a_drive_and_so_does_a_duration() -> None:
    by_length = planned(3, length_km=10.0)
    gone = by_length.course.place(np.array([START_NS, START_NS + round(by_length.duration_s * 1e9)]))
    np.testing.assert_allclose(gone, [0.0, 10_000.0], atol=2.0)
    by_time = planned(3, duration_s=300.0)
    assert by_time.duration_s == 300.0
    assert planned(3, duration_s=300.0, length_km=10.0).duration_s == 300.0
    assert planned(3, duration_s=1e5, length_km=10.0).duration_s == by_length.duration_s
    first, last = by_time.truth.span_ns
    assert (by_time.course.t_ns[0], by_time.course.t_ns[-1]) == (first, last)
    with pytest.raises(EgolocError, match="expected a duration or a length"):
        planned(3)


def test_a_longer_drive_begins_with_the_shorter_one() -> None:
    short, long = planned(5, length_km=5.0), planned(5, length_km=12.0)
    t_ns = samples(short, 1.0)[:-30]
    a, b = short.truth.at(t_ns), long.truth.at(t_ns)
    np.testing.assert_allclose(offsets(a.llh, b.llh), 0.0, atol=1e-6)
    np.testing.assert_allclose(short.course.place(t_ns), long.course.place(t_ns), atol=1e-6)


def test_the_same_seed_gives_the_same_drive_and_another_does_not() -> None:
    one, again, other = planned(6, length_km=3.0), planned(6, length_km=3.0), planned(7, length_km=3.0)
    np.testing.assert_array_equal(one.truth.knots, again.truth.knots)
    np.testing.assert_array_equal(one.course.bias, again.course.bias)
    assert other.duration_s != one.duration_s


def test_over_many_drives_environments_are_driven_by_their_shares(network: Network) -> None:
    km = np.zeros(len(network.names))
    edges = np.zeros(len(network.graph.ends))
    for seed in range(300):
        way = itinerary(network, 30_000.0, seed)
        length = np.diff(np.minimum(way.edges, 30_000.0))
        km += np.bincount(way.kind, length, minlength=len(km))
        edges[np.unique(way.way.roads // 2)] += 1
    share = np.array([e.share for e in network.environments])
    np.testing.assert_allclose(km / km.sum(), share / share.sum(), rtol=0.15)
    assert np.mean(edges > 0) > 0.98


def test_no_drive_begins_in_a_tunnel(network: Network) -> None:
    for seed in range(200):
        way = itinerary(network, 1000.0, seed)
        begins = [network.names[k] for k, at in zip(way.kind, way.edges[:-1], strict=True) if at < 300.0]
        assert "tunnel" not in begins


def test_errors_of_the_map_stay_correlated_for_200_m_of_driving(network: Network) -> None:
    lags = np.arange(0, 601, 20)
    products, count = np.zeros((len(lags), 3)), 0
    for seed in range(60):
        drive = planned(seed, length_km=30.0)
        s = np.arange(0.0, 29_000.0, 20.0)
        bias = drive.course.map_bias(s)
        products += [(bias[: len(s) - 30] * bias[k : k + len(s) - 30]).mean(axis=0) for k in range(len(lags))]
        count += 1
    correlation = products / products[0]
    np.testing.assert_allclose(products[0] / count, 1.0, atol=0.15)
    assert (correlation[lags <= 200] > np.exp(-1.0)).all()
    assert (correlation[lags == 600] < 0.35).all()


def test_errors_of_the_map_are_the_same_whenever_a_road_is_driven(network: Network) -> None:
    drives = [(planned(seed, length_km=30.0), itinerary(network, 31_000.0, seed)) for seed in range(12)]
    seen: dict[tuple[int, int], Floats] = {}
    apart = []
    for drive, way in drives:
        s = np.arange(0.0, 30_000.0, 7.0)
        line = way.line(s)
        edge = np.searchsorted(network.line, line, side="right") - 1
        into = np.round(line - network.line[edge]).astype(int)
        for cell, bias in zip(zip(edge.tolist(), into.tolist(), strict=True), drive.course.map_bias(s), strict=True):
            if cell in seen:
                apart.append(np.abs(bias - seen[cell]).max())
            seen[cell] = bias
    assert len(apart) > 100
    assert np.median(apart) < 0.01
    # in turns to different sides the same road is rounded off differently, up to 35 m apart
    assert max(apart) < 0.35


def test_the_course_of_a_city_route_is_its_environment() -> None:
    drive = plan_drive(CityPlan(), {}, Driver(), START_LLH, START_NS, 4, duration_s=600.0)
    assert drive.course.names == ("city",)
    motion = drive.truth.at(samples(drive, 10.0))
    driven = np.concatenate(([0.0], np.cumsum(np.linalg.norm(motion.vel_enu, axis=1)[1:] * 0.1)))
    np.testing.assert_allclose(drive.course.place(motion.t_ns), driven, atol=2.0)
    assert np.abs(np.diff(drive.course.map_bias(np.arange(0.0, driven[-1], 5.0)), axis=0)).max() < 0.15
    by_length = plan_drive(CityPlan(), {}, Driver(), START_LLH, START_NS, 4, length_km=1.0)
    assert by_length.course.place(np.array([START_NS + round(by_length.duration_s * 1e9)]))[0] == pytest.approx(
        1000, abs=2
    )


def test_the_scenario_of_the_docs_plans_a_drive(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs/simulation.md").read_text()
    text = next(block for block in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if "[network]" in block)
    path = tmp_path / "region.toml"
    path.write_text(text)
    scenario = scenarios.load(path)
    drive = plan(None, 3, scenario)
    assert drive.course.names == ("city", "highway", "tunnel")
    assert drive.course.place(np.array([drive.truth.start_ns + round(drive.duration_s * 1e9)]))[0] == pytest.approx(
        12_000.0, abs=2.0
    )
