"""sensor_msgs/PointCloud2: a sweep's points as one message, and the messages of any driver as points.

We write x y z [intensity] as float32, [ring] as uint16 (65535: not known) and t as int32, ns from the header's stamp;
a field in brackets is missing where no point has one.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.frames import Sweep
from sensors.mcap.cdr import MalformedMessageError
from sensors.mcap.message_bytes import MessageReader, MessageWriter
from sensors.mcap.point_time import TIME_FIELDS, offsets

POINT_CLOUD = "sensor_msgs/PointCloud2"

_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}
"""PointField.datatype -> numpy type."""
_CODES = {np.dtype(kind): code for code, kind in _TYPES.items()}
_NO_RING = 65535
_INTENSITY_FIELDS = ("intensity", "reflectivity")
_RING_FIELDS = ("ring", "channel", "line")
_MAX_FIELDS = 256


@dataclass(frozen=True, eq=False)
class Cloud2:
    """One message: t_ns its stamp, frame of its axes, points (N,) with the message's fields by name."""

    t_ns: int
    frame: str
    points: NDArray[np.void]

    def __len__(self) -> int:
        return len(self.points)


def encode(sweep: Sweep, t_ns: int, frame: str) -> bytes:
    """The message of a sweep."""
    points = _points(sweep)
    out = MessageWriter()
    sec, nanosec = divmod(t_ns, NS_PER_S)
    out.number("i", sec)
    out.number("I", nanosec)
    out.text(frame)
    out.number("I", 1)
    out.number("I", len(points))
    assert points.dtype.fields is not None
    out.number("I", len(points.dtype.fields))
    for name, (kind, offset, *_) in points.dtype.fields.items():
        out.text(name)
        out.number("I", offset)
        out.number("B", _CODES[kind])
        out.number("I", 1)
    out.number("B", 0)
    out.number("I", points.dtype.itemsize)
    out.number("I", points.nbytes)
    out.raw(points.tobytes())
    out.number("B", 1)
    return bytes(out.data)


def _points(sweep: Sweep) -> NDArray[np.void]:
    """(N,) packed points with the fields that the sweep has."""
    columns: dict[str, NDArray[Any]] = {axis: sweep.xyz[:, k] for k, axis in enumerate("xyz")}
    if not np.isnan(sweep.intensity).all():
        columns["intensity"] = sweep.intensity
    if (sweep.ring >= 0).any():
        columns["ring"] = np.where(sweep.ring < 0, _NO_RING, sweep.ring).astype("<u2")
    columns["t"] = sweep.offset_ns
    points = np.empty(len(sweep), [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    for name, column in columns.items():
        points[name] = column
    return points


def decode(data: memoryview) -> Cloud2:
    """A message's stamp, frame and points, as a view of its bytes.

    MalformedMessageError where it is not what it says of itself, EgolocError where no point can be made of its fields.
    """
    message = MessageReader(data)
    sec, nanosec = message.number("i"), message.number("I")
    frame = message.text().lstrip("/")
    height, width = message.number("I"), message.number("I")
    fields = _fields(message)
    if message.number("B"):
        raise EgolocError("is_bigendian: expected little-endian points")
    step, row_step = message.number("I"), message.number("I")
    row_step = row_step if height > 1 else max(row_step, width * step)  # of one row some drivers leave it 0
    body = message.raw()
    if nanosec >= NS_PER_S:
        raise MalformedMessageError("header.stamp.nanosec is not below 1e9")
    if width * step > row_step or height * row_step > len(body):
        raise MalformedMessageError("data is shorter than height, width and steps say")
    kinds = [kind for _, kind, _ in fields]
    if any(offset + np.dtype(kind).itemsize > step for _, kind, offset in fields):
        raise MalformedMessageError("a field passes the end of its point")
    names, places = [name for name, _, _ in fields], [offset for _, _, offset in fields]
    dtype = np.dtype({"names": names, "formats": kinds, "offsets": places, "itemsize": step})
    points = np.ndarray((height, width), dtype, body, strides=(row_step, step))
    return Cloud2(sec * NS_PER_S + nanosec, frame, points.reshape(-1))


def _fields(message: MessageReader) -> list[tuple[str, str, int]]:
    """Name, numpy type and offset of the fields with one number a point; of two with one name the first."""
    count = message.number("I")
    if count > _MAX_FIELDS:
        raise MalformedMessageError(f"more than {_MAX_FIELDS} fields")
    found: dict[str, tuple[str, int]] = {}
    for _ in range(count):
        name, offset, code, length = message.text(), message.number("I"), message.number("B"), message.number("I")
        if code in _TYPES and length in (0, 1):  # 0: some drivers leave it so
            found.setdefault(name, (_TYPES[code], offset))
    if missing := [axis for axis in "xyz" if axis not in found or np.dtype(found[axis][0]).kind != "f"]:
        got = ", ".join(found) or "no fields"
        raise EgolocError(f"field {missing[0]}: expected x, y, z as float32 or float64, got {got}")
    return [(name, kind, offset) for name, (kind, offset) in found.items()]


@dataclass(frozen=True, eq=False)
class Columns:
    """A cloud's usable points as columns of a Sweep; not_finite, at_origin: how many were left out."""

    columns: dict[str, NDArray[Any]]
    not_finite: int
    at_origin: int


def columns_of(cloud: Cloud2, *, zeros: bool) -> Columns:
    """Columns of the points that are points. zeros: points at the LiDAR's own place are kept.

    Drivers fill the places of beams that did not come back with NaN, or with zeros. EgolocError where times cannot be.
    """
    points = cloud.points
    xyz = np.stack([points[axis].astype(np.float32) for axis in "xyz"], axis=1)
    finite = np.isfinite(xyz).all(axis=1)
    keep = finite if zeros else finite & xyz.any(axis=1)
    if not keep.all():
        points, xyz = points[keep], xyz[keep]
    columns: dict[str, NDArray[Any]] = {"xyz": xyz}
    names = points.dtype.names or ()
    if (name := next((name for name in _INTENSITY_FIELDS if name in names), None)) is not None:
        columns["intensity"] = points[name].astype(np.float32)
    if (name := next((name for name in _RING_FIELDS if name in names), None)) is not None:
        ring = points[name].astype(np.int64)
        columns["ring"] = np.where((ring >= 0) & (ring < 1 << 15), ring, -1).astype(np.int16)
    if (name := next((name for name in TIME_FIELDS if name in names), None)) is not None:
        columns["offset_ns"] = offsets(name, points[name], cloud.t_ns)
    return Columns(columns, int((~finite).sum()), int((finite & ~keep).sum()))
