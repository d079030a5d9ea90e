"""Writes messages as an MCAP file, chunk by chunk: a chunk is serialized by column, never message by message."""

import zlib
from collections.abc import Mapping, Sequence
from typing import IO, Literal

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from sensors.mcap import _kernels, container
from sensors.mcap.encode import Messages, Rows
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


class ChunkWriter:
    """An MCAP file being written; finish() adds the summary."""

    def __init__(self, stream: IO[bytes], compression: Compression) -> None:
        self.stream, self.compression = stream, compression
        self.at = 0
        self.chunk_indexes: list[records.ChunkIndex] = []
        self.metadata_indexes: list[records.MetadataIndex] = []
        self._write(container.MAGIC)
        self._record(records.Header("ros2", "egoloc"))

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record."""
        start = self.at
        self._record(records.Metadata(name, dict(values)))
        self.metadata_indexes.append(records.MetadataIndex(start, self.at - start, name))

    def messages(self, topics: Sequence[Messages]) -> None:
        """Write the messages of all topics in order of log time (ties: in the order of topics)."""
        self.topics = topics
        rows = [topic.rows() for topic in topics]
        which, row, log_time = _merged(topics)
        sizes = np.array([len(r.template) + _OVERHEAD for r in rows], np.int64)
        ends = np.cumsum(sizes[which])
        first = 0
        while first < len(which):
            written = ends[first - 1] if first else 0
            stop = min(int(np.searchsorted(ends, written + CHUNK_SIZE)) + 1, len(which))
            part = slice(first, stop)
            self._chunk(rows, which[part], row[part], log_time[part], self._definitions() if first == 0 else b"")
            first = stop
        self.statistics = _statistics(topics, len(self.chunk_indexes), len(self.metadata_indexes))

    def _chunk(self, rows: Sequence[Rows], which: Ints, row: Ints, log_time: Ints, before: bytes) -> None:
        """Write one chunk (records before it, then its messages) and its message indexes."""
        sizes = np.array([len(r.template) + _OVERHEAD for r in rows], np.int64)[which]
        starts = len(before) + np.cumsum(sizes) - sizes
        data = np.empty(len(before) + int(sizes.sum()), np.uint8)
        data[: len(before)] = np.frombuffer(before, np.uint8)
        indexes = {}
        for number in np.unique(which).tolist():
            mine = which == number
            block = _records(rows[number], number + 1, row[mine], log_time[mine])
            _kernels.scatter(block, starts[mine], data)
            indexes[number + 1] = _message_index(number + 1, log_time[mine], starts[mine])
        plain = data.tobytes()
        packed = _compress(plain, self.compression)
        name = "" if self.compression == "none" else self.compression
        first, last = int(log_time[0]), int(log_time[-1])
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

    def _definitions(self) -> bytes:
        return b"".join(_bytes(record) for group in self._definition_groups() for record in group)

    def _definition_groups(self) -> tuple[list[records.McapRecord], list[records.McapRecord]]:
        schemas: list[records.McapRecord] = []
        channels: list[records.McapRecord] = []
        for number, topic in enumerate(self.topics, start=1):
            package, name = topic.schema.split("/")
            text = schema_text(topic.schema).encode()
            schemas.append(records.Schema(number, text, "ros2msg", f"{package}/msg/{name}"))
            channels.append(records.Channel(number, topic.topic, "cdr", {}, number))
        return schemas, channels

    def finish(self) -> None:
        """Write the end of the data and the summary."""
        self._record(records.DataEnd(0))
        start = self.at
        schemas, channels = self._definition_groups()
        groups: list[tuple[Opcode, Sequence[records.McapRecord]]] = [
            (Opcode.SCHEMA, schemas),
            (Opcode.CHANNEL, channels),
            (Opcode.STATISTICS, [self.statistics]),
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

    def _record(self, record: records.McapRecord) -> None:
        self._write(_bytes(record))

    def _write(self, data: bytes) -> None:
        self.stream.write(data)
        self.at += len(data)


def _merged(topics: Sequence[Messages]) -> tuple[Ints, Ints, Ints]:
    """Topic number, row and log time of every message in order of log time."""
    counts = [len(topic.log_time) for topic in topics]
    log_time = np.concatenate([np.zeros(0, np.int64), *(topic.log_time for topic in topics)])
    order = np.argsort(log_time, kind="stable")
    which = np.repeat(np.arange(len(topics)), counts)[order]
    row = np.concatenate([np.zeros(0, np.int64), *(np.arange(n) for n in counts)])[order]
    return which, row, log_time[order]


def _records(rows: Rows, channel: int, chosen: Ints, log_time: Ints) -> NDArray[np.uint8]:
    """(N, size) whole message records of one topic."""
    block = np.empty((len(chosen), _OVERHEAD + len(rows.template)), np.uint8)
    header = np.empty(len(chosen), _HEADER)
    header["opcode"] = Opcode.MESSAGE
    header["length"] = block.shape[1] - _kernels.RECORD_HEADER
    header["channel"] = channel
    header["sequence"] = chosen
    header["log_time"] = log_time
    header["publish_time"] = log_time
    block[:, :_OVERHEAD] = header.view(np.uint8).reshape(len(chosen), -1)
    rows.fill(block[:, _OVERHEAD:], chosen)
    return block


def _message_index(channel: int, log_time: Ints, starts: Ints) -> bytes:
    pairs = np.stack((log_time, starts), axis=1).astype("<i8").tobytes()
    length = 2 + 4 + len(pairs)
    head = (int(Opcode.MESSAGE_INDEX), 1), (length, 8), (channel, 2), (len(pairs), 4)
    return b"".join(value.to_bytes(size, "little") for value, size in head) + pairs


def _statistics(topics: Sequence[Messages], chunks: int, metadata: int) -> records.Statistics:
    counts = {number: len(topic.log_time) for number, topic in enumerate(topics, start=1)}
    return records.Statistics(
        attachment_count=0,
        channel_count=len(topics),
        channel_message_counts=counts,
        chunk_count=chunks,
        message_count=sum(counts.values()),
        message_end_time=max((int(topic.log_time.max()) for topic in topics if len(topic.log_time)), default=0),
        message_start_time=min((int(topic.log_time.min()) for topic in topics if len(topic.log_time)), default=0),
        metadata_count=metadata,
        schema_count=len(topics),
    )


def _compress(data: bytes, compression: Compression) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdCompressor().compress(data)
    return bytes(lz4.frame.compress(data)) if compression == "lz4" else data


def _bytes(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
