"""The two strongest modes of a histogram over poses: how a matcher tells that a look-alike is possible, too."""

import torch
from torch import Tensor
from torch.nn import functional

APART = 3
"""Peaks closer than this along all axes are one mode, steps."""
DIP = 0.5
"""Between two modes the histogram falls below this share of the weaker peak."""
LEAST = 1e-3
"""Weaker peaks than this share of the strongest are none."""
_TRIED = 8
_BETWEEN = 9
_AROUND = 2
"""A mode's pose is the mean over so many steps around its peak."""


def two_modes(log_p: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Poses (B, 2, 3) of the modes and their masses (B, 2), the heavier first; what there is not has mass 0 and pose 0.

    log_p: (B, n, n, n); offsets: (n, n, n, 3) poses of the bins. A second mode is a local maximum apart from the
    strongest peak with a dip on the straight way between. Each bin's mass goes to the nearer peak.
    """
    p = log_p.detach().exp()
    n = p.shape[-1]
    steps = torch.stack(torch.meshgrid(*[torch.arange(n, device=p.device)] * 3, indexing="ij"), -1).flatten(0, 2)
    flat = p.flatten(1)
    first = flat.argmax(1, keepdim=True)
    second, found = _second(p, steps, first)
    peaks = torch.cat((first, second), 1)
    apart = (steps[None, None] - steps[peaks][:, :, None]).to(p.dtype)
    away = apart.square().sum(-1)
    away = torch.where(torch.stack((torch.ones_like(found), found), 1)[..., None], away, torch.inf)
    near = torch.stack((away[:, 0] <= away[:, 1], away[:, 1] < away[:, 0]), 1)
    mass = (flat[:, None] * near).sum(-1)
    core = flat[:, None] * (near & (apart.abs().amax(-1) <= _AROUND))
    poses = core @ offsets.flatten(0, 2).to(p.dtype) / core.sum(-1, keepdim=True).clamp(min=torch.finfo(p.dtype).tiny)
    order = mass.argsort(dim=1, descending=True)
    return poses.gather(1, order[..., None].expand(-1, -1, 3)), mass.gather(1, order)


def _second(p: Tensor, steps: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """Bin (B, 1) of the second peak, and whether there is one (B,). p: (B, n, n, n); first: (B, 1) bin."""
    flat = p.flatten(1)
    strongest = flat.gather(1, first)
    local = p >= functional.max_pool3d(p[:, None], 3, 1, 1)[:, 0]
    apart = (steps[None] - steps[first]).abs().amax(-1) >= APART
    heights = torch.where(local.flatten(1) & apart & (flat >= LEAST * strongest), flat, torch.zeros_like(flat))
    height, tried = heights.topk(_TRIED, dim=1)
    share = torch.linspace(0.0, 1.0, _BETWEEN, dtype=p.dtype, device=p.device)[:, None]
    start, end = steps[first][:, :, None].to(p.dtype), steps[tried][:, :, None].to(p.dtype)
    way = torch.round(start + share * (end - start)).to(torch.int64)
    n = p.shape[-1]
    bins = (way[..., 0] * n + way[..., 1]) * n + way[..., 2]
    lowest = flat.gather(1, bins.flatten(1)).view_as(bins).amin(-1)
    sound = (height > 0) & (lowest < DIP * height)
    chosen = torch.where(sound, height, torch.zeros_like(height)).argmax(1, keepdim=True)
    return tried.gather(1, chosen), sound.any(1)
