"""Routes to judge a map along: its own lines, once each road, and given drives."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map, map_from_llh
from sensors.maps.builder import Builder
from sensors.maps.formats import read_map
from sensors.maps.localizability import along, localizability
from sensors.maps.map_file import MapFile, open_map
from sensors.maps.route import Route, route_of_map, route_of_trajectory
from sensors.maps.store import write_map
from sensors.maps.vector_map import Floats, Kind, Style, VectorMap
from sensors.maps.ways import chained
from sensors.records import Trajectory
from sensors.simulate.city_map import city_map

UTM = MapFrame("utm", (455_000.0, 5_427_000.0, 0.0), 32)


def file_of(path: Path, vector_map: VectorMap, tile_m: float = 1000.0) -> MapFile:
    write_map(vector_map, path, tile_m)
    return open_map(path)


def lines_map(*lines: list[tuple[float, float]], kind: Kind = Kind.LANE_LINE, frame: MapFrame = UTM) -> VectorMap:
    builder = Builder("a test")
    for line in lines:
        builder.add(kind, line)
    return builder.built(frame)


def drive(xy: Floats, q: Floats | None = None) -> Trajectory:
    t = np.arange(len(xy)) * 10**8
    return Trajectory(t, t, np.column_stack((xy, np.zeros(len(xy)))), q)


def straight(length: float, y: float = 0.0) -> Floats:
    x = np.arange(0.0, length, 1.0)
    return np.column_stack((x, np.full(len(x), y)))


def test_a_road_of_several_lines_is_judged_once(tmp_path: Path) -> None:
    lines = [[(0.0, y), (1000.0, y)] for y in (-5.25, -1.75, 1.75, 5.25)]
    other = [(0.0, 100.0), (500.0, 100.0)]
    with file_of(tmp_path / "a", lines_map(*lines, other)) as opened:
        route = route_of_map(opened)
    assert len(route) == 200 + 100
    assert route.km == pytest.approx(1.5)
    assert len(np.unique(route.way)) == 2
    assert np.unique(route.xy[:, 1]).tolist() == [-5.25, 100.0]
    np.testing.assert_allclose(np.hypot(*np.diff(route.xy[route.way == 0], axis=0).T), 5.0)
    np.testing.assert_allclose(np.sin(route.heading), 0.0, atol=1e-9)


def test_pieces_of_a_road_are_one_way_in_order(tmp_path: Path) -> None:
    """Lanelets: short lines in any order and direction."""
    rng = np.random.default_rng(2)
    cuts = np.concatenate(([0.0], np.cumsum(rng.uniform(15.0, 40.0, 60))))
    pieces = [[(a, 0.0), (b, 0.0)][:: rng.choice([-1, 1])] for a, b in pairwise(cuts)]
    with file_of(tmp_path / "a", lines_map(*(pieces[i] for i in rng.permutation(len(pieces)))), 200.0) as opened:
        assert len(opened.boxes) > 5
        route = route_of_map(opened)
    assert len(np.unique(route.way)) == 1
    step = np.diff(route.xy[:, 0])
    assert (np.sign(step) == np.sign(step[0])).all()
    assert np.abs(step).max() < 10.0
    # at a joint two places nearer than 3 m to each other are one
    assert 0.95 < route.km / (cuts[-1] / 1e3) <= 1.0
    np.testing.assert_allclose(np.cos(route.heading), np.sign(step[0]), atol=1e-9)


def test_crossing_roads_are_both_judged(tmp_path: Path) -> None:
    crossing = lines_map([(-200.0, 0.0), (200.0, 0.0)], [(0.0, -200.0), (0.0, 200.0)])
    with file_of(tmp_path / "a", crossing) as opened:
        assert route_of_map(opened).km == pytest.approx(0.8)


def test_boundaries_lead_where_there_are_no_lane_lines(tmp_path: Path) -> None:
    with file_of(tmp_path / "a", lines_map([(0.0, 0.0), (100.0, 0.0)], kind=Kind.ROAD_BOUNDARY)) as opened:
        assert len(route_of_map(opened)) == 20
    with file_of(tmp_path / "b", lines_map([(0.0, 0.0), (100.0, 0.0)], kind=Kind.STOP_LINE)) as opened:
        assert len(route_of_map(opened)) == 0
    with file_of(tmp_path / "c", lines_map()) as opened:
        assert len(route_of_map(opened)) == 0
    builder = Builder("a test")
    builder.add(Kind.LANE_LINE, [(0.0, 0.0), (100.0, 0.0)], Style.VIRTUAL)
    builder.add(Kind.LANE_LINE, [(0.0, 50.0)])
    with file_of(tmp_path / "d", builder.built(UTM)) as opened:
        assert len(route_of_map(opened)) == 20


def test_a_city_is_covered(tmp_path: Path) -> None:
    city = city_map(4.0, 2)
    with file_of(tmp_path / "a", city, 300.0) as opened:
        route = route_of_map(opened)
        assert city.road_km is not None
        assert 0.8 * city.road_km < route.km < 1.05 * city.road_km
        found = along(opened, route.xy, route.heading)
    whole = localizability(city.elements, city.surfels, route.xy, route.heading)
    # the file holds whole centimetres
    np.testing.assert_allclose(found.sigma, whole.sigma, rtol=0.02)


@pytest.mark.parametrize(
    ("name", "share"),
    [
        ("maps/lanelet2/mapping_example.osm", (0.8, 1.2)),
        ("maps/autoware/2km_test.osm", (0.95, 1.05)),
        ("maps/opendrive/fabriksgatan.xodr", (0.8, 1.2)),
        ("av2/3b3570b4-7b0b-3268-a571-b0889dbf40b6", (0.8, 1.2)),
    ],
)
def test_real_maps_are_covered(data: Path, tmp_path: Path, name: str, share: tuple[float, float]) -> None:
    vector_map, _ = read_map(data / name)
    with file_of(tmp_path / "a", vector_map) as opened:
        route = route_of_map(opened)
        found = along(opened, route.xy, route.heading)
    assert vector_map.road_km is not None
    assert share[0] < route.km / vector_map.road_km < share[1]
    assert np.isfinite(found.sigma).all()
    assert (np.linalg.eigvalsh(found.information) > -1e-6 * np.abs(found.information).max()).all()


def test_a_given_drive_is_thinned_and_keeps_its_attitude(tmp_path: Path) -> None:
    xy = np.concatenate((np.zeros((50, 2)), straight(100.0), np.tile((99.0, 0.0), (50, 1))))
    with file_of(tmp_path / "a", lines_map([(0.0, 2.0), (100.0, 2.0)])) as opened:
        route = route_of_trajectory(drive(xy), "drive.csv", opened)
        assert len(route) == 20
        np.testing.assert_allclose(route.xy[:, 0], np.arange(20) * 5.0 + 2.5)
        np.testing.assert_allclose(route.heading, 0.0)
        q = np.tile((0.0, 0.0, math.sin(0.25), math.cos(0.25)), (len(xy), 1))
        np.testing.assert_allclose(route_of_trajectory(drive(xy, q), "drive.csv", opened).heading, 0.5)


def test_a_drive_in_another_frame_is_brought_into_the_maps(tmp_path: Path) -> None:
    llh = llh_from_map(UTM, np.column_stack((straight(100.0), np.zeros(100))))
    lat, lon = np.degrees(llh[0, :2]).tolist()
    plane = MapFrame("enu", (lat, lon, 0.0))
    there = map_from_llh(plane, llh)
    with file_of(tmp_path / "a", lines_map([(0.0, 2.0), (100.0, 2.0)])) as opened:
        t = np.arange(100) * 10**8
        nose = there[-1] - there[0]
        yaw = math.atan2(nose[1], nose[0])
        q = np.tile((0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)), (100, 1))
        route = route_of_trajectory(Trajectory(t, t, there, q), "drive", opened, plane)
    np.testing.assert_allclose(route.xy[:, 0], np.arange(20) * 5.0 + 2.5, atol=0.04)
    np.testing.assert_allclose(route.heading, 0.0, atol=1e-5)
    np.testing.assert_allclose(route.xy[:, 1], 0.0, atol=1e-3)


def test_a_route_that_does_not_fit_the_map_is_refused(tmp_path: Path) -> None:
    with file_of(tmp_path / "a", lines_map([(0.0, 2.0), (100.0, 2.0)])) as opened:
        with pytest.raises(
            EgolocError, match=r"^d: expected a route in the frame of .*a, it comes no nearer .* 5\.\d km$"
        ):
            route_of_trajectory(drive(straight(100.0, 5300.0)), "d", opened)
        with pytest.raises(EgolocError, match=r"^d: expected a route in the map's frame, it is in a local one"):
            route_of_trajectory(drive(straight(100.0)), "d", opened, MapFrame("enu"))
        with pytest.raises(EgolocError, match=r"^d: expected a route of 10 m or more, got 3.0 m"):
            route_of_trajectory(drive(straight(4.0)), "d", opened)
    with file_of(tmp_path / "b", lines_map([(0.0, 2.0), (100.0, 2.0)], frame=MapFrame("enu"))) as opened:
        with pytest.raises(EgolocError, match="the map is in a local one without a datum"):
            route_of_trajectory(drive(straight(100.0)), "d", opened, UTM)
        assert isinstance(route_of_trajectory(drive(straight(100.0)), "d", opened), Route)
    with file_of(tmp_path / "c", lines_map()) as opened, pytest.raises(EgolocError, match="it is empty"):
        route_of_trajectory(drive(straight(100.0)), "d", opened)


def test_ways_do_not_turn_back() -> None:
    """Two parallel roads that end beside each other are two ways."""
    xy = np.concatenate((straight(50.0)[::5], straight(50.0, 8.0)[::5]))
    order, turned, way = chained(xy, np.zeros(20), np.repeat([0, 1], 10), 5.0)
    assert way.tolist() == [0] * 10 + [1] * 10
    assert order.tolist() == list(range(20))
    assert not turned.any()
