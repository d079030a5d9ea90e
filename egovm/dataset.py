"""Batches out of samples: an initial pose off the true one, the map as seen from there, and the truth to compare with.

The initial pose is T_init = T_true * offset^-1, so that the offset is what the network is to find (T_init^-1 T_true).
Augmentation is the paper's rotation of the LiDAR frame: body axes are turned, and with them points and true pose. Its
rotation of the world frame changes nothing here, for the network sees the map in body axes alone; the worlds' streets
run in all directions anyway.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from egovm.batch import SURFEL, TYPES, Batch, Points, Truth
from egovm.config import NetworkConfig
from egovm.made_samples import Recipe, Split, sample_of
from egovm.map_contents import MapContent, with_content
from egovm.map_elements import Pieces, padded, pieces_around
from egovm.sample import Sample
from egovm.semantic_rasters import semantic_rasters

Floats = NDArray[np.float64]
Rng = np.random.Generator
Limit = Annotated[float, msgspec.Meta(ge=0.0, le=45.0)]


class InitialNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How far initial poses are off: along, across (of the initial heading), and in yaw."""

    shape: Literal["uniform", "gauss"] = "uniform"
    lon_m: Limit = 2.5
    """Half the range, or sigma, m."""
    lat_m: Limit = 2.5
    """The same across."""
    yaw_deg: Limit = 2.5
    """The same of the yaw, deg."""
    limit_m: Limit = 3.0
    """Normal noise is drawn anew beyond that along or across, m."""
    limit_deg: Limit = 3.0
    """And in yaw, deg."""

    def draw(self, rng: Rng) -> Floats:
        """(3,) offset of the true pose in the initial one: x m, y m, yaw rad."""
        size = np.array((self.lon_m, self.lat_m, np.radians(self.yaw_deg)))
        if self.shape == "uniform":
            drawn: Floats = size * rng.uniform(-1.0, 1.0, 3)
            return drawn
        limit = np.array((self.limit_m, self.limit_m, np.radians(self.limit_deg)))
        while True:
            drawn = size * rng.standard_normal(3)
            if (np.abs(drawn) <= limit).all():
                return drawn


NOISES = {
    "uniform": InitialNoise(),
    "uniform-3": InitialNoise(lon_m=3.0, lat_m=3.0, yaw_deg=3.0),
    "gauss": InitialNoise("gauss", 1.5, 0.75, 0.85),
}
"""By name: the default, and the two that stand for what the paper does not tell."""


class Augmentation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What training changes in samples."""

    turn_deg: Annotated[float, msgspec.Meta(ge=0.0, le=180.0)] = 10.0
    """Body axes are turned by up to so much, deg."""
    drop_surfels: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.3
    """Part of the frames whose map has no surfels, as most maps."""
    drop_kinds: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.1
    """Part of the frames whose map lacks a kind of element, of each kind."""


@dataclass(frozen=True, slots=True)
class Seen:
    """A sample from one initial pose. T_map_init: (4, 4); offset: (3,) T_init^-1 T_true, x m, y m, yaw rad; semantic:
    of each level (TYPES - 1, H, W) bool, or none."""

    sample: Sample
    T_map_init: Floats
    offset: Floats
    pieces: Pieces
    semantic: tuple[NDArray[np.bool_], ...]


def turned(sample: Sample, angle: float) -> Sample:
    """The same with body axes turned to the left by an angle, rad: LiDAR frame rotation."""
    T = planar(np.array((0.0, 0.0, angle)))
    xyz = (sample.xyz @ T[:3, :3]).astype(np.float32)
    return Sample(
        xyz, sample.intensity, sample.offset_s, sample.T_map_body @ T, sample.ground_m, sample.elements, sample.surfels
    )


def seen_from_off(sample: Sample, offset: Floats, config: NetworkConfig, *, semantic: bool) -> Seen:
    """A sample from an initial pose in which the true one lies at an offset (3,)."""
    T_map_init = sample.T_map_body @ np.linalg.inv(planar(offset))
    pieces = pieces_around(sample.elements, sample.surfels, T_map_init, config, sample.ground_m)
    drawn = semantic_rasters(sample.elements, sample.T_map_body, config.bev, sample.ground_m) if semantic else ()
    return Seen(sample, T_map_init, offset, pieces, drawn)


def thinned(pieces: Pieces, given: Augmentation, rng: Rng) -> Pieces:
    """The same without surfels, and without each other kind, by chance; all of them where none would be left."""
    kept = rng.random(TYPES) >= np.where(np.arange(TYPES) == SURFEL, given.drop_surfels, given.drop_kinds)
    rows = kept[pieces.type]
    return pieces.chosen(rows) if rows.any() else pieces


def planar(offset: Floats) -> Floats:
    """(4, 4) of an offset (3,) x m, y m, yaw rad, about the body's z axis."""
    c, s = np.cos(offset[2]), np.sin(offset[2])
    T = np.eye(4)
    T[:2, :2] = ((c, -s), (s, c))
    T[:2, 3] = offset[:2]
    return T


def batched(several: Sequence[Seen], config: NetworkConfig) -> tuple[Batch, Truth]:
    """Side by side. Without a LiDAR in the config there are no points."""
    points = _points([seen.sample for seen in several]) if config.lidar is not None else None
    batch = Batch(points, None, padded([seen.pieces for seen in several]))
    levels = zip(*(seen.semantic for seen in several), strict=True)
    offset = torch.from_numpy(np.stack([seen.offset for seen in several]).astype(np.float32))
    return batch, Truth(offset, tuple(torch.from_numpy(np.stack(level)) for level in levels))


def _points(samples: Sequence[Sample]) -> Points:
    frame = np.repeat(np.arange(len(samples)), [len(sample.xyz) for sample in samples])

    def joined(name: str) -> Tensor:
        return torch.from_numpy(np.concatenate([getattr(sample, name) for sample in samples]))

    return Points(joined("xyz"), joined("intensity"), joined("offset_s"), torch.from_numpy(frame), len(samples))


@dataclass(frozen=True)
class TrainingBatches(Dataset[tuple[Batch, Truth]]):
    """What each step of a training learns from: of its seed and the step's number alone, so that it can go on from any.

    Every sample comes once an epoch, in an order of the epoch's own.
    """

    recipe: Recipe
    config: NetworkConfig
    noise: InitialNoise
    augmentation: Augmentation
    batch: int
    seed: int
    cache: Path | None = None

    def __getitem__(self, step: int) -> tuple[Batch, Truth]:
        semantic = self.config.ablation.semantic_supervision
        several = []
        for slot in range(self.batch):
            epoch, place = divmod(step * self.batch + slot, self.recipe.samples)
            order = np.random.default_rng([self.seed, *b"epoch", epoch]).permutation(self.recipe.samples)
            rng = np.random.default_rng([self.seed, *b"seen", step, slot])
            sample = sample_of(self.recipe, "train", int(order[place]), self.cache)
            most = np.radians(self.augmentation.turn_deg)
            sample = turned(sample, rng.uniform(-most, most))
            seen = seen_from_off(sample, self.noise.draw(rng), self.config, semantic=semantic)
            several.append(replace(seen, pieces=thinned(seen.pieces, self.augmentation, rng)))
        return batched(several, self.config)


@dataclass(frozen=True)
class EvaluationBatches(Dataset[tuple[Batch, Truth]]):
    """Samples of a split one by one, each from an initial pose of its own number; nothing is turned or drawn.

    content: what of the map is there.
    """

    recipe: Recipe
    config: NetworkConfig
    noise: InitialNoise
    count: int
    split: Split = "held-out"
    seed: int = 0
    cache: Path | None = None
    content: MapContent = "full"

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> tuple[Batch, Truth]:
        if not 0 <= number < self.count:
            raise IndexError(number)
        rng = np.random.default_rng([self.seed, *b"judged", number])
        offset = self.noise.draw(rng)
        sample = with_content(sample_of(self.recipe, self.split, number, self.cache), self.content, rng)
        return batched([seen_from_off(sample, offset, self.config, semantic=False)], self.config)


def loader(batches: Dataset[tuple[Batch, Truth]], numbers: Sequence[int], workers: int) -> Any:
    """Iterates over the batches of these numbers, made ahead in worker processes; workers 0: in this one."""
    several: dict[str, Any] = {"multiprocessing_context": "spawn", "prefetch_factor": 3} if workers else {}
    return torch.utils.data.DataLoader(batches, batch_size=None, sampler=numbers, num_workers=workers, **several)
