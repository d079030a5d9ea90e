"""A vector map written as one Parquet file of compressed columns, a row group a tile. ``sensors.maps.map_file`` reads.

Encodings are those that were smallest on city maps among the ones that every Parquet reader knows: coordinates
delta-coded, surfels by rising x (smaller than along a Hilbert curve), words and bytes by dictionary, all within zstd.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.maps.columns import FACTS_KEY, KINDS, MEANING, SCHEMA, SURFEL, VERSION, WORDS, Facts, table_of
from sensors.maps.quantized import CM_LIMIT, cm_from_m
from sensors.maps.tiles import tile_numbers
from sensors.maps.vector_map import NO_ELEMENTS, NO_SURFELS, Elements, Surfels, VectorMap
from sensors.whole_file import whole_file

Box = tuple[int, int, int, int]

LEVEL = 15
"""Of zstd: 2 % smaller than 3 and as fast; 19 gains another 0.1 %."""
_DELTA = "DELTA_BINARY_PACKED"
_OPTIONS = {
    "compression": "zstd",
    "compression_level": LEVEL,
    "use_dictionary": [*WORDS, "source", *SCHEMA.names[-4:]],
    "column_encoding": {**{f"{axis}.list.element": _DELTA for axis in "xyz"}, "name": "DELTA_BYTE_ARRAY"},
    "write_statistics": False,  # the boxes of the tiles say more
    "write_page_checksum": True,
    "store_schema": False,
}


def write_map(vector_map: VectorMap, path: str | os.PathLike[str], tile_m: float = 1000.0) -> None:
    """Write a map, whole or not at all; the same bytes for the same map.

    tile_m: side of a tile, m (1..100,000); where more than ``sensors.maps.tiles.MOST`` vertices lie in one it is
    quartered. An element belongs to the tile of its first vertex. Within a tile elements keep their order.
    Raises EgolocError where a coordinate is beyond 21,474 km, a surfel's numbers are none (``sensors.maps.quantized``),
    or the file cannot be written.
    """
    if not 1.0 <= tile_m <= 100_000.0:
        raise EgolocError(f"tile_m: expected 1..100000, got {tile_m:g}")
    target = Path(path)
    _check(vector_map, target)
    with whole_file(target, pa.ArrowException) as partial:
        target.parent.mkdir(parents=True, exist_ok=True)
        _write(vector_map, partial, tile_m)


def bytes_by_kind(vector_map: VectorMap, tile_m: float = 1000.0) -> dict[str, int]:
    """Size of a file with the elements of one kind alone, by kind, and of one with the surfels alone."""
    elements = vector_map.elements
    parts = {word: replace(vector_map, elements=elements.chosen(elements.kind == k)) for k, word in enumerate(KINDS)}
    alone = {word: replace(part, surfels=NO_SURFELS) for word, part in parts.items()}
    alone[SURFEL] = replace(vector_map, elements=NO_ELEMENTS)
    sizes = {}
    for word, part in alone.items():
        buffer = BytesIO()
        if len(part.elements) or len(part.surfels):
            _write(part, buffer, tile_m)
        sizes[word] = buffer.tell()
    return sizes


def _write(vector_map: VectorMap, sink: Path | BytesIO, tile_m: float) -> None:
    with pq.ParquetWriter(sink, SCHEMA, **_OPTIONS) as writer:
        boxes = []
        for elements, surfels in _tiles(vector_map, tile_m):
            table, box = table_of(elements, surfels)
            writer.write_table(table, row_group_size=len(table))
            boxes.append(box)
        facts = msgspec.json.encode(_facts(vector_map, tile_m, boxes))
        writer.add_key_value_metadata({FACTS_KEY: facts})


def _tiles(vector_map: VectorMap, tile_m: float) -> Iterator[tuple[Elements, Surfels]]:
    """Tile by tile."""
    elements, surfels = vector_map.elements, vector_map.surfels
    begins = cm_from_m(elements.xyz[elements.first[:-1], :2])
    places = cm_from_m(surfels.p)
    weights = np.concatenate((np.diff(elements.first), np.ones(len(surfels), np.int64)))
    numbers = tile_numbers(np.concatenate((begins, places)), weights, 100.0 * tile_m)
    of_elements, of_surfels = numbers[: len(elements)], numbers[len(elements) :]
    rows = np.argsort(of_elements, kind="stable"), np.lexsort((places[:, 1], places[:, 0], of_surfels))
    tiles = np.arange(numbers.max(initial=-1) + 2)
    first, patch = np.searchsorted(of_elements[rows[0]], tiles), np.searchsorted(of_surfels[rows[1]], tiles)
    for tile in tiles[:-1]:
        yield (
            elements.chosen(rows[0][first[tile] : first[tile + 1]]),
            surfels.chosen(rows[1][patch[tile] : patch[tile + 1]]),
        )


def _facts(vector_map: VectorMap, tile_m: float, boxes: list[Box]) -> Facts:
    counts = np.bincount(vector_map.elements.kind, minlength=len(KINDS)).tolist()
    return Facts(
        version=VERSION,
        frame=vector_map.frame,
        sources=vector_map.sources,
        road_km=None if vector_map.road_km is None else float(vector_map.road_km),
        tile_m=float(tile_m),
        counts={**dict(zip(KINDS, counts, strict=True)), SURFEL: len(vector_map.surfels)},
        tiles=boxes,
        columns=MEANING,
    )


def _check(vector_map: VectorMap, target: Path) -> None:
    """Raise where a coordinate does not fit."""
    elements, surfels = vector_map.elements, vector_map.surfels
    vertex = _too_far(elements.xyz)
    if vertex is not None:
        row = int(np.searchsorted(elements.first, vertex, side="right")) - 1
        named = elements.name[row] or f"element {row}"
        raise EgolocError(f"{target}: {named}: expected coordinates within 21,474 km, got {elements.xyz[vertex]}")
    surfel = _too_far(np.column_stack((surfels.p, surfels.z)))
    if surfel is not None:
        raise EgolocError(f"{target}: surfel {surfel}: expected coordinates within 21,474 km, got {surfels.p[surfel]}")


def _too_far(metres: NDArray[np.float64]) -> int | None:
    """The first row with a coordinate that a file cannot hold (NaN it can)."""
    wrong = (np.abs(cm_from_m(metres)) > CM_LIMIT).any(axis=1)
    return int(np.argmax(wrong)) if wrong.any() else None
