"""PCD files of the Point Cloud Library, version 0.7 and before: ascii, binary, binary_compressed.

Only x, y, z are read, at their place among any other fields. VIEWPOINT is where the points were seen from; the one that
every writer leaves who does not know (0 0 0, not turned) says nothing. Points are not moved by it, as PCL does not.
Source: pointclouds.org, "The PCD file format".
"""

import mmap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sensors.clouds._kernels import lzf_decompress
from sensors.clouds.cloud import Cloud, Floats, check_room, mapped, usable
from sensors.clouds.text_points import columns_of_text
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame

_MAX_HEADER = 1 << 16
_MAX_RATIO = 90
"""LZF makes at most 264 bytes of 3."""
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_MAX_POINT = 1 << 24
"""Bytes that a point may have."""


@dataclass(frozen=True)
class _Header:
    """What the header says: dtype of a point with fields named by their number, xyz (3,) those of x, y, z."""

    dtype: np.dtype[np.void]
    xyz: tuple[int, ...]
    counts: tuple[int, ...]
    points: int
    viewpoint: Floats | None
    kind: str


def read(path: Path, _: MapFrame | None = None) -> Cloud:
    """The points of a file; it does not say where they lie on the earth."""
    data = mapped(path)
    header, at = _header(path, data)
    check_room(path, "POINTS", header.points)
    body = memoryview(data)[at:]
    if header.kind == "ascii":
        before = np.cumsum([0, *header.counts])
        if header.points * (2 * int(before[-1]) - 1) > len(body) + 1:
            raise EgolocError(
                f"{path}: POINTS: {header.points} points do not fit into the {len(body)} bytes of the file"
            )
        xyz = columns_of_text(path, body, header.points, [int(before[k]) for k in header.xyz])
    elif header.kind == "binary":
        _check_size(path, "POINTS", header.points * header.dtype.itemsize, len(body))
        points = np.frombuffer(body, header.dtype, header.points)
        xyz = np.stack([points[f"f{k}"].astype(np.float64) for k in header.xyz], axis=1)
    else:
        xyz = _compressed(path, header, body)
    points_, left_out = usable(path, xyz)
    return Cloud(points_, None, header.viewpoint, left_out)


def _compressed(path: Path, header: _Header, body: memoryview) -> Floats:
    """Field after field, each of all points, compressed together."""
    if len(body) < 8:
        raise EgolocError(f"{path}: DATA: the file ends before the sizes of the compressed data")
    packed_size, size = (int.from_bytes(body[k : k + 4], "little") for k in (0, 4))
    if size != header.points * header.dtype.itemsize:
        expected = header.points * header.dtype.itemsize
        raise EgolocError(f"{path}: DATA: expected {expected} bytes for {header.points} points, the data claims {size}")
    _check_size(path, "DATA", packed_size, len(body) - 8)
    if size > _MAX_RATIO * packed_size:
        raise EgolocError(f"{path}: DATA: {packed_size} compressed bytes cannot hold the {size} that they claim")
    plain = np.empty(size, np.uint8)
    if lzf_decompress(np.frombuffer(body[8 : 8 + packed_size], np.uint8), plain) != size:
        raise EgolocError(f"{path}: DATA: the compressed data does not expand to the {size} bytes that it claims")
    starts = np.cumsum([0, *(header.dtype[k].itemsize for k in range(len(header.counts)))]) * header.points
    columns = [plain[starts[k] : starts[k + 1]].view(header.dtype[k]).astype(np.float64) for k in header.xyz]
    return np.stack(columns, axis=1)


def _check_size(path: Path, field: str, needed: int, there: int) -> None:
    if needed > there:
        raise EgolocError(f"{path}: {field}: the header claims {needed} bytes of points, the file has {there}")


def _header(path: Path, data: mmap.mmap) -> tuple[_Header, int]:
    """The header, and where the points begin."""
    found: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in found:
        end = data.find(b"\n", at, at + _MAX_HEADER)
        if end < 0 or end > _MAX_HEADER:
            raise EgolocError(f"{path}: expected a PCD header that ends with a line DATA")
        words = data[at:end].split(b"#")[0].decode("ascii", "replace").split()
        at = end + 1
        if words:
            found[words[0].upper()] = words[1:]
    return _judged(path, found), at


def _judged(path: Path, found: Mapping[str, list[str]]) -> _Header:
    names = found.get("FIELDS") or found.get("COLUMNS") or []
    if missing := [axis for axis in "xyz" if names.count(axis) != 1]:
        raise EgolocError(f"{path}: FIELDS: expected one {missing[0]}, got {' '.join(names[:20]) or 'none'}")
    sizes = _integers(path, found, "SIZE", len(names))
    kinds = found.get("TYPE", [])
    counts = _integers(path, found, "COUNT", len(names)) if "COUNT" in found else [1] * len(names)
    if len(kinds) != len(names):
        raise EgolocError(f"{path}: TYPE: expected {len(names)} types, got {len(kinds)}")
    for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True):
        if size not in _SIZES.get(kind, ()) or count < 0:
            raise EgolocError(f"{path}: field {name}: expected F, I or U of 1 to 8 bytes, got {count} of {kind} {size}")
    xyz = tuple(names.index(axis) for axis in "xyz")
    for k in xyz:
        if counts[k] != 1:
            raise EgolocError(f"{path}: field {names[k]}: COUNT: expected 1, got {counts[k]}")
    if sum(size * count for size, count in zip(sizes, counts, strict=True)) > _MAX_POINT:
        raise EgolocError(f"{path}: SIZE, COUNT: expected at most {_MAX_POINT} bytes a point")
    formats = [f"<{kind.lower()}{size}" for kind, size in zip(kinds, sizes, strict=True)]
    dtype = np.dtype(
        [(f"f{k}", kind, (n,) if n != 1 else ()) for k, (kind, n) in enumerate(zip(formats, counts, strict=True))]
    )
    kind = " ".join(found["DATA"]).lower()
    if kind not in {"ascii", "binary", "binary_compressed"}:
        raise EgolocError(f"{path}: DATA: expected ascii, binary or binary_compressed, got {kind[:40]!r}")
    return _Header(dtype, xyz, tuple(counts), _points(path, found), _viewpoint(path, found), kind)


def _points(path: Path, found: Mapping[str, list[str]]) -> int:
    """POINTS, which is WIDTH times HEIGHT where both are there."""
    sides = [_integers(path, found, name, 1)[0] for name in ("WIDTH", "HEIGHT") if name in found]
    points = _integers(path, found, "POINTS", 1)[0] if "POINTS" in found or len(sides) < 2 else sides[0] * sides[1]
    if points < 0 or min(sides, default=0) < 0:
        raise EgolocError(f"{path}: POINTS: expected 0 or more points, got {points} of {sides}")
    if len(sides) == 2 and sides[0] * sides[1] != points:
        raise EgolocError(f"{path}: POINTS: {points} points are not WIDTH {sides[0]} times HEIGHT {sides[1]}")
    return points


def _viewpoint(path: Path, found: Mapping[str, list[str]]) -> Floats | None:
    """(3,) place; None where there is none, or the default."""
    words = found.get("VIEWPOINT")
    if words is None:
        return None
    try:
        pose = np.array([float(word) for word in words])
    except ValueError:
        pose = np.zeros(0)
    if pose.shape != (7,) or not np.isfinite(pose).all():
        raise EgolocError(f"{path}: VIEWPOINT: expected 7 finite numbers, got {' '.join(words)[:80]}")
    place: Floats = pose[:3]
    return place if place.any() or pose[4:].any() else None


def _integers(path: Path, found: Mapping[str, Sequence[str]], name: str, count: int) -> list[int]:
    words = found.get(name, [])
    if len(words) != count or not all(word.lstrip("-").isascii() and word.lstrip("-").isdigit() for word in words):
        raise EgolocError(f"{path}: {name}: expected {count} whole numbers, got {' '.join(words)[:80] or 'none'}")
    if any(len(word) > 18 for word in words):
        raise EgolocError(f"{path}: {name}: expected numbers of points, got {' '.join(words)[:80]}")
    return [int(word) for word in words]
