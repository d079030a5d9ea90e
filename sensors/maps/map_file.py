"""A map file opened lazily: its footer first, a tile when somebody is near it. ``sensors.maps.store`` writes them."""

import os
from collections import OrderedDict
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.maps.columns import FACTS_KEY, SCHEMA, VERSION, WORDS, Facts, tile_of
from sensors.maps.joining import joined_elements, joined_surfels
from sensors.maps.quantized import m_from_cm
from sensors.maps.vector_map import Elements, Floats, Surfels, VectorMap

CACHE_MB = 64.0
"""Decoded tiles that are kept, MB."""


class _Version(msgspec.Struct):
    version: int


class _Tile(NamedTuple):
    """A decoded tile. boxes: (N, 4) least x, least y, greatest x, greatest y of each element, m."""

    elements: Elements
    surfels: Surfels
    boxes: Floats

    @property
    def size(self) -> int:
        """Bytes of memory."""
        columns = (getattr(part, name) for part in self[:2] for name in part.__slots__)
        return int(self.boxes.nbytes) + sum(int(column.nbytes) for column in columns)


class MapFile:
    """An open map file; made by ``open_map``. Not for several threads at once.

    facts: what the footer says: frame, sources, road_km, tile_m, counts of rows by kind; boxes: (T, 4) least x, y,
    greatest x, y of what each tile holds, m.
    """

    def __init__(self, path: Path, parquet: pq.ParquetFile, facts: Facts, cache_mb: float) -> None:
        self.path = path
        self.facts = facts
        self.frame = facts.frame
        self.boxes: Floats = m_from_cm(np.array(facts.tiles, np.int64).reshape(-1, 4))
        self._parquet = parquet
        self._most = cache_mb * 1e6
        self._tiles: OrderedDict[int, _Tile] = OrderedDict()
        self._held = 0

    def around(self, x: float, y: float, radius: float) -> tuple[Elements, Surfels]:
        """Elements whose bounding box comes within radius m of a place, and surfels that lie within it.

        In the order of the file. Raises EgolocError where the file turns out to be damaged.
        """
        near = [self._tile(int(number)) for number in np.flatnonzero(_within(self.boxes, x, y, radius))]
        elements = [(tile.elements, np.flatnonzero(_within(tile.boxes, x, y, radius))) for tile in near]
        surfels = [(tile.surfels, _closer(tile.surfels.p, x, y, radius)) for tile in near]
        return (
            joined_elements([part.chosen(rows) for part, rows in elements if len(rows)]),
            joined_surfels([part.chosen(rows) for part, rows in surfels if len(rows)]),
        )

    def whole(self) -> VectorMap:
        """All of it, tile by tile; none is kept."""
        tiles = [self._decoded(number) for number in range(len(self.boxes))]
        elements = joined_elements([tile.elements for tile in tiles])
        surfels = joined_surfels([tile.surfels for tile in tiles])
        return VectorMap(self.frame, elements, surfels, self.facts.sources, self.facts.road_km)

    def column_bytes(self) -> dict[str, int]:
        """Compressed bytes of each column, and of the footer."""
        footer = self._parquet.metadata
        sizes = dict.fromkeys(SCHEMA.names, 0)
        for group in range(footer.num_row_groups):
            for number, name in enumerate(sizes):
                sizes[name] += footer.row_group(group).column(number).total_compressed_size
        return {**sizes, "footer": footer.serialized_size}

    @property
    def cached_bytes(self) -> int:
        """Memory that decoded tiles take."""
        return self._held

    def close(self) -> None:
        """Close the file and forget its tiles."""
        self._parquet.close()
        self._tiles.clear()
        self._held = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _tile(self, number: int) -> _Tile:
        """From the cache, where the one that was longest not asked for gives way."""
        tile = self._tiles.pop(number, None)
        if tile is None:
            tile = self._decoded(number)
            self._held += tile.size
        self._tiles[number] = tile
        while self._held > self._most and len(self._tiles) > 1:
            self._held -= self._tiles.popitem(last=False)[1].size
        return tile

    def _decoded(self, number: int) -> _Tile:
        try:
            elements, surfels = tile_of(self._parquet.read_row_group(number, use_threads=False))
            sources = len(self.facts.sources)
            if len(elements) and not (elements.source.min() >= 0 and elements.source.max() < sources):
                raise EgolocError(f"source: expected 0..{sources - 1}, got {elements.source.max()}")
            if (np.diff(surfels.p[:, 0]) < 0.0).any():
                raise EgolocError("x: expected surfels by rising x")
        except EgolocError as error:
            raise EgolocError(f"{self.path}: tile {number}: {error}") from None
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
            raise EgolocError(f"{self.path}: tile {number}: damaged: {_reason(error)}") from None
        return _Tile(elements, surfels, _boxes(elements))


def open_map(path: str | os.PathLike[str], cache_mb: float = CACHE_MB) -> MapFile:
    """Open a map file; only its footer is read. cache_mb: of decoded tiles that are kept (one at least).

    Raises EgolocError where it cannot be read, is cut off, is no map of egoloc or of another version.
    """
    source = Path(path)
    try:
        source.open("rb").close()  # Python's messages are shorter than pyarrow's
        footer = pq.read_metadata(source)
        schema = footer.schema.to_arrow_schema()
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, UnicodeDecodeError) as error:
        raise EgolocError(f"{source}: expected a map of egoloc, got no whole Parquet file: {_reason(error)}") from None
    except (OSError, pa.ArrowException) as error:
        raise EgolocError(f"{source}: cannot be read: {_reason(error)}") from None
    facts = _facts(source, footer)
    if schema.names != SCHEMA.names or schema.types != SCHEMA.types:
        raise EgolocError(f"{source}: expected the columns {', '.join(SCHEMA.names)} of integers and words")
    if footer.num_row_groups != len(facts.tiles):
        raise EgolocError(f"{source}: expected {len(facts.tiles)} tiles, got {footer.num_row_groups}")
    parquet = pq.ParquetFile(source, metadata=footer, read_dictionary=list(WORDS), page_checksum_verification=True)
    return MapFile(source, parquet, facts, cache_mb)


def _facts(source: Path, footer: pq.FileMetaData) -> Facts:
    text = (footer.metadata or {}).get(FACTS_KEY)
    if text is None:
        raise EgolocError(f"{source}: expected a map of egoloc, got another Parquet file")
    try:
        version = msgspec.json.decode(text, type=_Version).version
        if version != VERSION:
            raise EgolocError(f"{source}: expected a map of version {VERSION}, got version {version}: import it again")
        return msgspec.json.decode(text, type=Facts)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise EgolocError(f"{source}: footer: {error}") from None


def _reason(error: Exception) -> str:
    """One line."""
    return getattr(error, "strerror", None) or str(error).splitlines()[0]


def _boxes(elements: Elements) -> Floats:
    if not len(elements):
        return np.empty((0, 4))
    xy, first = elements.xyz[:, :2], elements.first[:-1]
    return np.concatenate((np.minimum.reduceat(xy, first), np.maximum.reduceat(xy, first)), axis=1)


def _within(boxes: Floats, x: float, y: float, radius: float) -> NDArray[np.bool_]:
    """(N,) whether a box comes within radius of a place."""
    dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 2]), 0.0)
    dy = np.maximum(np.maximum(boxes[:, 1] - y, y - boxes[:, 3]), 0.0)
    near: NDArray[np.bool_] = dx * dx + dy * dy <= radius * radius
    return near


def _closer(p: Floats, x: float, y: float, radius: float) -> NDArray[np.int64]:
    """Rows of the places (K, 2), which rise in x, that lie within radius of a place."""
    first, last = np.searchsorted(p[:, 0], (x - radius, x + radius))
    dx, dy = p[first:last, 0] - x, p[first:last, 1] - y
    near: NDArray[np.int64] = first + np.flatnonzero(dx * dx + dy * dy <= radius * radius)
    return near
