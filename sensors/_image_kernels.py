"""Kernel of images: colours between pixels. Arrays in and out."""

import math

import numpy as np
from numpy.typing import NDArray

from sensors.kernel import kernel


@kernel()
def remap(image: NDArray[np.uint8], source: NDArray[np.float64], out: NDArray[np.uint8]) -> None:
    """Write to out (h, w, C) the colours of image (H, W, C) at source (h, w, 2), column and row; black outside.

    Bilinear between the middles of pixels; the outer half of those at the edge has their colour.
    """
    height, width, channels = image.shape
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            u, v = source[i, j, 0], source[i, j, 1]
            if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
                for c in range(channels):
                    out[i, j, c] = 0
                continue
            u, v = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
            left, top = math.floor(u), math.floor(v)
            right, below = min(left + 1, width - 1), min(top + 1, height - 1)
            a, b = u - left, v - top
            for c in range(channels):
                above = (1.0 - a) * image[top, left, c] + a * image[top, right, c]
                under = (1.0 - a) * image[below, left, c] + a * image[below, right, c]
                out[i, j, c] = np.uint8((1.0 - b) * above + b * under + 0.5)
