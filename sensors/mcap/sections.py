"""Walks an MCAP file from front to back and yields its stretches of schemas, channels and messages, decompressed.

The file is mapped, and pages behind the walk are given back, so memory does not follow the file's size.
"""

import mmap
import os
import stat
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.mcap import _kernels, container
from sensors.mcap.container import ChunkHeader, DamagedError, Parser, Summary

Bytes = NDArray[np.uint8]
_RUN = 4 << 20
"""Unchunked records are handed on in stretches of about this many bytes."""
_KEEP = 32 << 20
"""Mapped bytes behind the walk that are given back at once."""


class Section(NamedTuple):
    """Schema, channel and message records in records[start:stop]."""

    records: Bytes
    start: int
    stop: int
    in_chunk: bool


@dataclass
class Container:
    """An open MCAP file and what a walk over it found: metadata, damage (reason -> count), bytes lost."""

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

    @property
    def truncated(self) -> bool:
        """Whether the file ends before its end marker."""
        return not self.complete

    def sections(self) -> Iterator[Section]:
        """Every stretch in file order; a damaged chunk is counted and passed over."""
        for part in self._parts():
            if isinstance(part, Section):
                yield part
                continue
            try:
                records = container.decompress(self.data, part)
            except DamagedError as error:
                self.damage[str(error)] += 1
                continue
            yield Section(records, 0, len(records), in_chunk=True)

    def _parts(self) -> Iterator[Section | ChunkHeader]:
        """Sections that lie open in the file and chunks still to read; metadata, damage and the end are noted here."""
        at, given_back, size = len(container.MAGIC), 0, len(self.data)
        while at < size:
            limit = self._next_chunk(at)
            try:
                opcode, content, stop = self._record(at, limit)
            except DamagedError:
                if limit == size:
                    yield from self._last(at)
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
                yield Section(self.file, at, stop, in_chunk=False)
            else:
                yield from self._other(opcode, content, stop)
            at = stop
            if at - given_back > _KEEP:
                given_back = self._give_back(given_back, at)

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
                record = Parser(self.data, content, stop)
                name = record.text()
                self.metadata[name] = record.mapping()
        except DamagedError as error:
            self.damage[str(error)] += 1

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
        if self.data[at] == container.DATA_END and self.unchunked and crc and zlib.crc32(self.data[:at]) != crc:
            self.damage["the data section fails its checksum, its messages are used unchecked"] += 1

    def _give_back(self, start: int, stop: int) -> int:
        """Unmap the pages in [start, stop) from this process; reading them again is still possible."""
        stop -= stop % mmap.PAGESIZE
        if hasattr(mmap, "MADV_DONTNEED"):
            self.mapped.madvise(mmap.MADV_DONTNEED, start, stop - start)
        return stop


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
