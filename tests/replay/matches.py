"""Matches of tiny networks with random weights: what is drawn of them is checked, not what they find."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
import torch

from egovm.config import NetworkConfig
from egovm.dataset import planar
from egovm.infer import Matcher
from egovm.network import EgoVM
from egovm.weights import save_weights
from replay.match_drawing import Pictured
from sensors.frames import Frame, Sweep
from sensors.images import Image
from sensors.maps.vector_map import Elements, Kind, Surfels
from tests.egovm.made_map import made
from tests.egovm.scenes import TINY
from tests.sensors.mcap.messages import START_NS
from tests.sensors.pictures import AHEAD, image

ORIGIN = np.array((691_000.0, 5_334_000.0, 0.0))
POLE_M = 3.0
LIDAR = msgspec.structs.replace(TINY, name="tiny-lidar", camera=None)
CAMERA = msgspec.structs.replace(TINY, name="tiny-camera", lidar=None)
PLACE = ORIGIN[:2]
ELEMENTS = made(
    (Kind.LANE_LINE, np.add(PLACE, [[-4.0, 1.5], [0.0, 1.5], [4.0, 1.6]])),
    (Kind.STOP_LINE, np.add(PLACE, [[3.0, -1.5], [3.0, 1.5]])),
    (Kind.POLE, np.add(ORIGIN, [[3.9, 1.0, 0.0], [3.9, 1.0, POLE_M]])),
    (Kind.SIGN, np.add(ORIGIN, [[3.0, 2.5, 2.0]])),
)
WALL = Surfels(
    np.add(PLACE, [[-2.0, 3.5], [1.0, 3.5]]), np.ones(2), np.tile((0.0, -1.0, 0.0), (2, 1)), np.full((2, 2), 0.01)
)
NO_WALL = Surfels(np.empty((0, 2)), np.empty(0), np.empty((0, 3)), np.empty((0, 2)))
GROUND_M = -0.4


class Around:
    """A map of which everything is near."""

    def __init__(self, elements: Elements = ELEMENTS, surfels: Surfels = WALL) -> None:
        self.answer = elements, surfels

    def around(self, x: float, y: float, radius: float) -> tuple[Elements, Surfels]:
        return self.answer


@cache
def matcher(config: NetworkConfig) -> Matcher:
    """Its weights are the same in every run; tau makes of what they see peaks, as training does."""
    torch.manual_seed(3)
    network = EgoVM(config)
    assert network.solver is not None
    torch.nn.init.constant_(network.solver.tau, 6.0)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "w.safetensors"
        save_weights(network, config, path)
        return Matcher(path)


def frame(t_ns: int = START_NS, *, points: int = 400, images: tuple[Image, ...] = (), seed: int = 0) -> Frame:
    random = np.random.default_rng(seed)
    xyz = random.uniform((-8.0, -8.0, -0.6), (8.0, 8.0, 2.0), (points, 3)).astype(np.float32)
    sweep = Sweep(xyz, intensity=random.uniform(0.0, 255.0, points).astype(np.float32))
    return Frame(t_ns, t_ns, (sweep,) if points else (), images)


def pictured(
    config: NetworkConfig = LIDAR,
    seen: Frame | None = None,
    around: Around | None = None,
    *,
    known: bool = True,
    semantics: bool = True,
) -> Pictured:
    """A match from 0.6 m, 0.4 m and 2 deg aside."""
    truth = np.array((*ORIGIN[:2], 0.3))
    T_map_init = planar(truth) @ planar(np.array((0.6, -0.4, 0.035)))
    seen = seen or frame()
    vector_map: Any = around or Around()
    found = matcher(config)(seen, vector_map, T_map_init, ground_m=GROUND_M, semantics=semantics)
    return Pictured(found, config.bev, truth if known else None, seen)


def camera(t_ns: int = START_NS) -> Image:
    return image(t_ns, "ahead", T_body_camera=AHEAD)
