"""PLY files (Stanford): ascii, binary_little_endian, binary_big_endian; of them the vertices' x, y, z.

Other elements and properties, lists too, are passed over wherever they stand.
Source: Greg Turk, "The PLY Polygon File Format" (1994).
"""

import mmap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.clouds.cloud import Cloud, Floats, check_room, mapped, usable
from sensors.clouds.text_points import columns_of_text
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame

_MAX_HEADER = 1 << 20
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    """A number, or a list of them; length: numpy type of a list's length, "" for a single number."""

    name: str
    kind: str
    length: str


class _Element(NamedTuple):
    """So many records with the same properties."""

    name: str
    records: int
    properties: tuple[_Property, ...]

    @property
    def has_lists(self) -> bool:
        return any(part.length for part in self.properties)

    def dtype(self, order: str) -> np.dtype[np.void]:
        """Of a record without lists; fields are named by their number."""
        return np.dtype([(f"f{k}", order + part.kind) for k, part in enumerate(self.properties)])


def read(path: Path, _: MapFrame | None = None) -> Cloud:
    """The points of a file; it does not say where they lie on the earth."""
    data = mapped(path)
    form, elements, at = _header(path, data)
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise EgolocError(f"{path}: element vertex: expected one, got {', '.join(names) or 'none'}")
    before, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    wanted = [_place(path, vertex, axis) for axis in "xyz"]
    check_room(path, "element vertex", vertex.records)
    body = memoryview(data)[at:]
    if form == "ascii":
        xyz = _of_text(path, body, before, vertex, wanted)
    else:
        xyz = _of_bytes(path, np.frombuffer(body, np.uint8), _ORDERS[form], before, vertex, wanted)
    points, left_out = usable(path, xyz)
    return Cloud(points, left_out=left_out)


def _place(path: Path, vertex: _Element, axis: str) -> int:
    """Number of the property that holds an axis."""
    found = [k for k, part in enumerate(vertex.properties) if part.name == axis]
    if len(found) != 1 or vertex.properties[found[0]].length:
        names = " ".join(part.name for part in vertex.properties[:20]) or "none"
        raise EgolocError(f"{path}: element vertex: expected a number {axis}, got properties {names}")
    return found[0]


def _of_text(path: Path, text: memoryview, before: Sequence[_Element], vertex: _Element, wanted: list[int]) -> Floats:
    """Points of lines, one a record."""
    records = sum(element.records for element in before)
    shortest = 2 * len(vertex.properties) - 1
    if records + vertex.records * shortest > len(text) + 1:
        claim = f"{vertex.records} points and {records} other records before them"
        raise EgolocError(f"{path}: element vertex: {claim} do not fit into the {len(text)} bytes of the file")
    if any(part.length for part in vertex.properties[: max(wanted)]):
        raise EgolocError(f"{path}: element vertex: expected x, y, z in front of its lists")
    if records:
        lines = bytes(text).split(b"\n", records)
        text = memoryview(lines[records] if len(lines) > records else b"")
    return columns_of_text(path, text, vertex.records, wanted)


def _of_bytes(
    path: Path, data: NDArray[np.uint8], order: str, before: Sequence[_Element], vertex: _Element, wanted: list[int]
) -> Floats:
    """Points of binary records."""
    at = 0
    for element in before:
        at, _ = _walked(path, data, at, order, element, ())
    if vertex.has_lists:
        return _walked(path, data, at, order, vertex, wanted)[1]
    dtype = vertex.dtype(order)
    _check_size(path, vertex, at + vertex.records * dtype.itemsize, len(data))
    points = np.frombuffer(data, dtype, vertex.records, at)
    return np.stack([points[f"f{k}"].astype(np.float64) for k in wanted], axis=1)


def _walked(
    path: Path, data: NDArray[np.uint8], at: int, order: str, element: _Element, wanted: Sequence[int]
) -> tuple[int, Floats]:
    """Where an element ends, and (count, len(wanted)) numbers of it; record by record only where it has lists."""
    if not element.has_lists:
        end = at + element.records * element.dtype(order).itemsize
        _check_size(path, element, end, len(data))
        return end, np.zeros((0, len(wanted)))
    least = sum(np.dtype(part.length or part.kind).itemsize for part in element.properties)
    _check_size(path, element, at + element.records * least, len(data))
    kinds = [
        (np.dtype(order + part.kind), np.dtype(order + part.length) if part.length else None)
        for part in element.properties
    ]
    starts = np.zeros((element.records, len(wanted)), np.int64)
    for row in range(element.records):
        for k, (kind, length) in enumerate(kinds):
            if length is None:
                if k in wanted:
                    starts[row, wanted.index(k)] = at
                at += kind.itemsize
            else:
                _check_size(path, element, at + length.itemsize, len(data))
                count = int(data[at : at + length.itemsize].view(length)[0])
                if count < 0:
                    raise EgolocError(f"{path}: element {element.name}: record {row}: a list of {count} numbers")
                at += length.itemsize + count * kind.itemsize
        _check_size(path, element, at, len(data))
    columns = [_numbers(data, starts[:, i], kinds[k][0]) for i, k in enumerate(wanted)]
    return at, np.stack(columns, axis=1) if columns else np.zeros((element.records, 0))


def _numbers(data: NDArray[np.uint8], starts: NDArray[np.int64], kind: np.dtype[np.generic]) -> Floats:
    """(N,) numbers that begin at the given bytes."""
    found = data[starts[:, None] + np.arange(kind.itemsize)]
    return np.ascontiguousarray(found).view(kind)[:, 0].astype(np.float64)


def _check_size(path: Path, element: _Element, needed: int, there: int) -> None:
    if needed > there:
        raise EgolocError(
            f"{path}: element {element.name}: the header claims {element.records} records, the file ends "
            f"{needed - there} bytes before their end"
        )


def _header(path: Path, data: mmap.mmap) -> tuple[str, list[_Element], int]:
    """Format and elements, and where their records begin."""
    if data[:3] != b"ply":
        raise EgolocError(f"{path}: expected a PLY file, its first bytes are {bytes(data[:8]).hex(' ')}")
    form, elements, at, number = "", list[_Element](), 0, 0
    while True:
        end = data.find(b"\n", at, at + _MAX_HEADER)
        if end < 0 or end > _MAX_HEADER:
            raise EgolocError(f"{path}: expected a PLY header that ends with a line end_header")
        words = data[at:end].decode("ascii", "replace").split()
        at, number = end + 1, number + 1
        match words:
            case ["end_header"]:
                break
            case ["format", kind, "1.0"] if kind in _ORDERS:
                form = kind
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) <= 18:
                elements.append(_Element(name, int(count), ()))
            case ["property", *rest] if elements and (part := _property(rest)) is not None:
                elements[-1] = elements[-1]._replace(properties=(*elements[-1].properties, part))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise EgolocError(
                    f"{path}: line {number}: expected a line of a PLY header, got {' '.join(words)[:80]!r}"
                )
    if not form:
        raise EgolocError(f"{path}: format: expected one of {', '.join(_ORDERS)} 1.0")
    return form, elements, at


def _property(words: list[str]) -> _Property | None:
    """A property of the words behind ``property``; None where they are none."""
    match words:
        case ["list", length, kind, name] if _TYPES.get(length, "f")[0] in "iu" and kind in _TYPES:
            return _Property(name, _TYPES[kind], _TYPES[length])
        case [kind, name] if kind in _TYPES:
            return _Property(name, _TYPES[kind], "")
    return None
