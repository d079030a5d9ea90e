"""Reads an MCAP file once and hands every message to its topic."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sensors.mcap import _kernels, cdr, container
from sensors.mcap.columns import Index, Topic, Wanted, open_topic
from sensors.mcap.container import DamagedError, Definitions, Parser, SchemaRecord
from sensors.mcap.sections import Container, Section

Bytes = NDArray[np.uint8]


class Gatherer:
    """Reads a container once and keeps a Topic for every wanted topic (with times: for every topic).

    wanted(topic, schema name) says what to keep of a topic, None for nothing.
    """

    def __init__(self, wanted: Callable[[str, str], Wanted | None], *, times: bool = False) -> None:
        self.wanted, self.times = wanted, times
        self.definitions = Definitions()
        self.topics: list[Topic] = []
        self.unknown = 0
        self.outside_chunks = 0
        self._slots: dict[tuple[str, str, SchemaRecord], int] = {}
        self._slot_of = np.full(1 << 16, -1, np.int32)
        self._index = Index()

    def read(self, source: Container) -> None:
        """Gather everything."""
        self.definitions = source.summary.definitions
        for identifier in self.definitions.channels:
            self._open_channel(identifier)
        for section in source.sections():
            trusted = section.in_chunk or not source.chunks
            source.bytes_lost += section.stop - self._section(section, trusted=trusted)

    def _section(self, section: Section, *, trusted: bool) -> int:
        """Gather one section; returns where whole records end."""
        records, cursor, stop = section.records, section.start, section.stop
        index = self._index
        while stop - cursor >= container.RECORD_HEADER:
            index.count, reached, unknown = _kernels.scan(
                records, cursor, stop, self._slot_of, index.at, index.size, index.slot, index.log_time
            )
            self.unknown += unknown
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
