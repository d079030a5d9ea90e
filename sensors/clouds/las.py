"""LAS and LAZ files (ASPRS), through laspy and lazrs, chunk by chunk.

The file's coordinate system (CRS) says where its points lie on the earth. In UTM on WGS 84 or its like (ETRS89, NAD83:
within a metre of it) they are taken as they are, in others pyproj brings them over; heights keep their datum and become
metres.
Points marked as withheld are left out.
"""

import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from laspy.errors import LaspyException
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from sensors.clouds.cloud import Cloud, Floats, check_room, usable
from sensors.clouds.laz import check_chunks
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map
from sensors.maps.placing import placed
from sensors.records import LeftOut

_HEAD_1_0, _HEAD = 227, 247
"""Bytes of a header of version 1.0, and of one of 1.4 as far as its records are told."""
_CHUNK = 1 << 20
"""Points decompressed at a time."""
_DAMAGE = (LaspyException, OSError, ValueError, TypeError, LookupError, OverflowError, EOFError, struct.error,
           RuntimeError, MemoryError)  # fmt: skip


def read(path: Path, frame: MapFrame | None = None) -> Cloud:
    """The points of a file. frame: the map's; None: the UTM zone of the file's CRS, less whole kilometres."""
    _check_records(path)
    with _damage(path), laspy.open(path) as source:
        _check_header(path, source.header)
        if source.header.are_points_compressed and source.header.point_count:
            check_chunks(path, source.header)
        crs = source.header.parse_crs()
        parts, withheld = [np.zeros((0, 3))], 0
        for chunk in source.chunk_iterator(_CHUNK):
            keep = ~np.asarray(chunk.withheld, bool)
            withheld += len(keep) - int(keep.sum())
            parts.append(np.stack([np.asarray(chunk[axis], np.float64)[keep] for axis in "xyz"], axis=1))
    xyz = np.concatenate(parts)
    count = source.header.point_count
    if len(xyz) + withheld != count:
        raise EgolocError(f"{path}: number of points: the header says {count}, the file has {len(xyz) + withheld}")
    xyz, left_out = usable(path, xyz)
    if withheld:
        left_out = (*left_out, LeftOut(path.name, "points marked as withheld", withheld))
    if crs is None or not len(xyz):
        return Cloud(xyz, None, None, left_out)
    return _placed(path, crs, xyz, frame, left_out)


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """What laspy and lazrs raise for damaged files, as one line."""
    try:
        yield
    except EgolocError:
        raise
    except BaseException as error:
        # lazrs has errors of its own, and panics (no Exceptions) on some files
        if not isinstance(error, _DAMAGE) and type(error).__name__ not in {"LazrsError", "PanicException"}:
            raise
        reason = (str(error).splitlines() or [repr(error)])[0][:200]
        raise EgolocError(f"{path}: expected a LAS or LAZ file: {reason}") from None


def _check_records(path: Path) -> None:
    """That the records behind the header can be there, for laspy reads as many as the header claims."""
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
        size = os.fstat(stream.fileno()).st_size
    if head[:4] != b"LASF" or len(head) < _HEAD_1_0:
        raise EgolocError(f"{path}: expected a LAS or LAZ file, its first bytes are {head[:8].hex(' ')}")
    header_size, points_at, records = struct.unpack_from("<HII", head, 94)
    claims = [("number of variable length records", records, 54, min(points_at, size) - header_size)]
    if head[25] >= 4 and len(head) == _HEAD:
        at, extended = struct.unpack_from("<QI", head, 235)
        claims.append(("number of extended variable length records", extended, 60, size - at))
    for field, count, least, there in claims:
        if count and count * least > there:
            raise EgolocError(f"{path}: {field}: {count} do not fit into the {max(there, 0)} bytes that they have")


def _check_header(path: Path, header: laspy.LasHeader) -> None:
    """That the points which the header claims can be there, and that its scales are numbers."""
    for field in ("scales", "offsets"):
        values = getattr(header, field)
        if not np.isfinite(values).all() or (field == "scales" and not np.all(values)):
            raise EgolocError(f"{path}: {field}: expected finite numbers, got {values}")
    check_room(path, "number of points", header.point_count)
    there = path.stat().st_size - header.offset_to_point_data
    if not header.are_points_compressed and header.point_count * header.point_format.size > there:
        needed = header.point_count * header.point_format.size
        raise EgolocError(f"{path}: number of points: the header claims {needed} bytes of points, the file has {there}")


def _placed(path: Path, crs: CRS, xyz: Floats, frame: MapFrame | None, left_out: tuple[LeftOut, ...]) -> Cloud:
    """The points in the map's frame."""
    horizontal, metres = _parts(crs)
    xyz = xyz * (1.0, 1.0, metres)
    zone = horizontal.utm_zone
    if zone is not None:
        own = MapFrame("utm", zone=int(zone[:-1]), south=zone[-1] == "S")
        whole = tuple(float(value // 1000 * 1000) for value in xyz[0, :2])
        target = frame or MapFrame("utm", (whole[0], whole[1], 0.0), own.zone, own.south)
        if (target.kind, target.zone, target.south) == ("utm", own.zone, own.south):
            return Cloud(xyz - target.origin, target, None, left_out)
        target, xyz = placed(str(path), llh_from_map(own, xyz), target)
        return Cloud(xyz, target, None, left_out)
    try:
        to_degrees: Callable[..., Any] = Transformer.from_crs(horizontal, "EPSG:4326", always_xy=True).transform
        lon, lat = to_degrees(xyz[:, 0], xyz[:, 1])
    except ProjError as error:
        raise EgolocError(f"{path}: CRS {horizontal.name}: {str(error).splitlines()[0]}") from None
    llh = np.stack((np.radians(lat), np.radians(lon), xyz[:, 2]), axis=1)
    if not np.isfinite(llh).all():
        raise EgolocError(f"{path}: CRS {horizontal.name}: expected points that lie in it, some do not")
    target, xyz = placed(str(path), llh, frame)
    return Cloud(xyz, target, None, left_out)


def _parts(crs: CRS) -> tuple[CRS, float]:
    """The horizontal part of a CRS, and its unit of height in m: where it has none that of x and y, if those have."""
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    horizontal = parts[0]
    axes = parts[1].axis_info if len(parts) > 1 else crs.axis_info[2:] or ([] if crs.is_geographic else crs.axis_info)
    return horizontal, float(axes[0].unit_conversion_factor) if axes else 1.0
