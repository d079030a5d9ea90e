"""Single messages of chosen topics, one after the other, of a file that is too large to hold: for frames."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.mcap import _kernels, container
from sensors.mcap.columns import Index
from sensors.mcap.container import ChannelRecord, ChunkEntry, DamagedError, Definitions, Parser, SchemaRecord
from sensors.mcap.sections import Container, Section

Bytes = NDArray[np.uint8]


class SingleMessage(NamedTuple):
    """A message: its channel and schema, its log time, and its bytes, a view that lives as long as the chunk."""

    channel: ChannelRecord
    schema: SchemaRecord
    log_time: int
    data: memoryview


class MessageWalk:
    """A walk over the messages of a container of the topics that are wanted, chunk by chunk; messages() once.

    definitions: those known so far; complete: the summary told all of them.
    """

    def __init__(self, source: Container, wanted: Callable[[ChannelRecord, SchemaRecord], bool]) -> None:
        self.source, self.wanted = source, wanted
        self.definitions: Definitions = source.summary.definitions
        self.complete = bool(self.definitions.channels)
        self._slot_of = np.full(1 << 16, -1, np.int32)
        self._channels: list[int] = []
        self._index = Index()
        for identifier in self.definitions.channels:
            self._open(identifier)

    def schema_of(self, channel: ChannelRecord) -> SchemaRecord:
        """A channel's schema, an empty one where it is not defined."""
        return self.definitions.schemas.get(channel.schema_id, SchemaRecord("", "", ""))

    def holds(self, entry: ChunkEntry) -> bool:
        """Whether a chunk of the summary may hold a wanted message."""
        slots = [int(self._slot_of[channel]) for channel in entry.indexes]
        return not slots or any(slot != -2 for slot in slots)

    def wants(self, identifier: int) -> bool:
        """Whether a channel that is known is wanted."""
        return int(self._slot_of[identifier]) >= 0

    def messages(self, skip: Callable[[ChunkEntry], bool] = lambda _: False) -> Iterator[SingleMessage]:
        """The wanted messages in order of log time, as far as the summary tells. skip: chunks that are passed over."""
        for section in self.source.sections(lambda entry: not self.holds(entry) or skip(entry), lambda _: None):
            if section.in_chunk or not self.source.chunks:
                yield from self._section(section)

    def of_chunk(self, entry: ChunkEntry) -> Iterator[SingleMessage]:
        """The wanted messages of one chunk of the summary; none where it is damaged."""
        with suppress(DamagedError):
            yield from self._section(self.source.chunk_at(entry))

    def _section(self, section: Section) -> Iterator[SingleMessage]:
        records, cursor, index = section.records, section.start, self._index
        while section.stop - cursor >= container.RECORD_HEADER:
            index.count, reached, _ = _kernels.scan(
                records, cursor, section.stop, self._slot_of, index.at, index.size, index.slot, index.log_time
            )
            for i in range(index.count):
                channel = self.definitions.channels[self._channels[index.slot[i]]]
                data = memoryview(records[index.at[i] : index.at[i] + index.size[i]])  # type: ignore[arg-type]
                yield SingleMessage(channel, self.schema_of(channel), int(index.log_time[i]), data)
            if reached == cursor:
                reached = self._define(records, cursor, section.stop)
                if reached == cursor:
                    return
            cursor = reached

    def _define(self, records: Bytes, cursor: int, stop: int) -> int:
        """Take in a schema or channel record, skip any other; returns where it ends, or cursor where it is damaged."""
        view = memoryview(records)  # type: ignore[arg-type]
        opcode, content, end = container.record_at(view, cursor)
        if opcode in {0, container.MESSAGE} or end > stop:
            return cursor
        with suppress(DamagedError):
            if opcode == container.SCHEMA:
                self.definitions.add_schema(Parser(view, content, end))
            elif opcode == container.CHANNEL:
                self._open(self.definitions.add_channel(Parser(view, content, end)))
            return end
        return cursor

    def _open(self, identifier: int) -> None:
        """Say of a channel whether it is wanted."""
        if self._slot_of[identifier] == -1:
            channel = self.definitions.channels[identifier]
            self._slot_of[identifier] = -2
            if self.wanted(channel, self.schema_of(channel)):
                self._slot_of[identifier] = len(self._channels)
                self._channels.append(identifier)
