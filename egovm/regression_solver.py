"""The regression solver of ablation A6: map embeddings to a pose offset, without a histogram and without covariance.

The paper's supplement (which calls it A5) gives layers and widths: an encoder of three Conv1D(256, 256, 1), the first
two with BatchNorm and ReLU, a maximum over the elements, an MLP of Conv1D 256-1024-1024-3. Its input are the map
embeddings of the cross-modality matching alone, as the supplement's draft says: they have looked at the BEV features
through cross attention, and their queries hold where the elements are.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True, slots=True)
class RegressedPose:
    """offset: (B, 3) T_init^-1 T_est, x m, y m, yaw rad, 0 without landmarks; found: (B,) bool, there were any."""

    offset: Tensor
    found: Tensor


class RegressionSolver(nn.Module):
    """Embeddings of map elements to a pose offset."""

    def __init__(self, channels: int = 256, hidden: int = 1024) -> None:
        super().__init__()
        self.encoder = nn.ModuleList(nn.Conv1d(channels, channels, 1) for _ in range(3))
        self.norms = nn.ModuleList(nn.BatchNorm1d(channels) for _ in range(2))
        self.head = nn.Sequential(
            nn.Conv1d(channels, hidden, 1), nn.ReLU(), nn.Conv1d(hidden, hidden, 1), nn.ReLU(), nn.Conv1d(hidden, 3, 1)
        )

    def forward(self, embeddings: Tensor, valid: Tensor) -> RegressedPose:
        """embeddings: (B, K, C); valid: (B, K) bool. The last layer's yaw is in degrees, of the size of its metres."""
        found = valid.any(1)
        if embeddings.shape[1] == 0:
            return RegressedPose(embeddings.new_zeros((len(embeddings), 3)), found)
        shown = valid[:, None]
        x = torch.where(shown, embeddings.transpose(1, 2), torch.zeros((), dtype=embeddings.dtype))
        for convolution, norm in zip(self.encoder, [*self.norms, None], strict=True):
            x = convolution(x)
            if isinstance(norm, nn.BatchNorm1d):
                x = functional.relu(_normalized(norm, x, valid))
        strongest = torch.where(shown, x, torch.full_like(x, -torch.inf)).amax(2, keepdim=True)
        strongest = torch.where(found[:, None, None], strongest, torch.zeros_like(strongest))
        units = embeddings.new_tensor((1.0, 1.0, math.pi / 180.0))
        offset = self.head(strongest)[..., 0] * units
        return RegressedPose(torch.where(found[:, None], offset, torch.zeros_like(offset)), found)


def _normalized(norm: nn.BatchNorm1d, x: Tensor, valid: Tensor) -> Tensor:
    """BatchNorm of (B, C, K), in training over valid elements alone: padding must not be in its statistics.

    One element has no spread, so that it is normalized as in evaluation.
    """
    if not norm.training or int(valid.sum()) < 2:
        return functional.batch_norm(
            x, norm.running_mean, norm.running_var, norm.weight, norm.bias, False, 0.0, norm.eps
        )
    elements = x.transpose(1, 2)
    return elements.masked_scatter(valid[..., None], norm(elements[valid])).transpose(1, 2)
