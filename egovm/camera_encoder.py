"""Camera encoder: images into features at stride 16, by a backbone and a feature pyramid of two levels."""

from pathlib import Path

from torch import Tensor, nn

from egovm.config import CameraConfig
from egovm.timm_models import backbone

STRIDE = 16
"""Pixels along a side of a feature's cell."""


class CameraEncoder(nn.Module):
    """A shared backbone for all images, its stride-32 features added to those of stride 16 (FPN, Lin et al.)."""

    def __init__(self, config: CameraConfig, weights: Path | None = None) -> None:
        """weights: a local file with weights of the backbone; without it they are random."""
        super().__init__()
        self.backbone = backbone(config.backbone, weights)
        fine, coarse = self.backbone.feature_info.channels()  # type: ignore[operator, union-attr]
        self.fine = nn.Conv2d(fine, config.channels, 1)
        self.coarse = nn.Conv2d(coarse, config.channels, 1)
        self.smooth = nn.Conv2d(config.channels, config.channels, 3, padding=1)

    def forward(self, rgb: Tensor) -> Tensor:
        """(B, N, C, h / 16, w / 16) features of images (B, N, 3, h, w)."""
        fine, coarse = self.backbone(rgb.flatten(0, 1))
        fine = self.fine(fine)
        above = nn.functional.interpolate(self.coarse(coarse), size=fine.shape[-2:], mode="nearest")
        found: Tensor = self.smooth(fine + above)
        return found.reshape(*rgb.shape[:2], *found.shape[1:])
