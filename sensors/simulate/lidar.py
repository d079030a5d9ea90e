"""A simulated LiDAR: the rings of a Hesai Pandar40P, turned through a world from a moving vehicle.

Every column of rays starts from the vehicle's pose at its own time (its forty lasers, which a real one fires within
50 us, together). Points are in the LiDAR's axes at their own time, as a real one gives them.
"""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.frames import Frame, Sweep
from sensors.geodesy import MapFrame, map_from_llh
from sensors.rotation import matrix_from_q
from sensors.simulate.lidar_config import LidarSimulation
from sensors.simulate.reference import attitude_in_map
from sensors.simulate.scene import Hits, Scene
from sensors.simulate.trajectory import Truth
from sensors.simulate.world import World

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Rng = np.random.Generator

ELEVATION_DEG = np.array(
    [15.0, 11.0, 8.0, 5.0, 3.0, 2.0]
    + [round((5 - k) / 3.0, 2) for k in range(24)]
    + [-7.0, -8.0, -9.0, -10.0, -11.0, -12.0, -13.0, -14.0, -19.0, -25.0]
)
"""(40,) design elevation of each laser from the top one down, deg (Pandar40P user manual, channel distribution)."""
AZIMUTH_DEG = np.array([-1.042] * 6 + [3.125, -5.208, -1.042] * 8 + [-1.042] * 10)
"""(40,) design azimuth of each laser against the rotor, deg, clockwise (the same table)."""
START = np.pi
"""Direction, rad to the left, in which a turn begins: backwards, so that what lies ahead is seen at one moment."""
HEARD = 0.1
"""Reflectivity that is just heard at the farthest range, -."""
FULL = 255.0
"""Greatest intensity; 100 is that of a white surface met head on (reflectivity in percent)."""
MOVED_M = 60.0
"""A scene is made anew after so much way, m."""
SCENE_REACH_M = MOVED_M + 40.0
"""It reaches so far beyond the range: what is passed until then, and a turn at 140 km/h of the slowest LiDAR, m."""


@lru_cache(maxsize=4)
def beams(columns: int) -> Floats:
    """(columns, 40, 3) unit vectors of a turn, clockwise, LiDAR axes: x ahead, y to the left."""
    turned = START - 2.0 * np.pi * np.arange(columns) / columns
    azimuth = turned[:, None] - np.radians(AZIMUTH_DEG)
    elevation = np.broadcast_to(np.radians(ELEVATION_DEG), azimuth.shape)
    level = np.cos(elevation)
    directions = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=-1)
    directions.flags.writeable = False
    return directions


def column_times(config: LidarSimulation) -> Nanoseconds:
    """(columns,) ns from the begin of a turn."""
    step_ns = NS_PER_S / config.rate_hz / config.columns
    times: Nanoseconds = np.rint(np.arange(config.columns) * step_ns).astype(np.int64)
    return times


def sweep(scene: Scene, p_map: Floats, R_map_body: Floats, config: LidarSimulation, rng: Rng) -> Sweep:
    """One turn. p_map: (columns, 3) m and R_map_body: (columns, 3, 3), the body's pose at the time of each column."""
    T = np.eye(4)
    T[:3, 3] = config.place
    origins = p_map + R_map_body @ T[:3, 3]
    rays = beams(config.columns)
    return _measured(scene.cast(origins, R_map_body, rays, config.range_max_m), rays, T, config, rng)


def _measured(hits: Hits, rays: Floats, T_body_lidar: Floats, config: LidarSimulation, rng: Rng) -> Sweep:
    """The returns of hits (M, K) that are heard, with noise. Whatever is heard, the same random numbers are drawn."""
    shape = hits.distance.shape
    noise = rng.standard_normal((3, *shape), dtype=np.float32)
    dropped = rng.random(shape, dtype=np.float32) < config.dropped_fraction
    # power of a diffuse surface over that of the faintest one that is heard
    facing = hits.reflectivity * hits.cosine
    power = facing * (config.range_max_m / hits.distance) ** 2 / HEARD * np.exp(config.echo_sigma * noise[0])
    heard = (power >= 1.0) & ~dropped & (hits.distance >= config.range_min_m) & np.isfinite(hits.distance)
    column, ring = np.nonzero(heard)
    distance = hits.distance[heard] + config.range_sigma_m * noise[1][heard]
    # the sensor makes up for distance, not for incidence
    intensity = 100.0 * np.sqrt(hits.reflectivity * facing)[heard] * (1.0 + config.intensity_sigma * noise[2][heard])
    return Sweep(
        xyz=(rays[heard] * distance[:, None]).astype(np.float32),
        T_body_lidar=T_body_lidar,
        offset_ns=column_times(config)[column].astype(np.int32),
        intensity=np.clip(np.rint(intensity), 0.0, FULL).astype(np.float32),
        ring=ring.astype(np.int16),
    )


def poses(truth: Truth, frame: MapFrame, t_ns: Nanoseconds) -> tuple[Floats, Floats]:
    """p_map (N, 3) m and R_map_body (N, 3, 3) of the vehicle at t_ns (N,)."""
    motion = truth.at(t_ns)
    return map_from_llh(frame, motion.llh), matrix_from_q(attitude_in_map(motion, frame))


def frames(world: World, truth: Truth, duration_s: float, config: LidarSimulation, seed: int) -> Iterator[Frame]:
    """The whole turns within a drive, one after the other; each of the noise of its own number."""
    turn_s = 1.0 / config.rate_hz
    offsets = column_times(config)
    scene, made_at = None, np.full(2, np.inf)
    for number in range(int(duration_s * config.rate_hz + 1e-6)):
        t_ns = truth.start_ns + round(number * turn_s * NS_PER_S)
        p_map, R_map_body = poses(truth, world.frame, t_ns + offsets)
        here = p_map[len(p_map) // 2, :2]
        if scene is None or not np.hypot(*(here - made_at)) < MOVED_M:
            scene, made_at = world.scene(here, config.range_max_m + SCENE_REACH_M), here
        rng = np.random.default_rng([seed, *b"lidar", number])
        arrival_ns = t_ns + round((turn_s + config.delay_s) * NS_PER_S)
        yield Frame(t_ns, arrival_ns, (sweep(scene, p_map, R_map_body, config, rng),))
