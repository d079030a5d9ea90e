"""The lattice of candidate poses: three levels, each half as wide as the one before, and the algebra of pose offsets.

An offset (x m, y m, yaw rad) acts on the body side: T = T_centre * dT, its translation d in body axes at the centre. A
place p of those axes is then seen from the candidate at p' = R(-yaw) (p - d). The lattice is regular in yaw and in
t = R(-yaw) d: rotate about the vehicle, then translate in the rotated frame, p' = R(-yaw) p - t. With the BEV cell as
its step, all translations of one yaw then share their bilinear weights. (Eq. 6-8 and Algorithm 1; the paper's own
lattice is regular in d.)
"""

import math

import msgspec
import torch
from torch import Tensor

from sensors.errors import EgolocError


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
