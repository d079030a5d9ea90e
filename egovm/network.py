"""EgoVM as one network: sensors into BEV maps, pieces of map into embeddings, both into a pose (Algorithm 1)."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from egovm.batch import Batch
from egovm.bev_network import BevNetwork
from egovm.config import NetworkConfig
from egovm.map_elements import places_of
from egovm.matching import Matching
from egovm.pose_solver import PoseEstimate, PoseSolver
from egovm.regression_solver import RegressedPose, RegressionSolver
from egovm.semantics import SemanticHead


@dataclass(frozen=True, slots=True)
class Output:
    """Of B frames. bev: of each level (B, C, H, W), channels_last, in float32 or as ``deployed`` was told; embeddings:
    of each level (B, K, C); logits: of each level (B, TYPES - 1, H, W), empty where they are not asked for."""

    bev: tuple[Tensor, ...]
    embeddings: tuple[Tensor, ...]
    logits: tuple[Tensor, ...]
    estimate: PoseEstimate | RegressedPose


class EgoVM(nn.Module):
    """EgoVM(config)(batch, search) -> Output. All ablations of the config are the same class."""

    def __init__(self, config: NetworkConfig, backbone_weights: Path | None = None) -> None:
        """backbone_weights: a local file with weights of the image backbone; without it they are random."""
        super().__init__()
        self.config = config
        first = config.bev.channels[0]
        self.bev = BevNetwork(config, backbone_weights)
        self.matching = Matching(config)
        self.semantics = SemanticHead(config) if config.ablation.semantic_supervision else None
        histogram = config.ablation.solver == "histogram"
        given = config.solver
        self.solver = PoseSolver(given.lattice, given.alpha, given.groups) if histogram else None
        self.regression = None if histogram else RegressionSolver(first, 4 * first)

    def forward(self, batch: Batch, search: Tensor | None = None, *, semantics: bool | None = None) -> Output:
        """search: (B, 3) m, m, rad, half of what a prior leaves to be searched about the initial pose; the regression
        solver searches nothing. semantics: give logits; None: in training.
        """
        bev = tuple(_by_pixel(level) for level in self.bev(batch.points, batch.images))
        embeddings: tuple[Tensor, ...] = self.matching(batch.elements, bev[0])
        wanted = self.training if semantics is None else semantics
        logits: tuple[Tensor, ...] = ()
        if wanted and self.semantics is not None:
            logits = self.semantics(bev, self.matching.semantic())
        return Output(bev, embeddings, logits, self._estimate(batch, bev, embeddings, search))

    def _estimate(
        self, batch: Batch, bev: tuple[Tensor, ...], embeddings: tuple[Tensor, ...], search: Tensor | None
    ) -> PoseEstimate | RegressedPose:
        elements = batch.elements
        if self.solver is not None:
            places = places_of(elements, self.config.matching)
            found: PoseEstimate = self.solver(bev, embeddings, places, elements.valid, search)
            return found
        assert self.regression is not None
        regressed: RegressedPose = self.regression(embeddings[0], elements.valid)
        return regressed


def _by_pixel(level: Tensor) -> Tensor:
    """The features of a cell beside each other, as the solver's kernels read them."""
    return level.contiguous(memory_format=torch.channels_last)
