"""Closed outlines: of lines that should be closed, and of two sides."""

import numpy as np

from sensors.geodesy import Floats


def closed(xyz: Floats) -> Floats:
    """(n, 3) ring, its first vertex repeated at its end."""
    return xyz if (xyz[0, :2] == xyz[-1, :2]).all() else np.vstack((xyz, xyz[:1]))


def ring_of_sides(left: Floats, right: Floats) -> Floats:
    """The ring around two sides (n, 3), (m, 3): sides that run against each other are taken as they lie."""
    straight = np.linalg.norm(left[[0, -1], :2] - right[[0, -1], :2], axis=1).sum()
    crosswise = np.linalg.norm(left[[0, -1], :2] - right[[-1, 0], :2], axis=1).sum()
    return closed(np.vstack((left, right[::-1] if straight <= crosswise else right)))
