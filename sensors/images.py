"""One camera's image as it was recorded, with what it takes to know where a place appears in it."""

import io
import re
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.lens import COEFFICIENTS, Lens, pixels_of, rectified
from sensors.rotation import check_rigid

if TYPE_CHECKING:
    from PIL.Image import Image as Opened

Floats = NDArray[np.float64]
ImageFormat = Literal["jpeg", "png", "rgb8", "bgr8", "mono8"]

RAW = {"rgb8": 3, "bgr8": 3, "mono8": 1}
"""Formats whose data are the pixels themselves, row by row -> bytes of a pixel."""
LARGEST = 1 << 15
"""No image is wider or higher, pixels."""
_NAME = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_/-]*[A-Za-z0-9_-])?")
_EIGHT_BITS = frozenset({"1", "L", "P", "RGB", "RGBA", "CMYK", "YCbCr"})


class Seen(NamedTuple):
    """Where places appear. pixels: (N, 2) column and row; depth: (N,) m along the axis; inside: (N,) in the image."""

    pixels: Floats
    depth: Floats
    inside: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Image:
    """What a camera saw.

    data: as recorded; format: of data, jpeg, png, or raw pixels row by row; width, height: pixels; K: (3, 3)
    intrinsics of these pixels; T_body_camera: (4, 4), camera z ahead, x right, y down; t_ns: the middle of its
    exposure; name: of the camera; lens, distortion: what bends straight lines (``sensors.lens``), none where the image
    is rectified. Nothing is decoded before rgb() is called.
    """

    data: bytes
    format: ImageFormat
    width: int
    height: int
    K: Floats
    T_body_camera: Floats
    t_ns: int
    name: str
    lens: Lens = "none"
    distortion: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.format not in get_args(ImageFormat):
            raise EgolocError(f"Image.format: expected one of {', '.join(get_args(ImageFormat))}, got {self.format!r}")
        if not (0 < self.width < LARGEST and 0 < self.height < LARGEST):
            raise EgolocError(f"Image.width, height: expected 1 to {LARGEST - 1}, got {self.width} x {self.height}")
        if self.format in RAW and len(self.data) != (size := self.width * self.height * RAW[self.format]):
            raise EgolocError(f"Image.data: expected {size} bytes of {self.format}, got {len(self.data)}")
        if not _NAME.fullmatch(self.name):
            raise EgolocError(f"Image.name: expected letters, digits, _, - and / between them, got {self.name!r}")
        K, T = self._matrix("K", (3, 3)), self._matrix("T_body_camera", (4, 4))
        if not (K[0, 0] > 0.0 and K[1, 1] > 0.0 and K[1, 0] == 0.0 and (K[2] == (0.0, 0.0, 1.0)).all()):
            raise EgolocError(f"Image.K: expected fx, fy > 0 and a last row 0 0 1, got {K.tolist()}")
        check_rigid("Image.T_body_camera", T)
        counts = COEFFICIENTS.get(self.lens)
        if counts is None:
            raise EgolocError(f"Image.lens: expected one of {', '.join(COEFFICIENTS)}, got {self.lens!r}")
        if len(np.atleast_1d(self.distortion)) not in counts:
            told = " or ".join(map(str, counts))
            raise EgolocError(
                f"Image.distortion: expected {told} numbers for {self.lens}, got {np.size(self.distortion)}"
            )
        self._matrix("distortion", (np.size(self.distortion),))

    def _matrix(self, name: str, shape: tuple[int, ...]) -> Floats:
        array = np.array(getattr(self, name), np.float64)
        if array.shape != shape:
            raise EgolocError(f"Image.{name}: expected shape {shape}, got {array.shape}")
        if not np.isfinite(array).all():
            raise EgolocError(f"Image.{name}: expected finite numbers, got NaN or Inf")
        array.flags.writeable = False
        object.__setattr__(self, name, array)
        return array

    @cached_property
    def T_camera_body(self) -> Floats:  # noqa: N802
        """(4, 4)."""
        R, p = self.T_body_camera[:3, :3].T, self.T_body_camera[:3, 3]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, -R @ p
        return T

    def rgb(self) -> NDArray[np.uint8]:
        """(height, width, 3) decoded; EgolocError where data are no such image."""
        if self.format in RAW:
            pixels = np.frombuffer(self.data, np.uint8).reshape(self.height, self.width, RAW[self.format])
            ordered = {"rgb8": pixels, "bgr8": pixels[..., ::-1], "mono8": np.repeat(pixels, 3, axis=2)}[self.format]
            return np.ascontiguousarray(ordered)
        with self._checked() as opened:
            return np.asarray(self._colours(opened))

    def small(self, width: int, height: int) -> NDArray[np.uint8]:
        """(height, width, 3) rectified and brought to a size, every pixel the mean of those that it stands for.

        A JPEG much larger than that is decoded to a half, a quarter or an eighth of its size, which saves most of the
        time: its blocks of 8 x 8 pixels are kept as frequencies. Such a size is rounded up, hence the box.
        """
        from PIL import Image as Pillow

        if self.format != "jpeg" or self.lens != "none":
            whole = Pillow.fromarray(self.rectified())
            return np.asarray(whole.resize((width, height), Pillow.Resampling.BILINEAR))
        with self._checked() as opened:
            opened.draft("RGB", (width, height))
            part = round(self.width / opened.width) if opened.width < self.width else 1
            box = (0.0, 0.0, self.width / part, self.height / part)
            return np.asarray(self._colours(opened).resize((width, height), Pillow.Resampling.BILINEAR, box))

    def _checked(self) -> "Opened":
        """The image, of which only the head has been read; EgolocError where it is another than was said."""
        opened = _opened(self.data, self.name)
        if opened.size != (self.width, self.height):
            got = f"{opened.width} x {opened.height}"
            raise EgolocError(f"image of {self.name}: expected {self.width} x {self.height} pixels, got {got}")
        if opened.mode not in _EIGHT_BITS:
            raise EgolocError(f"image of {self.name}: expected 8 bits a colour, got mode {opened.mode}")
        return opened

    def _colours(self, opened: "Opened") -> "Opened":
        """Decoded."""
        try:
            return opened.convert("RGB")
        except (OSError, SyntaxError, ValueError) as error:
            raise EgolocError(f"image of {self.name}: cannot be decoded: {error}") from None

    def rectified(self) -> NDArray[np.uint8]:
        """(height, width, 3) decoded, as a pinhole of the same K would have taken it."""
        return rectified(self.rgb(), self.K, self.lens, self.distortion)

    def seen(self, p_body: Floats) -> Seen:
        """Where places (N, 3) m in body axes at t_ns appear in the image as it is recorded."""
        T = self.T_camera_body
        p_camera = p_body @ T[:3, :3].T + T[:3, 3]
        pixels, taken = pixels_of(p_camera, self.K, self.lens, self.distortion)
        column, row = pixels.T
        within = (column > -0.5) & (column < self.width - 0.5) & (row > -0.5) & (row < self.height - 0.5)
        return Seen(pixels, p_camera[:, 2], taken & within)


def size_of(data: bytes, name: str) -> tuple[int, int]:
    """Width and height of an encoded image, from its first bytes; EgolocError where it is none."""
    with _opened(data, name) as opened:
        return opened.size


def format_of(data: bytes) -> ImageFormat | None:
    """jpeg or png by the first bytes; None: neither."""
    if data[:3] == b"\xff\xd8\xff":
        return "jpeg"
    return "png" if data[:8] == b"\x89PNG\r\n\x1a\n" else None


def _opened(data: bytes, name: str) -> "Opened":
    """The image, of which only the head has been read."""
    from PIL import Image as Pillow
    from PIL import UnidentifiedImageError

    try:
        return Pillow.open(io.BytesIO(data), formats=("JPEG", "PNG"))
    except (OSError, SyntaxError, ValueError, Pillow.DecompressionBombError) as error:
        told = "expected a JPEG or PNG" if isinstance(error, UnidentifiedImageError) else str(error)
        raise EgolocError(f"image of {name}: {told}") from None
