"""What a training is: the network, what it learns from, and how. A preset's name or a TOML file says all of it."""

from pathlib import Path
from typing import Annotated

import msgspec

from egovm.config import ABLATIONS, PRESETS, NetworkConfig
from egovm.config_file import read_toml
from egovm.dataset import Augmentation, InitialNoise
from egovm.losses import LossConfig
from egovm.made_samples import Recipe
from sensors.errors import EgolocError

Count = Annotated[int, msgspec.Meta(ge=1)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class TrainConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """AdamW with a warm-up, then cosine annealing to zero."""

    network: str | NetworkConfig = "small-lidar"
    """A preset's name, or a whole network's config."""
    ablation: str | None = None
    """A1 to A6 of the paper's Table 4, instead of the network's own switches."""
    steps: Count = 1500
    batch: Count = 2
    """Frames of a step."""
    learning_rate: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 2e-4
    """At its highest."""
    warm_up: Annotated[int, msgspec.Meta(ge=0)] = 50
    """Steps until then."""
    weight_decay: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.01
    backbone_rate: Share = 0.1
    """The image backbone learns so much slower."""
    clip: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0
    """Largest norm of a step's gradient."""
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    threads: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Of the processor; 0: as many as there are cores."""
    workers: Annotated[int, msgspec.Meta(ge=0, le=64)] = 1
    """Processes that make batches ahead; 0: none, steps wait for them."""
    checkpoint_s: Annotated[float, msgspec.Meta(gt=0.0)] = 30.0
    """Time between checkpoints, s: what a kill may lose."""
    noise: InitialNoise = InitialNoise()
    augmentation: Augmentation = Augmentation()
    loss: LossConfig = LossConfig()
    recipe: Recipe = Recipe()

    def __post_init__(self) -> None:
        if isinstance(self.network, str) and self.network not in PRESETS:
            raise EgolocError(f"training: network: expected one of {', '.join(PRESETS)}, got {self.network}")
        if self.ablation is not None and self.ablation not in ABLATIONS:
            raise EgolocError(f"training: ablation: expected one of {', '.join(ABLATIONS)}, got {self.ablation}")
        if self.built().lidar is None:
            raise EgolocError("training: network: expected one with a lidar: made-up worlds have no images yet")

    def built(self) -> NetworkConfig:
        """The network, with the ablation's switches."""
        network = PRESETS[self.network] if isinstance(self.network, str) else self.network
        if self.ablation is None:
            return network
        return msgspec.structs.replace(network, ablation=ABLATIONS[self.ablation])


SMALL_LIDAR = TrainConfig(
    steps=1000,
    learning_rate=1e-3,
    warm_up=30,
    loss=LossConfig(rmse=1.0, solver=1.0, random_pose=0.1, samples=256, target="spread"),
)
"""A LiDAR tells more than a step of the finest level: so the truth is spread, and its density counts little."""
TRAININGS = {"small-lidar": SMALL_LIDAR}


def read_training(given: str) -> TrainConfig:
    """A preset by its name, or what a TOML file says."""
    if given in TRAININGS:
        return TRAININGS[given]
    return read_toml(Path(given), TrainConfig, f"a training's config or one of {', '.join(TRAININGS)}")
