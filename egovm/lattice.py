"""The lattice of candidate poses: three levels, each half as wide as the one before, and the algebra of pose offsets.

An offset (x m, y m, yaw rad) acts on the body side: T = T_centre * dT, its translation d in body axes at the centre. A
place p of those axes is then seen from the candidate at p' = R(-yaw) (p - d). The lattice is regular in yaw and in
t = R(-yaw) d: rotate about the vehicle, then translate in the rotated frame, p' = R(-yaw) p - t. With the BEV cell as
its step, all translations of one yaw then share their bilinear weights. (Eq. 6-8 and Algorithm 1; the paper's own
lattice is regular in d.)
"""

import torch
from torch import Tensor

from egovm.config import LatticeConfig

PAPER = LatticeConfig()


def yaws(config: LatticeConfig, level: int, like: Tensor) -> Tensor:
    """(steps,) yaw of the candidates, rad, in the type and on the device of another tensor."""
    return _steps(config, like) * config.step_rad(level)


def candidates(config: LatticeConfig, level: int, like: Tensor) -> Tensor:
    """(steps, steps, steps, 3) pose offsets x m, y m, yaw rad; by yaw, by t_x, by t_y, all rising."""
    t = _steps(config, like) * config.step_m(level)
    yaw, tx, ty = torch.meshgrid(yaws(config, level, like), t, t, indexing="ij")
    return torch.cat((rotated(torch.stack((tx, ty), -1), yaw), yaw[..., None]), -1)


def rotated(places: Tensor, yaw: Tensor) -> Tensor:
    """R(yaw) p. places: (..., 2) m; yaw: (...) rad."""
    cosine, sine = torch.cos(yaw), torch.sin(yaw)
    x, y = places.unbind(-1)
    return torch.stack((cosine * x - sine * y, sine * x + cosine * y), -1)


def compose(first: Tensor, second: Tensor) -> Tensor:
    """T_first * T_second. Offsets (..., 3) x m, y m, yaw rad; yaws are added, not wrapped."""
    moved = first[..., :2] + rotated(second[..., :2], first[..., 2])
    return torch.cat((moved, first[..., 2:] + second[..., 2:]), -1)


def between(first: Tensor, second: Tensor) -> Tensor:
    """T_first^-1 * T_second: the second as an offset from the first. Offsets (..., 3)."""
    moved = rotated(second[..., :2] - first[..., :2], -first[..., 2])
    return torch.cat((moved, second[..., 2:] - first[..., 2:]), -1)


def seen_from(offset: Tensor, places: Tensor) -> Tensor:
    """R(-yaw) (p - d): places (..., 2) m of the axes at the centre, in those at an offset (..., 3) from it."""
    return rotated(places - offset[..., :2], -offset[..., 2])


def _steps(config: LatticeConfig, like: Tensor) -> Tensor:
    return torch.arange(-config.reach, config.reach + 1, dtype=like.dtype, device=like.device)
