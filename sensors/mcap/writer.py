"""Writes messages as an MCAP file, chunk by chunk: a chunk is serialized by column, never message by message."""

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Literal, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from sensors.mcap import _kernels, container
from sensors.mcap.encode import TOPICS, Messages, Rows
from sensors.mcap.schemas import schema_text

Compression = Literal["zstd", "lz4", "none"]
Ints = NDArray[np.int64]

CHUNK_SIZE = 1 << 20
"""A chunk ends with the message that passes this many bytes."""
_OVERHEAD = _kernels.RECORD_HEADER + _kernels.MESSAGE_HEADER
_HEADER = np.dtype(
    {
        "names": ["opcode", "length", "channel", "sequence", "log_time", "publish_time"],
        "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"],
        "offsets": [0, 1, 9, 11, 15, 23],
        "itemsize": _OVERHEAD,
    }
)


class _Held(NamedTuple):
    """Messages of a channel that are still to be written: chosen rows (N,) with their log times (N,)."""

    channel: int
    rows: Rows
    row: Ints
    log_time: Ints

    @property
    def size(self) -> int:
        """Bytes of each record."""
        return len(self.rows.template) + _OVERHEAD


class ChunkWriter:
    """An MCAP file being written; finish() adds the summary.

    before_chunk: called with a chunk's first log time before the chunk is written.
    """

    def __init__(self, stream: IO[bytes], compression: Compression) -> None:
        self.stream, self.compression = stream, compression
        self.at = 0
        self.chunk_indexes: list[records.ChunkIndex] = []
        self.metadata_indexes: list[records.MetadataIndex] = []
        self.schemas: dict[str, str] = {}
        self._channels: dict[str, int] = {}
        self._defined: set[int] = set()
        self._counts: Counter[int] = Counter()
        self._span: tuple[int, int] | None = None
        self._held: list[_Held] = []
        self.before_chunk: Callable[[int], None] | None = None
        self._write(container.MAGIC)
        self._record(records.Header("ros2", "egoloc"))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record."""
        start = self.at
        self._record(records.Metadata(name, dict(values)))
        self.metadata_indexes.append(records.MetadataIndex(start, self.at - start, name))

    def messages(self, topics: Sequence[Messages], before: int | None = None) -> None:
        """Write the messages of all topics in order of log time (ties: in the order of channels).

        before: more messages may come, logged from then on; so only whole chunks of earlier ones are written, and the
        rest is held back. The file does not depend on how the messages were divided.
        """
        for topic in topics:
            channel = self._channel(topic.topic, topic.schema)
            self._held.append(_Held(channel, topic.rows(), np.arange(len(topic.log_time)), topic.log_time))
        self._held.sort(key=lambda held: held.channel)
        which, place, log_time = _merged(self._held)
        ends = np.cumsum(np.array([held.size for held in self._held], np.int64)[which])
        ready = len(which) if before is None else int(np.searchsorted(log_time, before))
        first = 0
        while first < ready:
            written = ends[first - 1] if first else 0
            stop = int(np.searchsorted(ends, written + CHUNK_SIZE)) + 1
            if stop > ready and before is not None:
                break
            self._chunk(which[first:stop], place[first:stop], log_time[first:stop])
            first = min(stop, len(which))
        self._hold(which[first:], place[first:])

    def message(self, topic: str, schema: str, data: bytes, log_time: int) -> None:
        """Write one message in a chunk of its own, which those who do not want it can pass over."""
        channel = self._channel(topic, schema)
        before = self._define([channel])
        (sequence,) = self._number(np.array([channel])).tolist()
        content = struct.pack("<HIQQ", channel, sequence, log_time, log_time) + data
        record = struct.pack("<BQ", Opcode.MESSAGE, len(content)) + content
        index = _message_index(channel, np.array([log_time]), np.array([len(before)]))
        self._write_chunk(before + record, log_time, log_time, {channel: index})

    def _channel(self, topic: str, schema: str) -> int:
        """The channel of a topic."""
        if topic not in self._channels:
            known = TOPICS.index(topic) + 1 if topic in TOPICS else len(TOPICS) + len(self._channels) + 1
            self._channels[topic] = known
            self.schemas[topic] = schema
        return self._channels[topic]

    def _hold(self, which: Ints, place: Ints) -> None:
        """Keep back these messages, and no others."""
        kept = []
        for number in np.unique(which).tolist():
            held, mine = self._held[number], np.sort(place[which == number])
            kept.append(held._replace(row=held.row[mine], log_time=held.log_time[mine]))
        self._held = kept

    def _chunk(self, which: Ints, place: Ints, log_time: Ints) -> None:
        """Write one chunk (definitions of channels that it is the first to hold, messages) and its message indexes."""
        if self.before_chunk is not None:
            self.before_chunk(int(log_time[0]))
        channels = np.array([held.channel for held in self._held])[which]
        before = self._define(np.unique(channels).tolist())
        sizes = np.array([held.size for held in self._held], np.int64)[which]
        starts = len(before) + np.cumsum(sizes) - sizes
        data = np.empty(len(before) + int(sizes.sum()), np.uint8)
        data[: len(before)] = np.frombuffer(before, np.uint8)
        sequence = self._number(channels)
        for number in np.unique(which).tolist():
            mine = which == number
            held = self._held[number]
            block = _records(held, held.row[place[mine]], sequence[mine], log_time[mine])
            _kernels.scatter(block, starts[mine], data)
        indexes = {
            channel: _message_index(channel, log_time[channels == channel], starts[channels == channel])
            for channel in np.unique(channels).tolist()
        }
        self._write_chunk(data.tobytes(), int(log_time[0]), int(log_time[-1]), indexes)

    def _number(self, channels: Ints) -> Ints:
        """(N,) how many messages of its channel came before each message; counts them."""
        sequence = np.empty(len(channels), np.int64)
        for channel in np.unique(channels).tolist():
            mine = np.flatnonzero(channels == channel)
            sequence[mine] = self._counts[channel] + np.arange(len(mine))
            self._counts[channel] += len(mine)
        return sequence & 0xFFFFFFFF

    def _write_chunk(self, plain: bytes, first: int, last: int, indexes: Mapping[int, bytes]) -> None:
        """Write a chunk's records, log times first to last, and the message index of each of its channels."""
        packed = _compress(plain, self.compression)
        name = "" if self.compression == "none" else self.compression
        start = self.at
        self._record(records.Chunk(name, packed, last, first, zlib.crc32(plain), len(plain)))
        length, offsets = self.at - start, {}
        for channel, index in indexes.items():
            offsets[channel] = self.at
            self._write(index)
        index_length = self.at - start - length
        self.chunk_indexes.append(
            records.ChunkIndex(length, start, name, len(packed), last, index_length, offsets, first, len(plain))
        )
        self._span = (first, last) if self._span is None else (min(self._span[0], first), max(self._span[1], last))

    def _define(self, channels: Sequence[int]) -> bytes:
        """Schemas and channels that were not defined before."""
        new = [channel for channel in channels if channel not in self._defined]
        self._defined.update(new)
        return b"".join(_bytes(record) for group in self._definitions(new) for record in group)

    def _definitions(self, channels: Sequence[int]) -> tuple[list[records.McapRecord], list[records.McapRecord]]:
        """Schema and channel records, by channel; a channel's schema has its number."""
        schemas: list[records.McapRecord] = []
        topics: list[records.McapRecord] = []
        for topic, number in sorted(self._channels.items(), key=lambda item: item[1]):
            if number in channels:
                package, name = self.schemas[topic].split("/")
                text = schema_text(self.schemas[topic]).encode()
                schemas.append(records.Schema(number, text, "ros2msg", f"{package}/msg/{name}"))
                topics.append(records.Channel(number, topic, "cdr", {}, number))
        return schemas, topics

    def finish(self) -> None:
        """Write the end of the data and the summary."""
        self._record(records.DataEnd(0))
        start = self.at
        schemas, channels = self._definitions(list(self._channels.values()))
        groups: list[tuple[Opcode, Sequence[records.McapRecord]]] = [
            (Opcode.SCHEMA, schemas),
            (Opcode.CHANNEL, channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self.chunk_indexes),
            (Opcode.METADATA_INDEX, self.metadata_indexes),
        ]
        parts, offsets, at = [], [], start
        for opcode, group in groups:
            data = b"".join(_bytes(record) for record in group)
            if data:
                offsets.append(_bytes(records.SummaryOffset(opcode, at, len(data))))
                parts.append(data)
                at += len(data)
        summary = b"".join(parts + offsets)
        footer = _bytes(records.Footer(start, at, 0))
        crc = zlib.crc32(footer[:-4], zlib.crc32(summary))
        self._write(summary + footer[:-4] + crc.to_bytes(4, "little") + container.MAGIC)

    def _statistics(self) -> records.Statistics:
        first, last = self._span or (0, 0)
        return records.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts={number: self._counts[number] for number in sorted(self._channels.values())},
            chunk_count=len(self.chunk_indexes),
            message_count=self._counts.total(),
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self.metadata_indexes),
            schema_count=len(self._channels),
        )

    def _record(self, record: records.McapRecord) -> None:
        self._write(_bytes(record))

    def _write(self, data: bytes) -> None:
        self.stream.write(data)
        self.at += len(data)


def _merged(held: Sequence[_Held]) -> tuple[Ints, Ints, Ints]:
    """Number of the held part, place in it and log time of every message in order of log time."""
    counts = [len(part.log_time) for part in held]
    log_time = np.concatenate([np.zeros(0, np.int64), *(part.log_time for part in held)])
    order = np.argsort(log_time, kind="stable")
    which = np.repeat(np.arange(len(held)), counts)[order]
    place = np.concatenate([np.zeros(0, np.int64), *(np.arange(n) for n in counts)])[order]
    return which, place, log_time[order]


def _records(held: _Held, chosen: Ints, sequence: Ints, log_time: Ints) -> NDArray[np.uint8]:
    """(N, size) whole message records of one channel."""
    block = np.empty((len(chosen), held.size), np.uint8)
    header = np.empty(len(chosen), _HEADER)
    header["opcode"] = Opcode.MESSAGE
    header["length"] = block.shape[1] - _kernels.RECORD_HEADER
    header["channel"] = held.channel
    header["sequence"] = sequence
    header["log_time"] = log_time
    header["publish_time"] = log_time
    block[:, :_OVERHEAD] = header.view(np.uint8).reshape(len(chosen), -1)
    held.rows.fill(block[:, _OVERHEAD:], chosen)
    return block


def _message_index(channel: int, log_time: Ints, starts: Ints) -> bytes:
    pairs = np.stack((log_time, starts), axis=1).astype("<i8").tobytes()
    length = 2 + 4 + len(pairs)
    head = (int(Opcode.MESSAGE_INDEX), 1), (length, 8), (channel, 2), (len(pairs), 4)
    return b"".join(value.to_bytes(size, "little") for value, size in head) + pairs


def _compress(data: bytes, compression: Compression) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdCompressor().compress(data)
    return bytes(lz4.frame.compress(data)) if compression == "lz4" else data


def _bytes(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
