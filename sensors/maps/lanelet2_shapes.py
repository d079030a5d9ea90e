"""Faces of signs and lights, and poles, from the lines that Lanelet2 draws of them."""

import numpy as np

from sensors.geodesy import Floats


def face(xyz: Floats, height: float) -> Floats:
    """A face from its lower edge (n, 3) and height, m (NaN: not known): ring of its corners, or its centre alone.

    A line that is closed is the outline itself. The corners need heights of the edge: flat, they were no face.
    """
    if len(xyz) > 3 and (xyz[0] == xyz[-1]).all():
        return xyz
    up = np.array((0.0, 0.0, height))
    left, right = xyz[0], xyz[-1]
    if len(xyz) > 1 and height > 0 and np.isfinite((left[2], right[2])).all():
        return np.array((left, right, right + up, left + up, left))
    middle = xyz.mean(axis=0)
    return np.atleast_2d(middle + 0.5 * up if height > 0 else middle)


def pole(xyz: Floats, height: float) -> Floats:
    """A pole's foot and top from its line (n, 3) or its foot and height, m; its place alone where no more is known."""
    foot = xyz[0]
    if np.isfinite(xyz[:, 2]).all():
        foot, top = xyz[np.argmin(xyz[:, 2])], xyz[np.argmax(xyz[:, 2])]
        if top[2] > foot[2]:
            return np.array((foot, top))
        if height > 0:
            return np.array((foot, foot + np.array((0.0, 0.0, height))))
    return np.atleast_2d(foot)
