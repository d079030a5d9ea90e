"""The record of a point cloud, and what holds for clouds of every format."""

import mmap
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.records import LeftOut

Floats = NDArray[np.float64]

FURTHEST_M = 2e7
"""No coordinate on earth is larger, m."""
_BYTES = 2 * 3 * 8
"""Memory that a point takes while it is read: the file's numbers and ours."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points of one file.

    xyz: (N, 3) m in map axes; frame: where those lie on the earth, None where the file does not say; viewpoint: (3,) m
    from where the points were seen, in the same axes, None where the file does not say; left_out: points not used.
    """

    xyz: Floats
    frame: MapFrame | None = None
    viewpoint: Floats | None = None
    left_out: tuple[LeftOut, ...] = ()

    def __len__(self) -> int:
        return len(self.xyz)


def usable(path: Path, xyz: Floats) -> tuple[Floats, tuple[LeftOut, ...]]:
    """The points (N, 3) that are finite, and how many are not; EgolocError for coordinates beyond the earth."""
    finite = np.isfinite(xyz).all(axis=1)
    left_out: tuple[LeftOut, ...] = ()
    if not finite.all():
        left_out = (LeftOut(path.name, "points that are not finite", int((~finite).sum())),)
        xyz = xyz[finite]
    if len(xyz) and not (furthest := float(np.abs(xyz).max())) <= FURTHEST_M:
        raise EgolocError(f"{path}: x, y, z: expected metres, at most {FURTHEST_M:g}, got {furthest:g}")
    return xyz, left_out


def mapped(path: Path) -> mmap.mmap:
    """A file's bytes, which come into memory as they are read; EgolocError where it cannot be read or is empty."""
    try:
        with path.open("rb") as stream:
            if not os.fstat(stream.fileno()).st_size:
                raise EgolocError(f"{path}: the file is empty")
            return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise EgolocError(f"{path}: cannot be read: {error.strerror or error}") from None


def check_room(path: Path, field: str, points: int, bytes_each: int = _BYTES) -> None:
    """EgolocError where so many points do not fit into the machine's memory."""
    needed, there = points * bytes_each, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > there:
        raise EgolocError(
            f"{path}: {field}: {points} points take {needed / 1e9:.1f} GB of memory, this machine has "
            f"{there / 1e9:.1f} GB: cut the file into tiles"
        )
