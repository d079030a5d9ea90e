"""Makes images and their cameras."""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from sensors.images import RAW, Image, ImageFormat
from tests.sensors.mcap.clouds import pose

AHEAD = np.array([[0.0, 0.0, 1.0, 1.5], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.2], [0.0, 0.0, 0.0, 1.0]])
"""T_body_camera of a camera that looks along the body's x, 1.5 m ahead and 1.2 m above its origin."""


def pixels(width: int = 64, height: int = 48, seed: int = 0) -> NDArray[np.uint8]:
    """(height, width, 3) some smooth picture."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 256, (6, 8, 3), np.uint8)
    return np.asarray(Pillow.fromarray(small).resize((width, height), Pillow.Resampling.BICUBIC))


def encoded(rgb: NDArray[np.uint8], kind: ImageFormat) -> bytes:
    if kind in RAW:
        return {"rgb8": rgb, "bgr8": rgb[..., ::-1], "mono8": rgb[..., 0]}[kind].tobytes()
    stream = io.BytesIO()
    options = {"quality": 95, "subsampling": 0} if kind == "jpeg" else {}
    Pillow.fromarray(rgb).save(stream, kind, **options)
    return stream.getvalue()


def image(t_ns: int, name: str = "front", kind: ImageFormat = "jpeg", seed: int = 0, **changed: Any) -> Image:
    """An image of 64 x 48 pixels."""
    given: dict[str, Any] = {
        "data": encoded(pixels(seed=seed), kind),
        "format": kind,
        "width": 64,
        "height": 48,
        "K": [[50.0, 0.0, 31.5], [0.0, 52.0, 23.5], [0.0, 0.0, 1.0]],
        "T_body_camera": pose(3),
        "t_ns": t_ns,
        "name": name,
    }
    return Image(**(given | changed))
