"""Worlds along the roads of a network: of their seed, level with the drives, and as their vector maps say."""

from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from sensors.maps.vector_map import Kind, Style, VectorMap
from sensors.simulate.drive import DriveConfig, map_frame, plan
from sensors.simulate.environment import Environment, Road
from sensors.simulate.furnishing import HALF_WIDTH_M, SURVEY_M
from sensors.simulate.lidar import poses
from sensors.simulate.network import NetworkPlan, build_network
from sensors.simulate.planning import PlannedDrive
from sensors.simulate.scene import FIRST, GROUND, Hits, Scene
from sensors.simulate.solids import CURB_M, METAL, POLE_RADIUS_M, RETROREFLECTIVE, WHITE, YELLOW
from sensors.simulate.world import BODY_M, World

Floats = NDArray[np.float64]
ENVIRONMENTS = {
    "city": Environment(share=80.0),
    "bridge": Environment(share=20.0, length_min_m=100.0, length_max_m=300.0, road=Road(rise_m=4.0)),
}
CONFIG = DriveConfig(network=NetworkPlan(length_km=20.0), environments=ENVIRONMENTS)
RADIUS_M = 100.0


def world_of(planned: PlannedDrive, seed: int = 0, axes: Literal["utm", "enu"] = "utm") -> World:
    start = CONFIG.start
    llh = np.radians(start.latitude_deg), np.radians(start.longitude_deg), start.height_m
    assert CONFIG.network is not None
    return World(build_network(CONFIG.network, ENVIRONMENTS, 0), llh, map_frame(planned.truth, axes), seed)


@pytest.fixture(scope="module")
def planned() -> PlannedDrive:
    return plan(300.0, 0, CONFIG)


@pytest.fixture(scope="module")
def world(planned: PlannedDrive) -> World:
    return world_of(planned)


@pytest.fixture(scope="module")
def way(planned: PlannedDrive, world: World) -> Floats:
    """(N, 3) m of the body, once a second."""
    return poses(planned.truth, world.frame, planned.truth.start_ns + np.arange(300) * 10**9)[0]


@pytest.fixture(scope="module")
def scene(world: World, way: Floats) -> Scene:
    return world.scene(way[100, :2], RADIUS_M)


@pytest.fixture(scope="module")
def known(world: World, way: Floats) -> VectorMap:
    return world.vector_map(world.near(way[100, :2] - 60.0, way[100, :2] + 60.0))


def down(scene: Scene, xy: Floats) -> Hits:
    """What rays hit that fall from 30 m on places (N, 2) m; one height for all: no ground is so steep."""
    origins = np.column_stack((xy, np.full(len(xy), scene.ground.max() + 30.0)))
    rays = np.broadcast_to([[[0.0, 0.0, -1.0]]], (len(xy), 1, 3))
    turned = np.broadcast_to(np.eye(3), (len(xy), 3, 3))
    return Hits(*(column[:, 0] for column in scene.cast(origins, turned, np.ascontiguousarray(rays), 200.0)))


def rows(known: VectorMap, scene: Scene, kind: Kind, style: Style = Style.UNKNOWN) -> list[Floats]:
    """Vertices of the elements of a sort that lie within the scene."""
    elements, middle = known.elements, scene.corner + RADIUS_M
    chosen = np.flatnonzero((elements.kind == kind) & (elements.style == style))
    vertices = [elements.vertices(row) for row in chosen]
    return [v for v in vertices if np.abs(v[:, :2] - middle).max() < RADIUS_M - 5.0]


def test_it_is_that_of_its_seed_whatever_was_asked_before(planned: PlannedDrive, world: World, scene: Scene) -> None:
    middle = scene.corner + RADIUS_M
    again, other = world_of(planned), world_of(planned, 1)
    again.scene(middle + 500.0, 50.0)
    for edge in world.near(middle - 50.0, middle + 50.0):
        for mine, same in zip(world.street(edge).solids, again.street(edge).solids, strict=True):
            np.testing.assert_array_equal(mine, same)
        assert not np.array_equal(world.street(edge).solids.posts, other.street(edge).solids.posts)


@pytest.mark.parametrize("axes", ["utm", "enu"])
def test_drives_ride_on_its_ground(planned: PlannedDrive, axes: Literal["utm", "enu"]) -> None:
    """Over bridges too, whose rise the banks must have in full on the road, and where the map does not bend."""
    world = world_of(planned, axes=axes)
    way, _ = poses(planned.truth, world.frame, planned.truth.start_ns + np.arange(300) * 10**9)
    on = world.along(way[:, :2], 5.0)
    assert max(world.middle(edge).rise.max() for edge in on) > 0.5
    np.testing.assert_allclose(way[:, 2] - world.height(way[:, :2]), BODY_M, atol=0.03)


def test_nothing_stands_in_the_way_of_a_drive(world: World, way: Floats) -> None:
    """Level rays from the body, at two heights, all along: parked cars are nearest, on both sides."""
    angle = np.linspace(-np.pi, np.pi, 90, endpoint=False)
    rays = np.ascontiguousarray(np.stack((np.cos(angle), np.sin(angle), 0.0 * angle), axis=-1)[None])
    for place in way[::10]:
        around = world.scene(place[:2], 40.0)
        for height in (0.0, 1.0):
            found = around.cast(place[None] + (0.0, 0.0, height), np.eye(3)[None], rays, 30.0)
            assert np.where(found.what >= FIRST, found.distance, np.inf).min() > 2.0


def test_lines_of_the_map_are_painted(scene: Scene, known: VectorMap) -> None:
    yellow = np.concatenate([0.5 * (v[1:] + v[:-1]) for v in rows(known, scene, Kind.LANE_LINE, Style.DOUBLE_SOLID)])
    stops = np.array([v.mean(axis=0) for v in rows(known, scene, Kind.STOP_LINE, Style.SOLID)])
    assert len(yellow) > 30
    assert len(stops) > 1
    for place, offset, bright in ((yellow, 0.15, YELLOW), (stops, 0.0, WHITE)):
        # the two lines of a double one lie so far beside it, whichever way it runs
        tries = [down(scene, place[:, :2] + offset * np.array([np.cos(a), np.sin(a)])) for a in np.arange(0, 6.3, 0.1)]
        assert (np.max([found.reflectivity * (found.what == GROUND) for found in tries], axis=0) == bright).all()
    bare = down(scene, yellow[:, :2])
    assert (bare.reflectivity[bare.what == GROUND] < YELLOW).all()


def test_dashes_and_zebras_are_painted_in_part(scene: Scene, known: VectorMap) -> None:
    dashed = rows(known, scene, Kind.LANE_LINE, Style.DASHED)
    along = np.linspace(0.0, 1.0, 31)[:, None]
    points = np.concatenate([a + (b - a) * along for v in dashed for a, b in pairwise(v)])
    bright = down(scene, points[:, :2]).reflectivity
    assert set(np.unique(bright)) >= {WHITE}
    assert 0.25 < (bright == WHITE).mean() < 0.40
    rings = rows(known, scene, Kind.CROSSING, Style.ZEBRA)
    share = np.linspace(0.005, 0.995, 500)[:, None]
    across = np.concatenate([0.5 * (v[0] + v[3]) * (1 - share) + 0.5 * (v[1] + v[2]) * share for v in rings])
    found = down(scene, across[:, :2])
    assert 0.45 < (found.reflectivity[found.what == GROUND] == WHITE).mean() < 0.55


def test_curbs_are_steps(world: World, scene: Scene, known: VectorMap) -> None:
    curbs = rows(known, scene, Kind.ROAD_BOUNDARY, Style.CURB)
    along = np.concatenate([v[1:] - v[:-1] for v in curbs])[:, :2]
    middle = np.concatenate([0.5 * (v[1:] + v[:-1]) for v in curbs])
    left = 0.3 * np.stack((-along[:, 1], along[:, 0]), axis=-1) / np.linalg.norm(along, axis=1, keepdims=True)
    sides = []
    for place in (middle[:, :2] + left, middle[:, :2] - left):
        found = down(scene, place)
        sides.append(scene.ground.max() + 30.0 - found.distance - world.height(place))
    low, high = np.minimum(*sides), np.maximum(*sides)
    free = high < 0.5  # no car or crown over it
    assert free.mean() > 0.5
    np.testing.assert_allclose(low[free], 0.0, atol=1e-6)
    np.testing.assert_allclose(high[free], CURB_M, atol=0.02)


def test_poles_and_signs_stand_where_the_map_has_them(scene: Scene, known: VectorMap) -> None:
    poles = rows(known, scene, Kind.POLE)
    assert len(poles) > 3
    for foot, top in poles:
        for share in (0.3, 0.95):  # not where a sign hangs
            spot = foot + share * (top - foot)
            found = scene.cast((spot - (0.2, 0.0, 0.0))[None], np.eye(3)[None], np.array([[[1.0, 0.0, 0.0]]]), 2.0)
            assert found.reflectivity[0, 0] == METAL
            assert found.distance[0, 0] == pytest.approx(0.2 - POLE_RADIUS_M, abs=1e-9)
    faces = rows(known, scene, Kind.SIGN)
    assert faces
    for ring in faces:
        u, v = ring[1] - ring[0], ring[3] - ring[0]
        normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
        spot = ring[0] + 0.25 * u + 0.75 * v
        for side in (normal, -normal):
            found = scene.cast((spot + 0.2 * side)[None], np.eye(3)[None], -side[None, None], 1.0)
            assert found.reflectivity[0, 0] == RETROREFLECTIVE
            assert found.distance[0, 0] == pytest.approx(0.2, abs=1e-9)


def test_curbs_keep_off_other_streets(world: World) -> None:
    """No curb lies on the road of another street: they end where that one begins."""
    for edge in range(0, 40, 5):
        ends = world.street(edge).blocks[3].xyz[:, :2]
        for other in world.near(ends.min(axis=0), ends.max(axis=0)):
            if other != edge:
                apart = np.linalg.norm(ends[:, None] - world.middle(other).xy, axis=-1)
                assert apart.min() >= HALF_WIDTH_M


def test_its_map_is_exact_or_surveyed(world: World) -> None:
    exact, surveyed = world.vector_map(range(10)), world.vector_map(range(10), surveyed=True)
    assert exact.road_km == pytest.approx(np.diff(world.network.line)[:10].sum() / 1000.0)
    assert len(set(exact.elements.name)) == len(exact.elements)
    assert set(exact.elements.kind) == set(Kind)
    error = surveyed.elements.xyz - exact.elements.xyz
    assert 0.9 * SURVEY_M < error.std() < 1.1 * SURVEY_M
    np.testing.assert_array_equal(world.vector_map(range(10), surveyed=True).elements.xyz, surveyed.elements.xyz)
    whole = replace(exact, elements=exact.elements.chosen(exact.elements.kind == Kind.POLE))
    assert len(whole.elements) == sum(len(world.street(edge).blocks[-2].counts) for edge in range(10))
