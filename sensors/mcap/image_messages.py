"""sensor_msgs/CompressedImage, Image and CameraInfo: an image and its camera as messages, and those of any driver.

Of raw images rgb8, bgr8 and mono8 are read, of compressed ones JPEG and PNG (also depth images as PNG are: 16 bits are
refused when they are decoded). A CameraInfo tells of the whole sensor: its binning and region of interest, and, for
images whose topic says that they are rectified, its projection instead of lens and K, are put into what comes out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.images import RAW, Image, ImageFormat, format_of, size_of
from sensors.lens import COEFFICIENTS, Lens
from sensors.mcap.cdr import MalformedMessageError, short_name
from sensors.mcap.message_bytes import MessageReader, MessageWriter

Floats = NDArray[np.float64]

COMPRESSED_IMAGE = "sensor_msgs/CompressedImage"
RAW_IMAGE = "sensor_msgs/Image"
CAMERA_INFO = "sensor_msgs/CameraInfo"
IMAGES = frozenset({COMPRESSED_IMAGE, RAW_IMAGE})

_LENSES: dict[str, Lens] = {
    "": "none",
    "none": "none",
    "plumb_bob": "plumb_bob",
    "rational_polynomial": "rational",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
_MODELS: dict[str, str] = {
    "none": "plumb_bob",  # other tools know no "none": five zeros bend nothing
    "plumb_bob": "plumb_bob",
    "rational": "rational_polynomial",
    "fisheye": "equidistant",
}
_MAX_COEFFICIENTS = 64


@dataclass(frozen=True, eq=False)
class ImageMessage:
    """One message: t_ns its stamp, frame of its axes, and the image's bytes."""

    t_ns: int
    frame: str
    data: bytes
    format: ImageFormat
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """What a CameraInfo says of the pixels that are recorded. R: (3, 3) from the camera's to the image's axes."""

    width: int
    height: int
    K: Floats
    lens: Lens
    distortion: Floats
    R: Floats


def stamp_of(data: memoryview) -> int:
    """Unix UTC, ns, of any message that begins with a header."""
    message = MessageReader(data)
    sec, nanosec = message.number("i"), message.number("I")
    if nanosec >= NS_PER_S:
        raise MalformedMessageError("header.stamp.nanosec is not below 1e9")
    return sec * NS_PER_S + nanosec


def frame_of(data: memoryview) -> str | None:
    """frame_id of any message that begins with a header; None where it is damaged."""
    try:
        message = MessageReader(data)
        message.number("i"), message.number("I")
        return message.text().lstrip("/")
    except MalformedMessageError:
        return None


def encode_image(image: Image, frame: str) -> tuple[str, bytes]:
    """Schema and message of an image."""
    out = _with_header(image.t_ns, frame)
    if image.format in RAW:
        out.number("I", image.height)
        out.number("I", image.width)
        out.text(image.format)
        out.number("B", 0)
        out.number("I", image.width * RAW[image.format])
        out.raw(image.data)
        return RAW_IMAGE, bytes(out.data)
    out.text(image.format)
    out.raw(image.data)
    return COMPRESSED_IMAGE, bytes(out.data)


def encode_info(image: Image, frame: str) -> bytes:
    """The CameraInfo of an image."""
    out = _with_header(image.t_ns, frame)
    out.number("I", image.height)
    out.number("I", image.width)
    out.text(_MODELS[image.lens])
    coefficients = np.zeros(5) if image.lens == "none" else image.distortion
    out.number("I", len(coefficients))
    out.doubles(*coefficients)
    out.doubles(*image.K.ravel())
    out.doubles(*np.eye(3).ravel())
    out.doubles(*np.hstack((image.K, np.zeros((3, 1)))).ravel())
    for _ in range(6):
        out.number("I", 0)
    out.number("B", 0)
    return bytes(out.data)


def _with_header(t_ns: int, frame: str) -> MessageWriter:
    out = MessageWriter()
    sec, nanosec = divmod(t_ns, NS_PER_S)
    out.number("i", sec)
    out.number("I", nanosec)
    out.text(frame)
    return out


def decode_image(schema: str, data: memoryview) -> ImageMessage:
    """An image's message. MalformedMessageError where it is not what it says, EgolocError where it is none of ours."""
    t_ns, message = stamp_of(data), MessageReader(data)
    message.number("i"), message.number("I")
    frame = message.text().lstrip("/")
    if short_name(schema) == RAW_IMAGE:
        return _raw(message, t_ns, frame)
    told = message.text()
    encoded = bytes(message.raw())
    found = format_of(encoded)
    if "compressedDepth" in told or found is None:
        raise EgolocError(f"expected images as JPEG or PNG, got format {told!r}")
    return ImageMessage(t_ns, frame, encoded, found, *size_of(encoded, "the message"))


def _raw(message: MessageReader, t_ns: int, frame: str) -> ImageMessage:
    height, width, encoding = message.number("I"), message.number("I"), message.text()
    message.number("B")
    step = message.number("I")
    body = message.raw()
    if encoding not in RAW:
        raise EgolocError(f"expected images as {', '.join(RAW)}, got encoding {encoding!r}")
    row = width * RAW[encoding]
    if step < row or height * step > len(body):
        raise MalformedMessageError("data is shorter than height, width and step say")
    pixels = np.ndarray((height, row), np.uint8, body, strides=(step, 1))
    return ImageMessage(t_ns, frame, pixels.tobytes(), encoding, width, height)  # type: ignore[arg-type]


def decode_info(data: memoryview, *, is_rectified: bool = False) -> Intrinsics:
    """What a CameraInfo says. is_rectified: of images that are rectified already.

    MalformedMessageError where it is shorter than it says, EgolocError where no image can be understood by it.
    """
    message = MessageReader(data)
    message.number("i"), message.number("I"), message.text()
    height, width, model = message.number("I"), message.number("I"), message.text()
    if (count := message.number("I")) > _MAX_COEFFICIENTS:
        raise MalformedMessageError(f"more than {_MAX_COEFFICIENTS} coefficients")
    d = np.array(message.doubles(count))
    K, R = (np.array(message.doubles(9)).reshape(3, 3) for _ in range(2))
    P = np.array(message.doubles(12)).reshape(3, 4)
    binning = np.array([max(message.number("I"), 1) for _ in range(2)])  # 0 is 1
    offset = np.array([message.number("I") for _ in range(2)])
    roi_height, roi_width = message.number("I"), message.number("I")
    lens, d = ("none", np.zeros(0)) if is_rectified else _lens(model, d)
    K, R = (P[:, :3], R) if is_rectified else (K, np.eye(3))
    if not K[0, 0] > 0.0:
        raise EgolocError("CameraInfo: the camera is not calibrated, fx is 0")
    size = np.array([roi_width or width, roi_height or height]) // binning
    return Intrinsics(int(size[0]), int(size[1]), _of_pixels(K, offset, binning), lens, d, R)


def _of_pixels(K: Floats, offset: NDArray[np.int64], binning: NDArray[np.int64]) -> Floats:
    """Intrinsics of the pixels that are left of the sensor's: cut out, then put together by binning."""
    kept = K.copy()
    kept[:2, 2] -= offset
    kept[:2] /= binning[:, None]
    kept[:2, 2] += 0.5 / binning - 0.5  # the middle of the first pixel
    return kept


def _lens(model: str, d: Floats) -> tuple[Lens, Floats]:
    """Lens and coefficients of a distortion model; without coefficients, or with zeros alone, there is none."""
    lens = _LENSES.get(model)
    if lens is None:
        raise EgolocError(f"CameraInfo: expected distortion_model {', '.join(filter(None, _LENSES))}, got {model!r}")
    if lens == "none" or not (lens == "fisheye" or d.any()):
        return "none", np.zeros(0)
    most = max(COEFFICIENTS[lens])
    if len(d) > most and not d[most:].any():  # the thin prism's, which are not used
        d = d[:most]
    return lens, d
