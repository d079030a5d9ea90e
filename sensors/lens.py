"""Lenses: from a direction in a camera's axes to a pixel, and an image without its lens's distortion.

Camera axes: z ahead, x right, y down. Pixels are (column, row), a whole number being the middle of a pixel. Models and
the order of their coefficients are those of OpenCV and ROS:

| lens | ROS | coefficients |
|---|---|---|
| none | | |
| plumb_bob | plumb_bob | k1 k2 p1 p2 [k3] |
| rational | rational_polynomial | k1 k2 p1 p2 k3 k4 k5 k6 |
| fisheye | equidistant | k1 k2 k3 k4, of the angle from the axis |
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sensors._image_kernels import remap

Floats = NDArray[np.float64]
Lens = Literal["none", "plumb_bob", "rational", "fisheye"]

COEFFICIENTS: dict[str, tuple[int, ...]] = {"none": (0,), "plumb_bob": (4, 5), "rational": (8,), "fisheye": (4,)}
"""How many each lens may have."""
NEAREST_M = 0.1
"""Nothing closer ahead of a camera than this is seen."""
_WIDEST = np.tan(np.radians(np.linspace(0.0, 89.0, 891)))
"""Radii at which a lens is looked at, tangents of the angle from the axis."""


def pixels_of(p_camera: Floats, K: Floats, lens: Lens, coefficients: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """(N, 2) pixels of places (N, 3) m in camera axes, and (N,) whether the lens takes them there.

    It does not what lies behind the camera, closer than NEAREST_M, or so far aside that the model, which is a fit to
    the image alone, has turned back towards the middle; those pixels mean nothing.
    """
    depth = p_camera[:, 2]
    ahead = depth > NEAREST_M
    x, y = p_camera[:, :2].T / np.where(ahead, depth, 1.0)
    ahead &= np.hypot(x, y) < widest(lens, coefficients)
    x, y = np.where(ahead, (x, y), 0.0)
    x, y = distorted(x, y, lens, coefficients)
    return np.stack((K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]), axis=-1), ahead


def distorted(x: Floats, y: Floats, lens: Lens, coefficients: Floats) -> tuple[Floats, Floats]:
    """Where a lens takes directions (x, y, 1)."""
    if lens == "none":
        return x, y
    radius = np.hypot(x, y)
    scale = _radial(radius, lens, coefficients)
    if lens == "fisheye":
        return x * scale, y * scale
    p1, p2 = coefficients[2:4]
    across = 2.0 * p1 * x * y + p2 * (radius**2 + 2.0 * x**2)
    down = p1 * (radius**2 + 2.0 * y**2) + 2.0 * p2 * x * y
    return x * scale + across, y * scale + down


def widest(lens: Lens, coefficients: Floats) -> float:
    """The radius up to which a lens takes what lies further aside further aside, as the tangent of the angle."""
    if lens == "none":
        return np.inf
    image = _WIDEST * _radial(_WIDEST, lens, coefficients)
    back = np.flatnonzero(np.diff(image) <= 0.0)
    return float(_WIDEST[back[0]]) if len(back) else float(_WIDEST[-1])


def _radial(radius: Floats, lens: Lens, coefficients: Floats) -> Floats:
    """Radius in the image by the radius without a lens."""
    scale: Floats
    if lens == "fisheye":
        angle = np.arctan(radius)
        turned = angle * (1.0 + _powers(angle**2, coefficients))
        scale = np.divide(turned, radius, out=np.ones_like(radius), where=radius > 1e-9)
        return scale
    k = np.zeros(8)
    k[: len(coefficients)] = coefficients
    squared = radius**2
    scale = (1.0 + _powers(squared, k[[0, 1, 4]])) / (1.0 + _powers(squared, k[5:8]))
    return scale


def _powers(base: Floats, factors: Floats) -> Floats:
    """factors[0] base + factors[1] base^2 + ..."""
    total = np.zeros_like(base)
    for factor in factors[::-1]:
        total = (total + factor) * base
    return total


def rectified(rgb: NDArray[np.uint8], K: Floats, lens: Lens, coefficients: Floats) -> NDArray[np.uint8]:
    """(H, W, 3) image as a pinhole of the same K would have taken it; black where the lens saw nothing."""
    if lens == "none":
        return rgb
    height, width = rgb.shape[:2]
    column, row = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    y = (row - K[1, 2]) / K[1, 1]
    x = (column - K[0, 2] - K[0, 1] * y) / K[0, 0]
    rays = np.stack((x, y, np.ones_like(x)), axis=-1).reshape(-1, 3)
    source, taken = pixels_of(rays, K, lens, coefficients)
    source[~taken] = -2.0
    out = np.empty_like(rgb)
    remap(rgb, source.reshape(height, width, 2), out)
    return out
