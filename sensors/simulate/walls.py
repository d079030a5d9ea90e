"""Surfels of a made-up world's houses, as a survey along its streets would find them: what moves or lies flat is not in
them.

A survey turns a LiDAR over the middle of the streets, every SURVEY_EVERY_M, and takes what hits houses. Their points go
the way of a real cloud (``sensors.maps.surfels``): so back walls that no street sees have none.
"""

import numpy as np
from numpy.typing import NDArray

from sensors.maps.surfels import surfels_of
from sensors.maps.vector_map import NO_SURFELS, Surfels
from sensors.simulate.lidar import beams
from sensors.simulate.scene import FIRST, Scene
from sensors.simulate.street_lines import streets
from sensors.simulate.world import World

Floats = NDArray[np.float64]

SURVEY_EVERY_M = 10.0
"""Of street between the turns of a survey, m."""
COLUMNS = 450
"""Of one of its turns."""
LIDAR_M = 1.9
"""Height over the ground of its LiDAR, m."""
RANGE_M = 60.0
RANGE_SIGMA_M = 0.02
"""Noise of a range, one sigma, m."""
HOUSE_M = 3.0
"""What is upright and at least so high is a house's wall: cars, signs and curbs are lower, m."""


def wall_surfels(world: World, scene: Scene, xy: Floats, radius: float, rng: np.random.Generator) -> Surfels:
    """Surfels within radius m of a place (2,) m; scene: of the world, around it at least so wide."""
    places = _survey_places(world, xy, radius)
    if not len(places):
        return NO_SURFELS
    turned = beams(COLUMNS)
    origins = places[:, None].repeat(COLUMNS, axis=1).reshape(-1, 3)
    rays = np.tile(turned, (len(places), 1, 1))
    level = np.broadcast_to(np.eye(3), (len(origins), 3, 3))
    hits = scene.cast(origins, np.ascontiguousarray(level), rays, RANGE_M)
    on_wall = _walls(scene)[np.clip(hits.what - FIRST, -1, len(scene.solids.plates))] & (hits.what >= FIRST)
    ray, beam = np.nonzero(on_wall)
    distance = hits.distance[on_wall] + rng.normal(0.0, RANGE_SIGMA_M, len(ray))
    found = surfels_of(origins[ray] + distance[:, None] * rays[ray, beam])
    near = np.asarray((np.abs(found.p - xy) < radius).all(axis=1))
    return found.chosen(near)


def _survey_places(world: World, xy: Floats, radius: float) -> Floats:
    """(N, 3) m of the LiDAR, along the middles of all streets near a place."""
    parts = []
    for edge in world.near(xy - radius, xy + radius):
        there = streets([world.middle(edge).xy], world.height)
        points = there.points(np.arange(0.0, there.line[-1], SURVEY_EVERY_M), 0.0)
        parts.append(points[(np.abs(points[:, :2] - xy) < radius).all(axis=1)])
    places: Floats = np.concatenate([np.empty((0, 3)), *parts]) + np.array((0.0, 0.0, LIDAR_M))
    return places


def _walls(scene: Scene) -> NDArray[np.bool_]:
    """(Q + 1,) which plates are upright and high; the last is none."""
    up = scene.solids.plates[:, 6:9]
    return np.append((np.hypot(up[:, 0], up[:, 1]) < 1e-6) & (up[:, 2] >= HOUSE_M), False)
