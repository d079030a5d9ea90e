"""One topic's messages as columns: only the wanted bytes of each are copied, so memory follows the columns.

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

    count: messages seen; unreadable: reason -> messages that were skipped; texts: (row, texts) from that row on.
    """

    name: str
    schema: SchemaRecord
    encoding: str
    unsupported: str | None = None
    dtype: np.dtype[np.void] = field(default_factory=lambda: np.dtype([]))
    count: int = 0
    unreadable: Counter[str] = field(default_factory=Counter)
    texts: list[tuple[int, tuple[str, ...]]] = field(default_factory=list)
    rows: int = 0
    _definition: cdr.Schema | None = None
    _wanted: Wanted = field(default_factory=lambda: Wanted({}))
    _blocks: list[tuple[Bytes, Ints]] = field(default_factory=list)
    _filled: int = 0
    _layout: _Layout = _ANY
    _known: dict[int, list[_Layout]] = field(default_factory=dict)

    @property
    def frame(self) -> str:
        """The first row's header.frame_id, without a leading slash ("" where it is not kept)."""
        return self.texts[0][1][0].lstrip("/") if self.texts and self.texts[0][1] else ""

    def has_column(self, name: str) -> bool:
        """Whether a column was gathered."""
        return name in (self.dtype.names or ())

    def column(self, name: str) -> NDArray[np.float64]:
        """(N,) or (N, k) float64 column of all rows, in file order."""
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

    def in_first_frame(self) -> NDArray[np.bool_]:
        """(N,) rows whose texts are those of the first row."""
        mask = np.ones(self.rows, bool)
        stops = [row for row, _ in self.texts[1:]] + [self.rows]
        for (row, texts), stop in zip(self.texts, stops, strict=False):
            mask[row:stop] = texts == self.texts[0][1]
        return mask

    def _filled_blocks(self) -> list[tuple[Bytes, Ints, int]]:
        last = len(self._blocks) - 1
        return [(rows, times, self._filled if k == last else len(rows)) for k, (rows, times) in enumerate(self._blocks)]

    def gather(self, records: Bytes, index: Index, slot: int) -> None:
        """Take this topic's messages out of the indexed ones."""
        first = 0
        while first < index.count:
            if not self._blocks or self._filled == len(self._blocks[-1][0]):
                self._blocks.append((np.empty((BLOCK, self.dtype.itemsize), np.uint8), np.empty(BLOCK, np.int64)))
                self._filled = 0
            rows, times = self._blocks[-1]
            layout, before = self._layout, self._filled
            first, self._filled = _kernels.gather(
                records, index.at, index.size, index.slot, index.log_time, first, index.count, slot,
                layout.size, layout.checks, layout.sample, layout.copies, rows, times, before,
            )  # fmt: skip
            self.rows += self._filled - before
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
                layout = _layout(self._definition, self._wanted, self.dtype, message.tobytes())
            except cdr.MalformedMessageError as error:
                self.unreadable[str(error)] += 1
                self.count += 1
                return 1
            if sum(map(len, self._known.values())) >= _LAYOUTS:
                self._known.clear()
            self._known.setdefault(size, []).append(layout)
        self._layout = layout
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
    return data[offset : offset + size].rstrip(b"\0").decode("utf-8", "replace")


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
    topic = Topic(channel.topic, schema, channel.encoding)
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
            topic._wanted = wanted
            topic._layout = _ANY._replace(size=-2)
        except EgolocError as error:
            topic.unsupported = str(error)
    return topic
