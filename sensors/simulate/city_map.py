"""A made-up city as a vector map: what stands along the streets of a random network, and surfels. Of a seed.

It is for sizes and speeds: vertices carry a survey's noise and surfels those of a scanner, so that it compresses no
better than a real map does. Its streets are furnished as those of a ``world`` are, which a LiDAR can look at.
"""

import numpy as np
from numpy.typing import NDArray

from sensors.geodesy import MapFrame
from sensors.maps.vector_map import NO_SURFELS, Surfels, VectorMap
from sensors.simulate.corners import Corners
from sensors.simulate.furnishing import elements, furnish
from sensors.simulate.noise import stream
from sensors.simulate.street_lines import Streets, rounded, streets
from sensors.simulate.streets import Blocks, lay_out

Floats = NDArray[np.float64]
Rng = np.random.Generator

BLOCKS = Blocks(least_m=80.0, most_m=350.0, missing=0.1, bent=0.3)
GROUND_PER_M, WALL_PER_M, CLUTTER_PER_M = 7.0, 1.6, 2.4
"""Surfels a metre of street: of its surface, of houses, of trees and cars."""


def city_map(length_km: float, seed: int, *, surfels: bool = True) -> VectorMap:
    """About so many kilometres of streets in one city, in a UTM frame; some 11,000 surfels a kilometre."""
    rng = stream(seed, "city map")
    made = _streets(length_km * 1000.0, rng)
    things = elements(furnish(made, rng), noise=rng)
    patches = _surfels(made, rng) if surfels else NO_SURFELS
    frame = MapFrame("utm", (455_000.0, 5_427_000.0, 0.0), 32)
    source = f"city map of seed {seed}"
    return VectorMap(frame, things, patches, (source,), float(made.line[-1]) / 1000.0)


def _streets(length_m: float, rng: Rng) -> Streets:
    graph = lay_out(BLOCKS, length_m, 0.0, 1, (30.0, 30.0), rng)
    parts = [slice(begin, end) for begin, end in zip(graph.first[:-1], graph.first[1:], strict=True)]
    corners = [Corners(graph.vertices[part], graph.radius[part], 0.0 * graph.radius[part]) for part in parts]
    return streets([rounded(corner)[0] for corner in corners], _ground)


def _ground(xy: Floats) -> Floats:
    """(N,) height: hills of 20 m."""
    x, y = xy.T
    height: Floats = 110.0 + 20.0 * np.sin(x / 700.0) * np.cos(y / 900.0) + 2.0 * np.sin(x / 90.0 + y / 130.0)
    return height


def _surfels(streets: Streets, rng: Rng) -> Surfels:
    """Surfels of the street (nearly level), of houses (upright, along the street) and of clutter (any way)."""
    length = streets.line[-1]
    ground, wall, clutter = (int(length * rate) for rate in (GROUND_PER_M, WALL_PER_M, CLUTTER_PER_M))
    s = rng.uniform(0.0, length, ground + wall + clutter)
    side = np.where(rng.random(len(s)) < 0.5, -1.0, 1.0)
    # a house every 20 m, each so far from the street
    house = rng.uniform(11.0, 17.0, int(length / 20.0) + 1)[(s / 20.0).astype(np.intp)]
    sort = np.repeat((0, 1, 2), (ground, wall, clutter))
    offset = side * np.choose(sort, (rng.uniform(0.0, 9.0, len(s)), house, rng.uniform(7.0, 18.0, len(s))))
    place = streets.points(s, offset)
    place[:, 2] += np.choose(sort, (np.zeros(len(s)), rng.uniform(0.5, 8.0, len(s)), rng.uniform(0.2, 5.0, len(s))))
    place += rng.normal(0.0, 0.02, place.shape)
    cos, sin = streets.course(s)
    level = np.stack((0.0 * sin, 0.0 * sin, 1.0 + 0.0 * sin), axis=-1)
    facing = np.stack((side * sin, -side * cos, 0.0 * sin), axis=-1)
    normal = np.choose(sort[:, None], (level, facing, rng.normal(size=(len(s), 3))))
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True) + rng.normal(0.0, 0.03, normal.shape)
    normal *= np.where(normal[:, 2:] < 0.0, -1.0, 1.0) / np.linalg.norm(normal, axis=1, keepdims=True)
    thin = 10.0 ** rng.uniform(-3.0, -1.0, len(s))
    return Surfels(place[:, :2], place[:, 2], normal, np.column_stack((thin, thin * rng.uniform(0.2, 1.0, len(s)))))
