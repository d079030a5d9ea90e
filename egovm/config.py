"""What makes an EgoVM network: the sizes of its parts, its modes, and the switches of the paper's ablations.

``paper`` has the paper's sizes, ``small`` trains and runs on two CPU cores. A config goes with the weights, as TOML.
"""

from typing import Literal

import msgspec

from sensors.errors import EgolocError


class BevConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The BEV plane: a square around the vehicle, in body axes; its x and y cells are those of every level."""

    half_m: float = 40.0
    """Half of its side, m."""
    z_m: tuple[float, float] = (-3.0, 5.0)
    """Points between these heights in body axes are used, m."""
    plane_height_m: float | None = None
    """Height in body axes of the plane onto which map elements are projected (Eq. S1-S4), m; None: the ground under the
    vehicle, 0: the plane through the body's origin, as the paper's goes through the LiDAR."""
    cell_m: tuple[float, ...] = (0.5, 0.25, 0.125)
    """Cells of the levels, m, coarse to fine."""
    channels: tuple[int, ...] = (256, 128, 64)
    """Features of the levels."""

    def cells(self, level: int) -> int:
        """Cells along a side at a level."""
        return round(2.0 * self.half_m / self.cell_m[level])


class CameraConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Images into features at one level."""

    backbone: str = "ese_vovnet39b"
    """A timm model that gives features at stride 16 and 32."""
    image_hw: tuple[int, int] = (448, 640)
    """Height and width to which images are brought, pixels."""
    channels: int = 256


class LidarConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Points into BEV features."""

    cell_m: float = 0.25
    """Side of a pillar, m."""
    channels: int = 64
    """Features of a pillar."""
    blocks: tuple[int, ...] = (3, 5)
    """Convolutions of each stage; the first works on pillars, each next one on cells twice as wide."""


class FusionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """BEV queries looking at images."""

    layers: int = 4
    heads: int = 8
    self_points: int = 4
    """Places around itself that a query looks at, by head."""
    heights_m: tuple[float, ...] = (-1.5, 0.0, 1.5, 3.0)
    """Heights of the pillar's anchors that are projected into the images, m above the plane."""
    cross_points: int = 8
    """Places around each anchor's projection, by head."""
    hidden: int = 512


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


class SolverConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The histogram over poses."""

    half_m: float = 3.0
    """Half of the search range at the first level, m; each next level halves it."""
    half_deg: float = 3.0
    steps: int = 13
    """Candidates by axis. The step at each level is its BEV cell."""
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
        if len(self.bev.cell_m) != len(self.bev.channels):
            raise EgolocError(
                f"network: bev: expected as many channels as cells, got {self.bev.channels} for {self.bev.cell_m}"
            )


PAPER = NetworkConfig()
SMALL = NetworkConfig(
    name="small",
    bev=BevConfig(channels=(64, 32, 16)),
    camera=CameraConfig(backbone="mobilenetv3_small_100", image_hw=(224, 320), channels=64),
    lidar=LidarConfig(channels=32, blocks=(2, 3)),
    fusion=FusionConfig(layers=1, heads=4, cross_points=4, hidden=128),
    matching=MatchingConfig(layers=2, heads=4, hidden=128),
)
PRESETS = {config.name: config for config in (PAPER, SMALL)}
