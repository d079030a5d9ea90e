"""A training small enough for tests: 16 m around the vehicle, few features, few samples."""

from pathlib import Path

import pytest

from egovm.config import BevConfig, FusionConfig, LidarConfig, MatchingConfig, NetworkConfig
from egovm.dataset import Augmentation
from egovm.losses import LossConfig
from egovm.made_samples import Recipe
from egovm.train_config import TrainConfig
from sensors.simulate.lidar_config import LidarSimulation

NETWORK = NetworkConfig(
    name="tiny",
    bev=BevConfig(half_m=16.0, channels=(16, 8, 4), blocks=(0, 1, 0)),
    camera=None,
    lidar=LidarConfig(channels=(8, 8, 16), blocks=(1, 1, 1)),
    fusion=FusionConfig(layers=1, heads=2, cross_points=4, hidden=16),
    matching=MatchingConfig(layers=1, heads=2, hidden=16, most_elements=96),
)
RECIPE = Recipe(
    samples=4, worlds=2, reach_m=18.0, map_m=30.0, lidar=LidarSimulation(range_max_m=40.0, columns=720), surveyed=False
)
TRAINING = TrainConfig(
    network=NETWORK,
    steps=6,
    learning_rate=5e-3,
    warm_up=2,
    threads=1,
    workers=0,
    loss=LossConfig(samples=64),
    recipe=RECIPE,
    augmentation=Augmentation(turn_deg=5.0),
)


STILL = Augmentation(turn_deg=0.0, drop_surfels=0.0, drop_kinds=0.0)
"""Samples as they are."""


@pytest.fixture(scope="session")
def made_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where made samples are kept for all tests."""
    return tmp_path_factory.mktemp("samples")
