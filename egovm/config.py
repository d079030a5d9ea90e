"""What makes an EgoVM network: the sizes of its parts, its modes, and the switches of the paper's ablations.

``paper`` has the paper's sizes, ``small`` trains and runs on two CPU cores. A config goes with the weights, as TOML.
"""

import math
from itertools import pairwise
from typing import Literal

import msgspec

from sensors.errors import EgolocError


class BevConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The BEV plane: a square around the vehicle, in body axes; its x and y cells are those of every level."""

    half_m: float = 40.0
    """Half of its side, m."""
    z_m: tuple[float, float] = (-3.0, 5.0)
    """Points between these heights in body axes are used, m."""
    ground_m: float = -0.5
    """Where the network sees the ground under the vehicle, m; frames of other bodies are lifted so."""
    plane_height_m: float | None = None
    """Height in body axes of the plane onto which map elements are projected (Eq. S1-S4), m; None: the ground under the
    vehicle, 0: the plane through the body's origin, as the paper's goes through the LiDAR."""
    cell_m: tuple[float, ...] = (0.5, 0.25, 0.125)
    """Cells of the levels, m, coarse to fine."""
    channels: tuple[int, ...] = (256, 128, 64)
    """Features of the levels."""
    blocks: tuple[int, ...] = (0, 1, 1)
    """3x3 convolutions of each level: of the first after fusion, of each next one after its upsampling."""

    def cells(self, level: int) -> int:
        """Cells along a side at a level."""
        return round(2.0 * self.half_m / self.cell_m[level])


class CameraConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Images into features at one level."""

    backbone: str = "ese_vovnet39b"
    """A timm model that gives features at stride 16 and 32."""
    image_hw: tuple[int, int] = (448, 640)
    """Height and width to which images are brought, pixels; multiples of 32."""
    channels: int = 256
    """Of the features; those of the first BEV level."""


class LidarConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Points into BEV features."""

    cell_m: float = 0.25
    """Side of a pillar, m: the BEV cell of the second level, whose upsampling takes the first stage's features."""
    channels: tuple[int, ...] = (64, 128, 256)
    """Features of the stages; a pillar has those of the first."""
    blocks: tuple[int, ...] = (3, 5, 5)
    """Convolutions of each stage; the first works on pillars, each next one on cells twice as wide."""


class FusionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """BEV queries looking at images."""

    cell_m: float = 0.5
    """Side of a query's cell, m: that of the first level or a multiple of it."""
    layers: int = 4
    heads: int = 8
    self_points: int = 4
    """Places around itself that a query looks at, by head."""
    heights_m: tuple[float, ...] = (-1.5, 0.0, 1.5, 3.0)
    """Heights of the pillar's anchors that are projected into the images, m in body axes."""
    cross_points: int = 8
    """Places in an image that a query looks at, by head, shared out among its anchors (as BEVFormer's)."""
    hidden: int = 512
    drop_cameras: float = 0.2
    """Part of the training steps that go without images, so that the same weights serve LiDAR alone."""
    drop_lidar: float = 0.2
    """Part of them that go without points, for cameras alone."""


class MatchingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Map elements looking at BEV features."""

    layers: int = 4
    heads: int = 8
    points: int = 4
    hidden: int = 512
    segment_m: float = 4.0
    """Polylines are cut into pieces of at most this length, m."""
    most_elements: int = 512
    """The nearest so many pieces, points and surfels are used."""
    surfel_share: float = 0.5
    """Of them, what surfels may take where segments and points could fill it, 0..1."""
    sampled: Literal["ends", "middle"] | int = "ends"
    """Where a segment is compared with the BEV: the mean over both its ends, its middle, or the mean over so many
    places, evenly from end to end."""

    def __post_init__(self) -> None:
        if not self.segment_m > 0.0:
            raise EgolocError(f"network: matching: segment_m: expected metres above 0, got {self.segment_m:g}")
        if self.most_elements < 1:
            raise EgolocError(f"network: matching: most_elements: expected 1 or more, got {self.most_elements}")
        if not 0.0 <= self.surfel_share <= 1.0:
            raise EgolocError(f"network: matching: surfel_share: expected 0 to 1, got {self.surfel_share:g}")
        if isinstance(self.sampled, int) and self.sampled < 2:
            raise EgolocError(f"network: matching: sampled: expected 2 places or more, got {self.sampled}")


class LatticeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which poses are candidates."""

    half_m: float = 3.0
    """Half of the search range at the first level, m; each next level halves it."""
    half_deg: float = 3.0
    """The same of the yaw, degrees."""
    steps: int = 13
    """Candidates by axis; odd, so that one stands in the middle."""
    levels: int = 3

    def __post_init__(self) -> None:
        if not 0.0 < self.half_m < math.inf:
            raise EgolocError(f"lattice: half_m: expected metres above 0, got {self.half_m:g}")
        if not 0.0 < self.half_deg <= 45.0:
            raise EgolocError(f"lattice: half_deg: expected degrees above 0 and at most 45, got {self.half_deg:g}")
        if self.steps < 3 or self.steps % 2 == 0:
            raise EgolocError(f"lattice: steps: expected an odd number of at least 3, got {self.steps}")
        if self.levels < 1:
            raise EgolocError(f"lattice: levels: expected 1 or more, got {self.levels}")

    @property
    def reach(self) -> int:
        """Steps from the middle to the edge."""
        return self.steps // 2

    def step_m(self, level: int) -> float:
        """Distance of neighbours at a level, which is the BEV cell there, m."""
        return self.half_m / 2.0**level / self.reach

    def step_rad(self, level: int) -> float:
        """The same of the yaw, rad."""
        return math.radians(self.half_deg) / 2.0**level / self.reach

    def check_cells(self, cell_m: tuple[float, ...]) -> None:
        """Raise where BEV maps with these cells do not fit: their cells are the steps of the levels."""
        steps = tuple(self.step_m(level) for level in range(self.levels))
        if len(cell_m) != self.levels or any(abs(a - b) > 1e-9 for a, b in zip(cell_m, steps, strict=True)):
            raise EgolocError(f"lattice: expected BEV cells of {steps} m, the steps of the levels, got {cell_m}")


class SolverConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The histogram over poses."""

    lattice: LatticeConfig = LatticeConfig()
    groups: int = 1
    """Dot products are taken by so many groups of channels."""
    alpha: float = 1.0
    """The score is the sum over K elements by K^alpha; the paper's mean is 1."""


class Ablation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Switches of the paper's Table 4."""

    surfels: bool = True
    """Off: A1."""
    decoder: bool = True
    """Off: map queries are compared as they are (A2)."""
    semantic_supervision: bool = True
    """Off: A3."""
    semantic_embedding: bool = True
    """Off: BEV-Locator's semantic encodings, a one-hot type through an MLP (A4)."""
    random_pose_loss: bool = True
    """Off: A5."""
    solver: Literal["histogram", "regression"] = "histogram"
    """regression: A6."""


class NetworkConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All of it."""

    name: str = "paper"
    bev: BevConfig = BevConfig()
    camera: CameraConfig | None = CameraConfig()
    """None: a network without cameras."""
    lidar: LidarConfig | None = LidarConfig()
    """None: a network without LiDAR."""
    fusion: FusionConfig = FusionConfig()
    matching: MatchingConfig = MatchingConfig()
    solver: SolverConfig = SolverConfig()
    ablation: Ablation = Ablation()

    def __post_init__(self) -> None:
        if self.camera is None and self.lidar is None:
            raise EgolocError("network: expected a camera, a lidar, or both")
        bev = self.bev
        if not len(bev.cell_m) == len(bev.channels) == len(bev.blocks):
            raise EgolocError(
                f"network: bev: expected as many channels and blocks as cells, got {bev.channels} and {bev.blocks} for"
                f" {bev.cell_m}"
            )
        if any(abs(2.0 * fine - coarse) > 1e-9 for coarse, fine in pairwise(bev.cell_m)):
            raise EgolocError(f"network: bev: cell_m: expected each half as wide as the one before, got {bev.cell_m}")
        self.solver.lattice.check_cells(bev.cell_m)
        self._check_camera()
        self._check_lidar()

    def _check_camera(self) -> None:
        if self.camera is None:
            return
        if any(side % 32 or side <= 0 for side in self.camera.image_hw):
            raise EgolocError(f"network: camera: image_hw: expected multiples of 32, got {self.camera.image_hw}")
        if self.camera.channels != self.bev.channels[0]:
            raise EgolocError(
                f"network: camera: channels: expected those of the first BEV level, {self.bev.channels[0]}, got"
                f" {self.camera.channels}"
            )
        times = self.fusion.cell_m / self.bev.cell_m[0]
        if times < 1.0 or times % 1.0 or self.bev.cells(0) % times:
            raise EgolocError(
                f"network: fusion: cell_m: expected a multiple of {self.bev.cell_m[0]:g} that divides the plane, got"
                f" {self.fusion.cell_m:g}"
            )
        dropped = self.fusion.drop_cameras, self.fusion.drop_lidar
        if min(dropped) < 0.0 or sum(dropped) > 1.0:
            raise EgolocError(
                f"network: fusion: drop_cameras, drop_lidar: expected 0 or more and together at most 1, got {dropped}"
            )

    def _check_lidar(self) -> None:
        if self.lidar is None:
            return
        lidar, half = self.lidar, self.bev.cell_m[0] / 2.0
        if len(lidar.channels) != len(lidar.blocks) or len(lidar.blocks) < 2 or min(lidar.blocks) < 1:
            raise EgolocError(
                "network: lidar: expected channels and blocks of two stages or more, a block or more each, got"
                f" {lidar.channels} and {lidar.blocks}"
            )
        if abs(lidar.cell_m - half) > 1e-9:
            raise EgolocError(
                f"network: lidar: cell_m: expected {half:g}, half a cell of the BEV, got {lidar.cell_m:g}"
            )
        coarsest = 2 ** (len(lidar.blocks) - 2)
        if self.bev.cells(0) % coarsest:
            raise EgolocError(
                f"network: lidar: blocks: expected {self.bev.cells(0)} cells of the BEV to be a multiple of {coarsest}"
            )


PAPER = NetworkConfig()
SMALL = NetworkConfig(
    name="small",
    bev=BevConfig(channels=(64, 32, 16), blocks=(0, 1, 0)),
    camera=CameraConfig(backbone="mobilenetv3_small_100", image_hw=(224, 320), channels=64),
    lidar=LidarConfig(channels=(16, 32, 64), blocks=(1, 2, 3)),
    fusion=FusionConfig(cell_m=1.0, layers=1, heads=4, cross_points=4, hidden=128),
    matching=MatchingConfig(layers=2, heads=4, hidden=128),
)
SMALL_LIDAR = msgspec.structs.replace(SMALL, name="small-lidar", camera=None)
PRESETS = {config.name: config for config in (PAPER, SMALL, SMALL_LIDAR)}
_A3 = Ablation(surfels=False, semantic_supervision=False)
ABLATIONS = {
    "A1": Ablation(surfels=False),
    "A2": Ablation(surfels=False, decoder=False),
    "A3": _A3,
    "A4": msgspec.structs.replace(_A3, semantic_embedding=False),
    "A5": Ablation(surfels=False, random_pose_loss=False),
    "A6": Ablation(surfels=False, solver="regression"),
}
"""Of the paper's Table 4, by name."""
