"""Writes point clouds of every format, so that what is read is known."""

import struct
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from pyproj import CRS

from sensors.clouds import read_cloud
from sensors.errors import EgolocError

XYZ = np.array([[1.5, -2.25, 3.0], [400.125, 0.0, -7.5], [0.0, 0.0, 0.0]])
CLOUDS = hnp.arrays(np.float64, st.tuples(st.integers(0, 30), st.just(3)), elements=st.floats(-1e6, 1e6, width=32))
quick = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
PLY_TYPES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
    "f8": "double",
}  # fmt: skip


def lzf_literals(data: bytes) -> bytes:
    """LZF data without any compression."""
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def lzf(data: bytes) -> bytes:
    """LZF data with the longest back references of a naive search."""
    out, literal, at = bytearray(), bytearray(), 0

    def flush() -> None:
        out.extend(lzf_literals(bytes(literal)))
        literal.clear()

    while at < len(data):
        length = start = 0
        for source in range(max(0, at - 8191), at):
            n = 0
            while n < 264 and at + n < len(data) and data[source + n] == data[at + n]:
                n += 1
            if n > length:
                length, start = n, source
        if length < 3:
            literal.append(data[at])
            at += 1
            continue
        flush()
        distance = at - start - 1
        if length - 2 < 7:
            out += bytes([(length - 2) << 5 | distance >> 8, distance & 255])
        else:
            out += bytes([7 << 5 | distance >> 8, length - 9, distance & 255])
        at += length
    flush()
    return bytes(out)


def pcd(points: NDArray[np.void], data: str, packed: Any = lzf, **changed: str | None) -> bytes:
    """A PCD file; changed: lines of the header, None leaves one out."""
    assert points.dtype.fields is not None
    kinds = [(name, kind.base, int(np.prod(kind.shape))) for name, (kind, *_) in points.dtype.fields.items()]
    letters = {"f": "F", "i": "I", "u": "U"}
    lines: dict[str, str | None] = {
        "VERSION": "0.7",
        "FIELDS": " ".join(name for name, _, _ in kinds),
        "SIZE": " ".join(str(kind.itemsize) for _, kind, _ in kinds),
        "TYPE": " ".join(letters[kind.kind] for _, kind, _ in kinds),
        "COUNT": " ".join(str(count) for _, _, count in kinds),
        "WIDTH": str(len(points)),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(len(points)),
        "DATA": data,
    }
    lines |= changed
    header = "# .PCD v0.7\n" + "".join(f"{name} {text}\n" for name, text in lines.items() if text is not None)
    if data == "ascii":
        body = text_rows(points)
    elif data == "binary":
        body = points.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(points[name]).tobytes() for name, _, _ in kinds)
        compressed = packed(plain)
        body = struct.pack("<II", len(compressed), len(plain)) + compressed
    return header.encode() + body


def text_rows(points: NDArray[np.void]) -> bytes:
    return b"".join(
        " ".join(repr(v) for name in points.dtype.names or () for v in np.atleast_1d(row[name]).tolist()).encode()
        + b"\n"
        for row in points
    )


def ply(points: NDArray[np.void], form: str, before: Sequence[tuple[str, bytes]] = (), tail: bytes = b"") -> bytes:
    """A PLY file with elements (header lines, records) in front of the vertices and bytes behind them."""
    order = ">" if "big" in form else "<"
    assert points.dtype.fields is not None
    lines = [f"element vertex {len(points)}"]
    lines += [f"property {PLY_TYPES[kind.str[1:]]} {name}" for name, (kind, *_) in points.dtype.fields.items()]
    header = [
        "ply",
        f"format {form} 1.0",
        "comment made by a test",
        *(text for text, _ in before),
        *lines,
        "end_header",
        "",
    ]
    packed = np.zeros(
        len(points), [(name, kind.newbyteorder(order)) for name, (kind, *_) in points.dtype.fields.items()]
    )
    for name in points.dtype.names or ():
        packed[name] = points[name]
    body = text_rows(points) if form == "ascii" else packed.tobytes()
    return "\n".join(header).encode() + b"".join(data for _, data in before) + body + tail


def points(xyz: NDArray[Any], kind: str = "f4", order: str = "xyz", **columns: tuple[str, Any]) -> NDArray[np.void]:
    """Structured points, axes in the given order, further fields in front of them."""
    fields: list[Any] = [(n, *k) if isinstance(k, tuple) else (n, f"<{k}") for n, (k, _) in columns.items()]
    made = np.zeros(len(xyz), fields + [(axis, f"<{kind}") for axis in order])
    for axis in order:
        made[axis] = xyz[:, "xyz".index(axis)]
    for name, (_, values) in columns.items():
        made[name] = values
    return made


def written(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def refused(path: Path, told: str) -> None:
    with pytest.raises(EgolocError, match=told) as raised:
        read_cloud(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)


def las(xyz: Any, epsg: int | str | None = None, compress: bool = False, **fields: Any) -> bytes:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.array([1e-7, 1e-7, 1e-3] if epsg == 4326 else [1e-3] * 3)
    header.offsets = np.floor(np.asarray(xyz)[0]) if len(xyz) else np.zeros(3)
    if epsg is not None:
        header.add_crs(CRS.from_user_input(epsg))
    made = laspy.LasData(header)
    made.x, made.y, made.z = np.asarray(xyz).T
    for name, values in fields.items():
        setattr(made, name, values)
    stream = BytesIO()
    made.write(stream, do_compress=compress)
    return stream.getvalue()
