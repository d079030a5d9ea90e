"""The MCAP container: records, chunks, summary (https://mcap.dev/spec). Every length is bounded by what remains.

A file is walked from front to back, so an unindexed or truncated file reads as far as it goes; the summary, where its
checksum holds, names channels whose definition was damaged and the chunks at which to go on after a damaged length.
"""

import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEADER = 9
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6
MESSAGE_INDEX, CHUNK_INDEX, METADATA, METADATA_INDEX, DATA_END = 7, 8, 12, 13, 15
FIRST_PRIVATE = 0x80
"""Opcodes from here on are extensions that a reader skips; others beyond DATA_END are damage."""
_FOOTER_SIZE = RECORD_HEADER + 20 + len(MAGIC)
MAX_CHUNK = 1 << 30
"""The largest uncompressed chunk, bytes."""
_MAX_RATIO = {"zstd": 40_000, "lz4": 260, "": 1}
"""No compressor shrinks further than this (zstd: 128 KiB in a 4-byte block), so a larger claim is damage."""
_INDEX_PAIR = np.dtype([("channel", "<u2"), ("place", "<u8")])


class DamagedError(ValueError):
    """Bytes that are not what the format says; the message is the reason, without file or place."""


class Parser:
    """Reads the fields of one record; DamagedError where a field passes the record's end."""

    def __init__(self, data: memoryview, at: int, stop: int) -> None:
        self.data, self.at, self.stop = data, at, stop

    def integer(self, size: int) -> int:
        return int.from_bytes(self.raw(size), "little")

    def raw(self, size: int) -> memoryview:
        if size > self.stop - self.at:
            raise DamagedError("a field passes the end of its record")
        self.at += size
        return self.data[self.at - size : self.at]

    def text(self) -> str:
        try:
            return str(self.raw(self.integer(4)), "utf-8")
        except UnicodeDecodeError:
            raise DamagedError("a name is not UTF-8") from None

    def mapping(self) -> dict[str, str]:
        size = self.integer(4)
        inner = Parser(self.data, self.at, self.at + len(self.raw(size)))
        found = {}
        while inner.at < inner.stop:
            key = inner.text()
            found[key] = inner.text()
        return found


class SchemaRecord(NamedTuple):
    """A schema: name such as ``sensor_msgs/msg/Imu``, encoding such as ``ros2msg``, text."""

    name: str
    encoding: str
    text: str


class ChannelRecord(NamedTuple):
    """A channel: topic, message encoding such as ``cdr``, schema id (0: none)."""

    topic: str
    encoding: str
    schema_id: int


@dataclass
class Definitions:
    """Schemas and channels by id; the first definition of an id stands."""

    schemas: dict[int, SchemaRecord] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)

    def add_schema(self, record: Parser) -> None:
        identifier, name, encoding = record.integer(2), record.text(), record.text()
        text = str(record.raw(record.integer(4)), "utf-8", "replace")
        self.schemas.setdefault(identifier, SchemaRecord(name, encoding, text))

    def add_channel(self, record: Parser) -> int:
        identifier, schema_id = record.integer(2), record.integer(2)
        self.channels.setdefault(identifier, ChannelRecord(record.text(), record.text(), schema_id))
        return identifier


class ChunkEntry(NamedTuple):
    """What the summary says of a chunk: its record starts at start, next is where its message indexes end.

    first_ns, last_ns: the earliest and the latest log time in it; indexes: channel id -> where the message index of its
    messages lies (empty where there are none).
    """

    start: int
    next: int
    first_ns: int
    compression: str
    indexes: Mapping[int, int]
    last_ns: int


@dataclass(frozen=True)
class Summary:
    """What the end of a file says: its definitions, its chunks by place, its metadata records, whether it is there."""

    definitions: Definitions = field(default_factory=Definitions)
    chunks: tuple[ChunkEntry, ...] = ()
    metadata: tuple[int, ...] = ()
    present: bool = False

    @cached_property
    def chunk_starts(self) -> tuple[int, ...]:
        """Where the chunks start, in order."""
        return tuple(entry.start for entry in self.chunks)


class ChunkHeader(NamedTuple):
    """A chunk's own fields; data lies at [start, stop) of the file, cut short where stop passes the file's end.

    first_ns: the earliest log time in it, which no checksum covers.
    """

    compression: str
    size: int
    crc: int
    start: int
    stop: int
    first_ns: int = 0


def record_at(data: memoryview, at: int) -> tuple[int, int, int]:
    """(opcode, content start, content stop) of the record at an offset; stop may pass the end of data."""
    if len(data) - at < RECORD_HEADER:
        raise DamagedError("the file ends inside a record header")
    (length,) = struct.unpack_from("<Q", data, at + 1)
    return data[at], at + RECORD_HEADER, at + RECORD_HEADER + length


def read_summary(data: memoryview) -> Summary:
    """The summary section, empty unless footer, magic and checksum are in order."""
    nothing = Summary()
    if len(data) < len(MAGIC) + _FOOTER_SIZE or data[-len(MAGIC) :] != MAGIC:
        return nothing
    at = len(data) - _FOOTER_SIZE
    opcode, content, stop = record_at(data, at)
    start, _, crc = struct.unpack_from("<QQI", data, content)
    sound = opcode == FOOTER and stop == len(data) - len(MAGIC) and len(MAGIC) <= start < at
    if not sound or crc == 0 or zlib.crc32(data[start : stop - 4]) != crc:
        return nothing
    try:
        return _summary(data[:at], start)
    except DamagedError:
        return nothing


def _summary(data: memoryview, at: int) -> Summary:
    definitions, chunks, metadata = Definitions(), [], []
    while at < len(data):
        opcode, content, stop = record_at(data, at)
        record = Parser(data, content, min(stop, len(data)))
        if opcode == SCHEMA:
            definitions.add_schema(record)
        elif opcode == CHANNEL:
            definitions.add_channel(record)
        elif opcode == CHUNK_INDEX:
            chunks.append(_chunk_entry(record))
        elif opcode == METADATA_INDEX:
            metadata.append(record.integer(8))
        at = stop
    return Summary(definitions, tuple(sorted(chunks, key=lambda entry: entry.start)), tuple(metadata), present=True)


def _chunk_entry(record: Parser) -> ChunkEntry:
    first_ns, last_ns, start, length = (record.integer(8) for _ in range(4))
    pairs = np.frombuffer(record.raw(record.integer(4)), np.uint8)
    if len(pairs) % _INDEX_PAIR.itemsize:
        raise DamagedError("a field passes the end of its record")
    indexes = {int(channel): int(place) for channel, place in pairs.view(_INDEX_PAIR).tolist()}
    index_length, compression = record.integer(8), record.text()
    return ChunkEntry(start, start + length + index_length, first_ns, compression, indexes, last_ns)


def indexed_times(data: memoryview, at: int, channel: int) -> NDArray[np.int64]:
    """(N,) log times in the message index of a channel at an offset; DamagedError where there is none."""
    opcode, content, stop = record_at(data, at)
    record = Parser(data, content, min(stop, len(data)))
    if opcode != MESSAGE_INDEX or record.integer(2) != channel:
        raise DamagedError("the message index of a chunk is damaged")
    pairs = np.frombuffer(record.raw(record.integer(4)), np.uint8)
    if len(pairs) % 16:
        raise DamagedError("the message index of a chunk is damaged")
    return pairs.view("<i8")[::2].astype(np.int64)


def chunk_header(data: memoryview, content: int, stop: int) -> ChunkHeader:
    """A chunk's header; its data may be cut short by the end of the file, and by nothing else."""
    record = Parser(data, content, min(stop, len(data)))
    first_ns, _, size, crc = record.integer(8), record.integer(8), record.integer(8), record.integer(4)
    compression, length = record.text(), record.integer(8)
    if length > stop - record.at:
        raise DamagedError("chunk is longer than its record")
    return ChunkHeader(compression, size, crc, record.at, record.at + length, first_ns)


def decompress(data: memoryview, chunk: ChunkHeader) -> Bytes:
    """A whole chunk's records; DamagedError unless their size and checksum are those of its header."""
    if chunk.compression not in _MAX_RATIO:
        raise DamagedError(f"chunk has unknown compression {chunk.compression[:20]!r}, expected zstd, lz4 or none")
    packed = data[chunk.start : chunk.stop]
    if chunk.size > min(MAX_CHUNK, _MAX_RATIO[chunk.compression] * (len(packed) + 64)):
        raise DamagedError(f"chunk claims {chunk.size} bytes, more than {len(packed)} compressed bytes can hold")
    plain = _DECOMPRESS[chunk.compression](packed, chunk.size)
    if len(plain) != chunk.size:
        raise DamagedError("chunk does not decompress to the size it claims")
    if chunk.crc and zlib.crc32(plain) != chunk.crc:
        raise DamagedError("chunk fails its checksum")
    return np.frombuffer(plain, np.uint8)


def _zstd(packed: memoryview, size: int) -> bytes:
    try:
        if zstandard.frame_content_size(packed) in {-1, size}:
            return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    except (zstandard.ZstdError, MemoryError):
        pass
    raise DamagedError("chunk does not decompress")


def _lz4(packed: memoryview, size: int) -> bytes:
    try:
        if lz4.frame.get_frame_info(packed)["content_size"] == size:
            return bytes(lz4.frame.decompress(packed))
        # one byte more than claimed shows that the claim is wrong
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
    except (RuntimeError, EOFError, ValueError, MemoryError):
        raise DamagedError("chunk does not decompress") from None


def _stored(packed: memoryview, size: int) -> memoryview:
    return packed[:size]


_DECOMPRESS: Mapping[str, Callable[[memoryview, int], bytes | memoryview]] = {"zstd": _zstd, "lz4": _lz4, "": _stored}
