"""The columns of a map file, as of version 1: a tile's elements and surfels as a table, and back.

One row an element and one a surfel; all numbers are integers (``sensors.maps.quantized``), all codes words.
"""

from typing import Annotated, Any, Final

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.maps.quantized import (
    bytes_from_normals,
    bytes_from_ratios,
    cm_from_m,
    m_from_cm,
    normals_from_bytes,
    ratios_from_bytes,
)
from sensors.maps.vector_map import Colour, Elements, Kilometres, Kind, Style, Surfels

VERSION = 1
FACTS_KEY = b"egoloc_map"
"""Of the footer's key-value metadata: Facts as JSON."""
SURFEL = "surfel"
"""Word for a surfel in the column kind."""

KINDS = tuple(kind.name.lower() for kind in Kind)
STYLES = tuple(style.name.lower() for style in Style)
COLOURS = tuple(colour.name.lower() for colour in Colour)
WORDS: Final = {"kind": (*KINDS, SURFEL), "style": STYLES, "colour": COLOURS}

_LIST = pa.list_(pa.int32())
SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in WORDS),
        ("source", pa.int32()),
        ("name", pa.string()),
        *((axis, _LIST) for axis in "xyz"),
        *((name, pa.uint8()) for name in ("normal_u", "normal_v", "ratio_2", "ratio_3")),
    ]
)
MEANING = {
    "rows": "a row group is a tile, which holds what begins in it; its surfels come last, by rising x",
    "kind": f"{', '.join(KINDS)}, or {SURFEL}: a planar patch, the columns style to name are null",
    "source": "which of the sources, from 0",
    "x, y": "of each vertex, cm in the map's frame: divide by 100; at most 0.5 cm off",
    "z": "height of each vertex, cm in the map's frame; null: not known",
    "normal_u, normal_v": "of a surfel: u, v = (column - 127) / 127; the normal is along "
    "((u + v) / 2, (u - v) / 2, 1 - max(|u|, |v|)); at most 0.56 deg off",
    "ratio_2, ratio_3": "of a surfel: lambda1/lambda2 and lambda1/lambda3 = (column / 255)^2; r is at most "
    "sqrt(r) / 255 + 4e-6 off",
    "tiles": "of each row group: least x, least y, greatest x, greatest y of its vertices, cm",
}


class Facts(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the footer says of a map; counts: rows by kind; tiles: boxes of what each row group holds, cm."""

    version: int
    frame: MapFrame
    sources: tuple[str, ...]
    road_km: Kilometres | None
    tile_m: float
    counts: dict[str, Annotated[int, msgspec.Meta(ge=0)]]
    tiles: list[tuple[int, int, int, int]]
    columns: dict[str, str]


def table_of(elements: Elements, surfels: Surfels) -> tuple[pa.Table, tuple[int, int, int, int]]:
    """A tile's table, and the box of its vertices, cm. Coordinates must be within CM_LIMIT."""
    nothing = np.ones(len(surfels), np.bool_)
    place = np.column_stack((surfels.p, surfels.z))
    x, y, z = cm_from_m(np.concatenate((elements.xyz, place))).T
    offsets = np.concatenate((elements.first, elements.first[-1] + 1 + np.arange(len(surfels)))).astype(np.int32)
    axes = [pa.array(x.astype(np.int32)), pa.array(y.astype(np.int32)), _heights(z)]
    codes = np.concatenate((bytes_from_normals(surfels.normal), bytes_from_ratios(surfels.ratios)), axis=1)
    kind = np.concatenate((elements.kind, np.full(len(surfels), len(KINDS), np.int8)))
    columns = [
        pa.DictionaryArray.from_arrays(kind, pa.array(WORDS["kind"])).dictionary_decode(),
        _words(elements.style, STYLES, nothing),
        _words(elements.colour, COLOURS, nothing),
        pa.array(_padded(elements.source, nothing), mask=_mask(len(elements), nothing)),
        pa.concat_arrays([pa.array(elements.name.tolist(), pa.string()), pa.nulls(len(surfels), pa.string())]),
        *(pa.ListArray.from_arrays(offsets, values) for values in axes),
        *(pa.concat_arrays([pa.nulls(len(elements), pa.uint8()), pa.array(column)]) for column in codes.T.copy()),
    ]
    return pa.table(columns, schema=SCHEMA), (int(x.min()), int(y.min()), int(x.max()), int(y.max()))


def _heights(z: NDArray[np.float64]) -> pa.Array:
    unknown = np.isnan(z)
    return pa.array(np.where(unknown, 0.0, z).astype(np.int32), mask=unknown)


def _words(codes: NDArray[np.int8], words: tuple[str, ...], nothing: NDArray[np.bool_]) -> pa.Array:
    indices = pa.array(_padded(codes, nothing), mask=_mask(len(codes), nothing))
    return pa.DictionaryArray.from_arrays(indices, pa.array(words)).dictionary_decode()


def _padded(column: NDArray[Any], nothing: NDArray[np.bool_]) -> NDArray[Any]:
    return np.concatenate((column, np.zeros(len(nothing), column.dtype)))


def _mask(count: int, nothing: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.concatenate((np.zeros(count, np.bool_), nothing))


def tile_of(table: pa.Table) -> tuple[Elements, Surfels]:
    """Elements and surfels of a table with the columns of SCHEMA, words dictionary-encoded.

    Raises EgolocError where it is no tile: nulls where a number must be, unknown words, a surfel of two vertices or
    before an element.
    """
    column = {name: table.column(name).combine_chunks() for name in SCHEMA.names}
    kind = _codes(column["kind"], "kind")
    count = len(kind) - int((kind == len(KINDS)).sum())
    if (kind[:count] == len(KINDS)).any():
        raise EgolocError("kind: expected all surfels after the elements")
    first = np.concatenate(([0], np.cumsum(_counts(column))))
    xyz = np.empty((first[-1], 3))
    for axis, name in enumerate("xy"):
        xyz[:, axis] = _numbers(_vertices(column[name]), name)
    height = _vertices(column["z"])
    xyz[:, 2] = np.where(_known(height), _values(height), np.nan)
    xyz = m_from_cm(xyz)
    if (np.diff(first[count:]) != 1).any():
        raise EgolocError("x: expected one vertex of each surfel")
    vertices = int(first[count])
    return _elements(column, kind[:count], first[: count + 1], xyz[:vertices]), _surfels(column, count, xyz[vertices:])


def _elements(
    column: dict[str, Any], kind: NDArray[np.int8], first: NDArray[np.int64], xyz: NDArray[np.float64]
) -> Elements:
    """The first rows of the columns."""
    style, colour, source, name = (column[key][: len(kind)] for key in ("style", "colour", "source", "name"))
    codes = kind, _codes(style, "style"), _codes(colour, "colour")
    names = [text or "" for text in name.to_pylist()]
    return Elements(*codes, first, xyz, _numbers(source, "source"), np.array(names, np.str_))


def _surfels(column: dict[str, Any], count: int, place: NDArray[np.float64]) -> Surfels:
    """The rows from count on."""
    u, v, second, third = (_numbers(column[name][count:], name) for name in SCHEMA.names[-4:])
    normal = normals_from_bytes(np.stack((u, v), axis=-1))
    return Surfels(place[:, :2], place[:, 2], normal, ratios_from_bytes(np.stack((second, third), axis=-1)))


def _counts(column: dict[str, Any]) -> NDArray[np.int64]:
    """(N,) vertices of each row, the same in x, y and z."""
    for axis in "xyz":
        if column[axis].null_count:
            raise EgolocError(f"{axis}: expected lists, got {column[axis].null_count} nulls")
    x, y, z = (np.diff(_values(column[axis].offsets)).astype(np.int64) for axis in "xyz")
    if not (np.array_equal(x, y) and np.array_equal(x, z)):
        raise EgolocError("x, y, z: expected lists of the same lengths")
    return x


def _vertices(lists: pa.ListArray) -> pa.Array:
    """What stands in the lists, one after the other."""
    offsets = _values(lists.offsets)
    return lists.values[int(offsets[0]) : int(offsets[-1])]


def _numbers(array: pa.Array, name: str) -> NDArray[Any]:
    if array.null_count:
        raise EgolocError(f"{name}: expected numbers, got {array.null_count} nulls")
    return _values(array)


# flatten and to_numpy of pyarrow would import its compute functions and, where it is installed, pandas: 0.3 s


def _values(array: pa.Array) -> NDArray[Any]:
    """(N,) numbers; anything where they are null."""
    dtype = array.type.to_pandas_dtype()
    buffer = array.buffers()[1]
    if not len(array) or buffer is None:
        return np.zeros(len(array), dtype)
    return np.frombuffer(buffer, dtype, array.offset + len(array))[array.offset :]


def _known(array: pa.Array) -> NDArray[np.bool_]:
    """(N,) where it is not null."""
    if not array.null_count:
        return np.ones(len(array), np.bool_)
    bits = np.unpackbits(np.frombuffer(array.buffers()[0], np.uint8), bitorder="little")
    return bits[array.offset : array.offset + len(array)].astype(np.bool_)


def _codes(array: pa.DictionaryArray, name: str) -> NDArray[np.int8]:
    """(N,) place of each word in WORDS[name]."""
    known = {word: code for code, word in enumerate(WORDS[name])}
    words = array.dictionary.to_pylist()
    unknown = [word for word in words if word not in known]
    if unknown:
        raise EgolocError(f"{name}: expected one of {', '.join(known)}, got {unknown[0]!r}")
    codes: NDArray[np.int8] = np.array([known[word] for word in words], np.int8)
    places = _numbers(array.indices, name)
    if len(places) and not (places.min() >= 0 and places.max() < len(codes)):
        raise EgolocError(f"{name}: expected words of its dictionary")
    found: NDArray[np.int8] = codes[places]
    return found
