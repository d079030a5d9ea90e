"""What surrounds a simulated drive over a network: its LiDAR frames, and a map of the streets along it."""

from collections.abc import Iterator

import numpy as np

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.geodesy import map_from_llh
from sensors.maps.vector_map import VectorMap
from sensors.simulate.drive import DriveConfig, map_frame, plan
from sensors.simulate.environment import Environment
from sensors.simulate.lidar import frames
from sensors.simulate.network import build_network
from sensors.simulate.planning import PlannedDrive
from sensors.simulate.world import World

MAPPED_M = 150.0
"""A drive's map has the streets within so many metres of it."""


def drive_frames(duration_s: float | None, seed: int, config: DriveConfig) -> Iterator[Frame]:
    """LiDAR frames along the true trajectory of the drive that ``simulate`` makes of the same arguments.

    All drives of a network see the same world, that of the network's seed.
    Raises EgolocError, before the first frame is asked for, where the drive follows no network.
    """
    planned = _planned(duration_s, seed, config)
    return frames(drive_world(planned, config), planned.truth, planned.duration_s, config.lidar, seed)


def drive_map(duration_s: float | None, seed: int, config: DriveConfig) -> VectorMap:
    """Where things truly are along that drive, in the map frame of its log."""
    planned = _planned(duration_s, seed, config)
    world = drive_world(planned, config)
    truth = planned.truth
    t_ns = truth.start_ns + np.arange(0, int(planned.duration_s) + 1) * NS_PER_S
    # a second of driving is less than MAPPED_M
    way = map_from_llh(world.frame, truth.at(t_ns).llh)[:, :2]
    return world.vector_map(world.along(way, MAPPED_M))


def drive_world(planned: PlannedDrive, config: DriveConfig) -> World:
    """The world that a drive over a network lies in, in the map frame of its log."""
    assert config.network is not None
    start = config.start
    llh = np.radians(start.latitude_deg), np.radians(start.longitude_deg), start.height_m
    network = build_network(config.network, config.environments or {"city": Environment()}, config.network_seed)
    return World(network, llh, map_frame(planned.truth, config.map_frame), config.network_seed)


def _planned(duration_s: float | None, seed: int, config: DriveConfig) -> PlannedDrive:
    if config.network is None:
        raise EgolocError("network: expected a [network] of roads (other drives have no streets around them), got none")
    return plan(duration_s, seed, config)
