"""Walks an MCAP file from front to back and yields its stretches of schemas, channels and messages, decompressed.

Where the summary tells, chunks are read in order of their log times and those that nobody wants are passed over. The
file is mapped, and pages that were read are given back, so memory does not follow the file's size.
"""

import heapq
import mmap
import os
import stat
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.mcap import _kernels, container
from sensors.mcap.container import ChunkEntry, ChunkHeader, DamagedError, Parser, Summary

Bytes = NDArray[np.uint8]
_RUN = 4 << 20
"""Unchunked records are handed on in stretches of about this many bytes."""
_KEEP = 32 << 20
"""Bytes that are read before the mapped pages are given back."""
LAST = 1 << 64
"""Beyond every log time."""


class Section(NamedTuple):
    """Schema, channel and message records in records[start:stop]."""

    records: Bytes
    start: int
    stop: int
    in_chunk: bool


class _Ahead:
    """The order in which the summary's chunks are to be read: by turn, which is a log time (place -> turn).

    It is the start of a chunk, but not before the turns of those in front of it that hold the same channels, so that
    the messages of a topic keep their order. A chunk whose channels are not told may hold all of them.
    """

    def __init__(self, chunks: Sequence[ChunkEntry]) -> None:
        self.turn: dict[int, int] = {}
        channels = {channel for entry in chunks for channel in entry.indexes} | {-1}
        latest = dict.fromkeys(channels, 0)
        for entry in chunks:
            mine = entry.indexes or channels
            turn = max(entry.first_ns, *(latest[channel] for channel in mine))
            latest |= dict.fromkeys(mine, turn)
            self.turn[entry.start] = turn
        self._places = [entry.start for entry in chunks]
        self._earliest = [LAST, *accumulate(reversed(self.turn.values()), min)][::-1]

    def earliest(self, at: int) -> int:
        """The earliest turn of a chunk behind an offset."""
        return self._earliest[bisect_right(self._places, at)]


@dataclass
class Container:
    """An open MCAP file and what a walk over it found: metadata, damage (reason -> count), bytes lost.

    read_up_to: every message of an earlier log time was in the sections so far; without a summary a guess, the latest
    start of a chunk.
    """

    path: Path
    data: memoryview
    mapped: mmap.mmap
    summary: Summary
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    damage: Counter[str] = field(default_factory=Counter)
    compressions: set[str] = field(default_factory=set)
    chunks: int = 0
    unchunked: bool = False
    bytes_lost: int = 0
    complete: bool = False
    read_up_to: int = 0
    _pages: int = 0

    @property
    def truncated(self) -> bool:
        """Whether the file ends before its end marker."""
        return not self.complete

    def sections(
        self, unwanted: Callable[[ChunkEntry], bool], pass_over: Callable[[ChunkEntry], None]
    ) -> Iterator[Section]:
        """Every stretch, chunks in order of log time as far as the summary tells; a damaged one is counted.

        unwanted: whether a chunk of the summary is not to be read; pass_over: called for such a one in its place.
        """
        passed = {entry.start: entry for entry in self.summary.chunks if unwanted(entry)}
        ahead = _Ahead([entry for entry in self.summary.chunks if entry.start not in passed])
        waiting: list[tuple[int, int, ChunkHeader]] = []
        for at, part in self._parts(passed, pass_over):
            if isinstance(part, Section):
                yield part
                continue
            heapq.heappush(waiting, (ahead.turn.get(at, part.first_ns), at, part))
            earliest = ahead.earliest(at)
            while waiting and waiting[0][0] <= earliest:
                yield from self._next(waiting, earliest)
        while waiting:
            yield from self._next(waiting, LAST)

    def _next(self, waiting: list[tuple[int, int, ChunkHeader]], earliest: int) -> Iterator[Section]:
        """The chunk whose turn it is; earliest: the turn of those still to come."""
        turn, _, chunk = heapq.heappop(waiting)
        bound = min(earliest, waiting[0][0]) if waiting else earliest
        self.read_up_to = max(self.read_up_to, turn if bound == LAST else bound)
        yield from self._decompressed(chunk)

    def _decompressed(self, chunk: ChunkHeader) -> Iterator[Section]:
        try:
            records = container.decompress(self.data, chunk)
        except DamagedError as error:
            self.damage[str(error)] += 1
            return
        yield Section(records, 0, len(records), in_chunk=True)
        self._give_back(chunk.stop - chunk.start)

    def _parts(
        self, passed: Mapping[int, ChunkEntry], pass_over: Callable[[ChunkEntry], None]
    ) -> Iterator[tuple[int, Section | ChunkHeader]]:
        """Sections that lie open in the file and chunks still to read, each with its place.

        Metadata, damage and the end are noted here. passed: chunks to pass over, by place.
        """
        at, size = len(container.MAGIC), len(self.data)
        while at < size:
            limit = self._next_chunk(at)
            entry = passed.get(at)
            if entry is not None and at < entry.next <= limit:
                self.chunks += 1
                self.compressions.add(entry.compression or "none")
                try:
                    pass_over(entry)
                except DamagedError as error:
                    self.damage[str(error)] += 1
                at = entry.next
                continue
            try:
                opcode, content, stop = self._record(at, limit)
            except DamagedError:
                if limit == size:
                    yield from ((at, section) for section in self._last(at))
                    return
                self.damage["damaged stretch between chunks"] += 1
                self.bytes_lost += limit - at
                at = limit
                continue
            if opcode in {container.DATA_END, container.FOOTER}:
                self._end(at, content, stop)
                return
            if opcode in {container.SCHEMA, container.CHANNEL, container.MESSAGE}:
                stop = self._run(at, min(limit, at + _RUN), stop)
                yield at, Section(self.file, at, stop, in_chunk=False)
                self._give_back(stop - at)
            else:
                yield from ((at, chunk) for chunk in self._other(opcode, content, stop))
            at = stop

    def _next_chunk(self, at: int) -> int:
        """Where the next chunk after an offset starts by the summary, else the end of the file."""
        starts = self.summary.chunk_starts
        number = bisect_right(starts, at)
        return starts[number] if number < len(starts) else len(self.data)

    def _record(self, at: int, limit: int) -> tuple[int, int, int]:
        """(opcode, content start, stop) of a whole record with a known opcode that ends at the limit or before."""
        opcode, content, stop = container.record_at(self.data, at)
        known = 0 < opcode <= container.DATA_END or opcode >= container.FIRST_PRIVATE
        if not known or stop > limit:
            raise DamagedError("no whole record")
        return opcode, content, stop

    @property
    def file(self) -> Bytes:
        """The whole file as bytes."""
        return np.frombuffer(self.data, np.uint8)

    def _run(self, at: int, limit: int, stop: int) -> int:
        """Where the run of messages from at on ends; a schema or channel stands alone."""
        if self.data[at] != container.MESSAGE:
            return stop
        self.unchunked = True
        return max(stop, int(_kernels.run_of_messages(self.file, at, limit)))

    def _other(self, opcode: int, content: int, stop: int) -> Iterator[ChunkHeader]:
        try:
            if opcode == container.CHUNK:
                self.chunks += 1
                chunk = container.chunk_header(self.data, content, stop)
                self.compressions.add(chunk.compression or "none")
                yield chunk
            elif opcode == container.METADATA:
                self._take_metadata(content, stop)
        except DamagedError as error:
            self.damage[str(error)] += 1

    def _take_metadata(self, content: int, stop: int) -> None:
        record = Parser(self.data, content, stop)
        name = record.text()
        self.metadata[name] = record.mapping()

    def read_metadata(self) -> None:
        """Take in the metadata records that the summary names, wherever they lie."""
        for at in self.summary.metadata:
            with suppress(DamagedError):  # the walk counts what is damaged
                opcode, content, stop = self._record(at, len(self.data))
                if opcode == container.METADATA:
                    self._take_metadata(content, stop)

    def chunk_at(self, entry: ChunkEntry) -> Section:
        """One chunk of the summary, out of turn; DamagedError where it cannot be read."""
        opcode, content, stop = self._record(entry.start, len(self.data))
        if opcode != container.CHUNK:
            raise DamagedError("no chunk where the summary says")
        records = container.decompress(self.data, container.chunk_header(self.data, content, stop))
        return Section(records, 0, len(records), in_chunk=True)

    def _last(self, at: int) -> Iterator[Section]:
        """The record that the end cuts short: an uncompressed chunk without checksum gives its whole messages."""
        size = len(self.data)
        try:
            opcode, content, stop = container.record_at(self.data, at)
            chunk = container.chunk_header(self.data, content, stop) if opcode == container.CHUNK else None
        except DamagedError:
            chunk = None
        if chunk is None or chunk.compression or chunk.crc or chunk.stop <= size:
            self.bytes_lost += size - at
            return
        self.chunks += 1
        self.compressions.add("none")
        yield Section(self.file, chunk.start, size, in_chunk=True)

    def _end(self, at: int, content: int, stop: int) -> None:
        """The end of the data section: the file is complete where its last bytes are the magic."""
        self.complete = self.data[-len(container.MAGIC) :] == container.MAGIC
        crc = int.from_bytes(self.data[content : content + 4], "little") if stop - content >= 4 else 0
        if self.data[at] == container.DATA_END and self.unchunked and crc and self._checksum(at) != crc:
            self.damage["the data section fails its checksum, its messages are used unchecked"] += 1

    def _checksum(self, stop: int) -> int:
        crc = 0
        for at in range(0, stop, _RUN):
            part = self.data[at : min(at + _RUN, stop)]
            crc = zlib.crc32(part, crc)
            self._give_back(len(part))
        return crc

    def _give_back(self, count: int) -> None:
        """Count bytes that were read, and now and then unmap all pages from this process; they can be read again."""
        self._pages += count
        if self._pages > _KEEP and hasattr(mmap, "MADV_DONTNEED"):
            self.mapped.madvise(mmap.MADV_DONTNEED)
            self._pages = 0


def open_container(path: str | os.PathLike[str]) -> Container:
    """Map an MCAP file; EgolocError where it is missing, empty or something else."""
    source = Path(path)
    try:
        if not stat.S_ISREG(source.stat().st_mode):  # a pipe would be waited for
            raise EgolocError(f"{source}: expected an MCAP log, got {'a folder' if source.is_dir() else 'no file'}")
        with source.open("rb") as stream:
            if os.fstat(stream.fileno()).st_size == 0:
                raise EgolocError(f"{source}: the file is empty, expected an MCAP log")
            mapped = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise EgolocError(f"{source}: cannot be read: {error.strerror or error}") from None
    data = memoryview(mapped)
    if data[: len(container.MAGIC)] != container.MAGIC:
        raise EgolocError(f"{source}: not an MCAP file, its first bytes are {bytes(data[:8]).hex(' ')}")
    return Container(source, data, mapped, container.read_summary(data))
