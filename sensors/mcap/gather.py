"""Reads an MCAP file once and hands every message to its topic."""

from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from sensors.mcap import _kernels, cdr, container
from sensors.mcap.columns import Index, Topic, Wanted, open_topic
from sensors.mcap.container import ChunkEntry, DamagedError, Definitions, Parser, SchemaRecord
from sensors.mcap.sections import Container, Section

Bytes = NDArray[np.uint8]

_PEEKS = 4
"""Chunks in which a topic's first message is looked for before its turn."""


def _nothing(_: ChunkEntry) -> bool:
    return False


class Gatherer:
    """Reads a container once and keeps a Topic for every wanted topic (with times: for every topic).

    wanted(topic, schema name) says what to keep of a topic, None for nothing. complete: all topics are known from the
    start, by the summary.
    """

    def __init__(self, wanted: Callable[[str, str], Wanted | None], *, times: bool = False) -> None:
        self.wanted, self.times = wanted, times
        self.definitions = Definitions()
        self.topics: list[Topic] = []
        self.complete = False
        self.unknown = 0
        self.outside_chunks = 0
        self._slots: dict[tuple[str, str, SchemaRecord], int] = {}
        self._slot_of = np.full(1 << 16, -1, np.int32)
        self._index = Index()
        self._first_ns: int | None = None

    def read(self, source: Container) -> Iterator[int | None]:
        """Gather everything, section by section.

        Yields the log time before which every message has been gathered, as far as can be told (never beyond what
        topics have seen, for a chunk's own times have no checksum); None before the first message.
        """
        self.definitions = source.summary.definitions
        for identifier in self.definitions.channels:
            self._open_channel(identifier)
        self.complete = bool(self.definitions.channels)
        self._source = source
        known = all(c in self.definitions.channels for entry in source.summary.chunks for c in entry.indexes)
        for section in source.sections(self._unwanted if known else _nothing, self._pass_over):
            trusted = section.in_chunk or not source.chunks
            source.bytes_lost += section.stop - self._section(section, trusted=trusted)
            if not section.in_chunk and self._first_ns is not None:
                source.read_up_to = max(source.read_up_to, self._first_ns)
            newest = max((t for topic in self.topics if (t := topic.newest()) is not None), default=None)
            yield None if newest is None else min(newest, source.read_up_to)

    def _unwanted(self, entry: ChunkEntry) -> bool:
        """Whether no message of a chunk can be read into rows."""
        slots = [int(self._slot_of[channel]) for channel in entry.indexes]
        return bool(slots) and all(slot == -2 or self.topics[slot].unsupported for slot in slots)

    def _pass_over(self, entry: ChunkEntry) -> None:
        """Count the messages of a chunk that is not read, by its message indexes."""
        for channel, place in entry.indexes.items():
            if self._slot_of[channel] >= 0:
                log_time = container.indexed_times(self._source.data, place, channel)
                self.topics[self._slot_of[channel]].add_times(log_time)

    def peek(self, source: Container) -> None:
        """Look ahead for the first message of every topic that had none yet, where the summary says in which chunks."""
        for slot, topic in enumerate(self.topics):
            if topic.first is None and not topic.unsupported:
                channels = set(np.flatnonzero(self._slot_of == slot).tolist())
                entries = [entry for entry in source.summary.chunks if channels & set(entry.indexes)]
                for entry in sorted(entries, key=lambda entry: entry.first_ns)[:_PEEKS]:
                    topic.first = topic.first or self._first_texts(source, entry, topic)

    def _first_texts(self, source: Container, entry: ChunkEntry, topic: Topic) -> tuple[str, ...] | None:
        """The texts of a topic's first readable message in a chunk."""
        alone = Gatherer(lambda name, _: topic.wanted if name == topic.name else None)
        alone.definitions = self.definitions
        for identifier in self.definitions.channels:
            alone._open_channel(identifier)
        with suppress(DamagedError):
            alone._section(source.chunk_at(entry), trusted=True)
        found = (other for other in alone.topics if (other.schema, other.encoding) == (topic.schema, topic.encoding))
        return next((other.first for other in found if other.first is not None), None)

    def _section(self, section: Section, *, trusted: bool) -> int:
        """Gather one section; returns where whole records end."""
        records, cursor, stop = section.records, section.start, section.stop
        index = self._index
        self._first_ns = None
        while stop - cursor >= container.RECORD_HEADER:
            index.count, reached, unknown = _kernels.scan(
                records, cursor, stop, self._slot_of, index.at, index.size, index.slot, index.log_time
            )
            self.unknown += unknown
            if index.count and self._first_ns is None:
                self._first_ns = int(index.log_time[0])
            if trusted:
                self._gather(records)
            else:
                self.outside_chunks += index.count
            if reached == cursor:
                reached = self._define(records, cursor, stop)
                if reached == cursor:
                    break
            cursor = reached
        return cursor

    def _gather(self, records: Bytes) -> None:
        index = self._index
        if index.count:
            for slot in np.flatnonzero(np.bincount(index.slot[: index.count], minlength=len(self.topics))):
                self.topics[slot].gather(records, index, int(slot))

    def _define(self, records: Bytes, cursor: int, stop: int) -> int:
        """Take in a schema or channel record, skip any other; returns where it ends, or cursor where it is damaged."""
        view = memoryview(records)  # type: ignore[arg-type]
        opcode, content, end = container.record_at(view, cursor)
        if opcode in {0, container.MESSAGE} or end > stop:
            return cursor
        try:
            if opcode == container.SCHEMA:
                self.definitions.add_schema(Parser(view, content, end))
            elif opcode == container.CHANNEL:
                self._open_channel(self.definitions.add_channel(Parser(view, content, end)))
        except DamagedError:
            return cursor
        return end

    def _open_channel(self, identifier: int) -> None:
        """Give a channel the slot of its topic."""
        if self._slot_of[identifier] != -1:
            return
        channel = self.definitions.channels[identifier]
        schema = self.definitions.schemas.get(channel.schema_id, SchemaRecord("", "", ""))
        wanted = self.wanted(channel.topic, cdr.short_name(schema.name))
        if wanted is None and not self.times:
            self._slot_of[identifier] = -2
            return
        key = (channel.topic, channel.encoding, schema)
        if key not in self._slots:
            self._slots[key] = len(self.topics)
            self.topics.append(open_topic(channel, schema, wanted))
        self._slot_of[identifier] = self._slots[key]
