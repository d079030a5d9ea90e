"""One topic's messages as columns: only the wanted bytes of each are copied, and rows that are done with are discarded.

Messages that are laid out alike (same size, same string and sequence lengths) go through one compiled loop; at a
message that is laid out differently the offsets are found anew from its schema.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensors.errors import EgolocError
from sensors.mcap import _kernels, cdr
from sensors.mcap.container import ChannelRecord, SchemaRecord

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

BLOCK = 1 << 16
"""Messages indexed at a time, and rows in a block."""
MAX_TEXT_BYTES = 1024
"""Of a text no more is kept."""
_LAYOUTS = 256
"""Layouts that a topic remembers."""


@dataclass(frozen=True)
class Wanted:
    """What to keep of a message: columns (name -> paths of its numbers) and texts (paths of strings)."""

    columns: Mapping[str, Sequence[str]]
    texts: Sequence[str] = ()


@dataclass
class Index:
    """Messages of one stretch of records (see _kernels.scan), up to a block's rows at a time."""

    at: Ints = field(default_factory=lambda: np.empty(BLOCK, np.int64))
    size: Ints = field(default_factory=lambda: np.empty(BLOCK, np.int64))
    slot: NDArray[np.int32] = field(default_factory=lambda: np.empty(BLOCK, np.int32))
    log_time: Ints = field(default_factory=lambda: np.empty(BLOCK, np.int64))
    count: int = 0


class _Layout(NamedTuple):
    """Where the wanted bytes lie in messages that look like the sample (see _kernels.gather)."""

    size: int
    checks: Ints
    sample: Bytes
    copies: Ints
    texts: tuple[str, ...]


_NO_CHECKS = np.zeros((0, 2), np.int64)
_NO_COPIES = np.zeros((0, 3), np.int64)
_NO_SAMPLE = np.zeros(0, np.uint8)
_ANY = _Layout(-1, _NO_CHECKS, _NO_SAMPLE, _NO_COPIES, ())


@dataclass(eq=False)
class Topic:
    """One topic's messages: columns where its schema is wanted, else only log times.

    count: messages seen; unreadable: reason -> messages that were skipped; seen: rows so far; rows: those not discarded
    yet; texts: (row, texts) from that row on; first: the texts of the first row of all, None before; moved: a speed
    other than zero was decoded.
    """

    name: str
    schema: SchemaRecord
    encoding: str
    unsupported: str | None = None
    dtype: np.dtype[np.void] = field(default_factory=lambda: np.dtype([]))
    count: int = 0
    unreadable: Counter[str] = field(default_factory=Counter)
    texts: list[tuple[int, tuple[str, ...]]] = field(default_factory=list)
    first: tuple[str, ...] | None = None
    seen: int = 0
    rows: int = 0
    wanted: Wanted | None = None
    moved: bool = False
    _definition: cdr.Schema | None = None
    _blocks: list[tuple[Bytes, Ints]] = field(default_factory=list)
    _filled: int = 0
    _newest: int | None = None
    _layout: _Layout = _ANY
    _known: dict[int, list[_Layout]] = field(default_factory=dict)

    @property
    def frame(self) -> str:
        """The first row's header.frame_id, without a leading slash ("" where it is not kept)."""
        return self.first[0].lstrip("/") if self.first else ""

    def has_column(self, name: str) -> bool:
        """Whether a column was gathered."""
        return name in (self.dtype.names or ())

    def column(self, name: str) -> NDArray[np.float64]:
        """(N,) or (N, k) float64 column of all rows, in the order in which they were read."""
        parts = [block[:n].view(self.dtype)[name][:, 0] for block, _, n in self._filled_blocks()]
        shape = self.dtype[name].shape
        out = np.empty((self.rows, *shape))
        return np.concatenate(parts, out=out) if parts else out

    def integers(self, name: str) -> Ints:
        """(N,) int64 column of an integer field."""
        parts = [block[:n].view(self.dtype)[name][:, 0] for block, _, n in self._filled_blocks()]
        out = np.empty(self.rows, np.int64)
        return np.concatenate(parts, out=out, casting="unsafe") if parts else out

    def log_time(self) -> Ints:
        """(N,) int64 log times, ns."""
        return np.concatenate([np.zeros(0, np.int64), *(times[:n] for _, times, n in self._filled_blocks())])

    def newest(self) -> int | None:
        """The latest log time, or rather the median of the last few, for one alone may be damaged; None before."""
        if self._filled:
            last = sorted(self._blocks[-1][1][max(self._filled - 9, 0) : self._filled].tolist())
            self._newest = last[len(last) // 2]
        return self._newest

    def row_texts(self) -> list[tuple[str, ...]]:
        """The texts of every row."""
        stops = [row for row, _ in self.texts[1:]] + [self.rows]
        return [texts for (row, texts), stop in zip(self.texts, stops, strict=False) for _ in range(row, stop)]

    def in_first_frame(self) -> NDArray[np.bool_]:
        """(N,) rows whose texts are those of the first row of all."""
        mask = np.ones(self.rows, bool)
        stops = [row for row, _ in self.texts[1:]] + [self.rows]
        for (row, texts), stop in zip(self.texts, stops, strict=False):
            mask[row:stop] = texts == self.first
        return mask

    def discard(self, done: NDArray[np.bool_]) -> None:
        """Forget rows (N,) and free what they took."""
        blocks, rest = self._filled_blocks(), ~done
        ends = np.cumsum([0, *(n for _, _, n in blocks)])
        kept = [(b[:n][rest[i:j]], t[:n][rest[i:j]]) for (b, t, n), i, j in zip(blocks, ends, ends[1:], strict=False)]
        self.texts = self._texts_of(np.flatnonzero(rest))
        self._blocks, self._filled, self.rows = self._blocks[:1], 0, 0
        for rows, times in kept:
            self._append(rows, times)

    def _texts_of(self, rest: NDArray[np.intp]) -> list[tuple[int, tuple[str, ...]]]:
        """Texts by the new numbers of the rows that stay; the last ones hold for the rows to come."""
        starts = [row for row, _ in self.texts]
        number = np.searchsorted(starts, rest, side="right") - 1
        changes = np.flatnonzero(np.diff(number, prepend=-1))
        kept = [(int(row), self.texts[number[row]][1]) for row in changes]
        if self.texts and (not kept or kept[-1][1] != self.texts[-1][1]):
            kept.append((len(rest), self.texts[-1][1]))
        return kept

    def _append(self, rows: Bytes, times: Ints) -> None:
        """Copy rows behind the last one."""
        first = 0
        while first < len(rows):
            block, block_times = self._room()
            stop = min(first + len(block) - self._filled, len(rows))
            place = slice(self._filled, self._filled + stop - first)
            block[place], block_times[place] = rows[first:stop], times[first:stop]
            self._filled, self.rows, first = place.stop, self.rows + stop - first, stop

    def _room(self) -> tuple[Bytes, Ints]:
        """The last block, a new one where it is full."""
        if not self._blocks or self._filled == len(self._blocks[-1][0]):
            self._blocks.append((np.empty((BLOCK, self.dtype.itemsize), np.uint8), np.empty(BLOCK, np.int64)))
            self._filled = 0
        return self._blocks[-1]

    def add_times(self, log_time: Ints) -> None:
        """Take in messages of which only the log times (N,) are known."""
        self._append(np.empty((len(log_time), self.dtype.itemsize), np.uint8), log_time)
        self.count += len(log_time)
        self.seen += len(log_time)

    def _filled_blocks(self) -> list[tuple[Bytes, Ints, int]]:
        last = len(self._blocks) - 1
        return [(rows, times, self._filled if k == last else len(rows)) for k, (rows, times) in enumerate(self._blocks)]

    def gather(self, records: Bytes, index: Index, slot: int) -> None:
        """Take this topic's messages out of the indexed ones."""
        first = 0
        while first < index.count:
            rows, times = self._room()
            layout, before = self._layout, self._filled
            first, self._filled = _kernels.gather(
                records, index.at, index.size, index.slot, index.log_time, first, index.count, slot,
                layout.size, layout.checks, layout.sample, layout.copies, rows, times, before,
            )  # fmt: skip
            self.rows += self._filled - before
            self.seen += self._filled - before
            self.count += self._filled - before
            if first < index.count and self._filled < len(rows):
                first += self._change_layout(records, int(index.at[first]), int(index.size[first]))

    def _change_layout(self, records: Bytes, at: int, size: int) -> int:
        """Find the layout of the message at an offset; returns how many messages to skip: 1 where it has none."""
        message = records[at : at + size]
        layout = next((x for x in self._known.get(size, ()) if _fits(x, message)), None)
        if layout is None:
            try:
                assert self._definition is not None
                assert self.wanted is not None
                layout = _layout(self._definition, self.wanted, self.dtype, message.tobytes())
            except cdr.MalformedMessageError as error:
                self.unreadable[str(error)] += 1
                self.count += 1
                return 1
            if sum(map(len, self._known.values())) >= _LAYOUTS:
                self._known.clear()
            self._known.setdefault(size, []).append(layout)
        self._layout = layout
        if self.first is None:
            self.first = layout.texts
        if not self.texts or self.texts[-1][1] != layout.texts:
            self.texts.append((self.rows, layout.texts))
        return 0


def _fits(layout: _Layout, message: Bytes) -> bool:
    return all((message[a : a + n] == layout.sample[a : a + n]).all() for a, n in layout.checks.tolist())


def _layout(schema: cdr.Schema, wanted: Wanted, dtype: np.dtype[np.void], data: bytes) -> _Layout:
    """Offsets of the wanted bytes in messages with the lengths and wanted texts of this one."""
    found = cdr.walk(schema, data)
    checks = [(0, 2), *((offset, 4) for offset, _ in found.lengths), *(found.texts[path] for path in wanted.texts)]
    copies: list[list[int]] = []
    for name, paths in wanted.columns.items():
        target = dtype.fields[name][1] if dtype.fields else 0
        for path in paths:
            leaf, _, index = path.partition("[")
            place = found.leaves[leaf]
            size = int(place.dtype[-1])
            source = place.offset + size * (int(index[:-1]) if index else 0)
            if copies and copies[-1][0] + copies[-1][2] == source and copies[-1][1] + copies[-1][2] == target:
                copies[-1][2] += size
            else:
                copies.append([source, target, size])
            target += size
    texts = tuple(_text(data, *found.texts[path]) for path in wanted.texts)
    sample = np.frombuffer(data, np.uint8).copy()
    return _Layout(
        len(data), np.array(checks, np.int64), sample, np.array(copies, np.int64).reshape(-1, 3), texts
    )  # fmt: skip


def _text(data: bytes, offset: int, size: int) -> str:
    return data[offset : offset + min(size, MAX_TEXT_BYTES)].rstrip(b"\0").decode("utf-8", "replace")


def row_dtype(schema: cdr.Schema, wanted: Wanted) -> np.dtype[np.void]:
    """The packed numpy type of a gathered row; EgolocError where the schema lacks a wanted number."""
    fields = []
    for name, paths in wanted.columns.items():
        kinds = {cdr.field_dtype(schema, path) for path in paths}
        if len(kinds) != 1:
            raise EgolocError(f"schema {schema.name}: expected one type for {', '.join(paths)}, got {sorted(kinds)}")
        fields.append((name, kinds.pop(), (len(paths),) if len(paths) > 1 else ()))
    return np.dtype(fields)


def open_topic(channel: ChannelRecord, schema: SchemaRecord, wanted: Wanted | None) -> Topic:
    """An empty topic, with the reason why its messages cannot be read where there is one."""
    topic = Topic(channel.topic, schema, channel.encoding, wanted=wanted)
    if wanted is None:
        topic.unsupported = f"schema {schema.name or '(none)'} feeds no sensor"
    elif channel.encoding != "cdr" or schema.encoding != "ros2msg":
        topic.unsupported = (
            f"expected cdr messages with a ros2msg schema, got {channel.encoding} with {schema.encoding}"
        )
    else:
        try:
            topic._definition = cdr.parse_schema(schema.name, schema.text)
            topic.dtype = row_dtype(topic._definition, wanted)
            topic._layout = _ANY._replace(size=-2)
        except EgolocError as error:
            topic.unsupported = str(error)
    return topic
