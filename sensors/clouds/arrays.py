"""Point clouds as numpy arrays: .npz with xyz or points (N, 3), or x, y, z (N,); .npy with (N, 3). No pickles."""

import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from sensors.clouds.cloud import Cloud, Floats, check_room, usable
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame

_NAMES = ("xyz", "points")
_AXES = ("x", "y", "z")
_DAMAGE = (OSError, ValueError, TypeError, EOFError, KeyError, OverflowError, MemoryError, RuntimeError, zlib.error,
           zipfile.BadZipFile, tokenize.TokenError, SyntaxError)  # fmt: skip
"""What numpy and zipfile raise for damaged files; the last two where an array's header is no Python dictionary."""


def read(path: Path, _: MapFrame | None = None) -> Cloud:
    """The points of a file; it does not say where they lie on the earth."""
    try:
        if path.suffix.lower() == ".npz":
            xyz = _of_archive(path)
        else:
            with path.open("rb") as stream:
                xyz = _array(path, "array", stream, 2)
    except EgolocError:
        raise
    except _DAMAGE as error:
        raise EgolocError(
            f"{path}: expected numpy arrays: {str(error).splitlines()[0] if str(error) else error!r}"
        ) from None
    points, left_out = usable(path, xyz)
    return Cloud(points, left_out=left_out)


def _of_archive(path: Path) -> Floats:
    with zipfile.ZipFile(path) as archive:
        names = {name.removesuffix(".npy") for name in archive.namelist()}
        whole = next((name for name in _NAMES if name in names), None)
        if whole is not None:
            return _member(path, archive, whole, 2)
        if missing := [name for name in _AXES if name not in names]:
            held = ", ".join(sorted(names)[:20]) or "none"
            raise EgolocError(f"{path}: {missing[0]}: expected arrays xyz, points, or x, y, z, got {held}")
        columns = [_member(path, archive, name, 1) for name in _AXES]
    if len({len(column) for column in columns}) > 1:
        raise EgolocError(f"{path}: x, y, z: expected one length, got {', '.join(str(len(c)) for c in columns)}")
    return np.stack(columns, axis=1)


def _member(path: Path, archive: zipfile.ZipFile, name: str, dimensions: int) -> Floats:
    with archive.open(f"{name}.npy") as stream:
        return _array(path, name, stream, dimensions)


def _array(path: Path, name: str, stream: IO[bytes], dimensions: int) -> Floats:
    """One array as float64; its header is judged before its numbers are read."""
    shape, dtype = _header(path, name, stream)
    wanted = "(N, 3)" if dimensions == 2 else "(N,)"
    if len(shape) != dimensions or (dimensions == 2 and shape[1] != 3) or shape[0] < 0:
        raise EgolocError(f"{path}: {name}: expected shape {wanted}, got {shape}")
    if dtype.kind not in "fiu" or dtype.hasobject:
        raise EgolocError(f"{path}: {name}: expected numbers, got {dtype}")
    check_room(path, name, shape[0], 2 * 8 * 3)
    stream.seek(0)
    array: NDArray[np.generic] = np.lib.format.read_array(stream, allow_pickle=False)
    return array.astype(np.float64)


def _header(path: Path, name: str, stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[np.generic]]:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise EgolocError(f"{path}: {name}: expected an array of format version 1 or 2, got {version}")
    return shape, dtype
