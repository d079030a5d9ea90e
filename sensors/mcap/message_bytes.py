"""The bytes of single CDR messages (XCDR1, little-endian), field after field: of messages too large for columns.

A message is a 4-byte header ``00 01 00 00`` and fields aligned to their own size, counted from after that header.
"""

import struct

from sensors.mcap.cdr import HEADER_SIZE, LITTLE_ENDIAN, MalformedMessageError, header_problem


class MessageReader:
    """Reads fields in the order in which they lie; MalformedMessageError where the message is shorter than they are."""

    def __init__(self, data: memoryview) -> None:
        if problem := header_problem(bytes(data[:HEADER_SIZE])):
            raise MalformedMessageError(problem)
        self.data, self.at = data, HEADER_SIZE

    def number(self, format: str) -> int:
        """One integer of a struct format."""
        return int(struct.unpack_from(f"<{format}", self._take(struct.calcsize(f"<{format}"), 1))[0])

    def doubles(self, count: int) -> tuple[float, ...]:
        """Float64 numbers of a message without a length of their own."""
        return struct.unpack_from(f"<{count}d", self._take(8, count))

    def text(self) -> str:
        """A string, without its terminator."""
        return bytes(self._take(1, self.number("I"))).rstrip(b"\0").decode("utf-8", "replace")

    def raw(self) -> memoryview:
        """A sequence of bytes."""
        return self._take(1, self.number("I"))

    def _take(self, size: int, count: int) -> memoryview:
        start = HEADER_SIZE - (HEADER_SIZE - self.at) // size * size
        stop = start + size * count
        if stop > len(self.data):
            raise MalformedMessageError("message is shorter than its schema says")
        self.at = stop
        return self.data[start:stop]


class MessageWriter:
    """Writes fields one behind the other."""

    def __init__(self) -> None:
        self.data = bytearray(LITTLE_ENDIAN + b"\0\0")

    def number(self, format: str, value: int) -> None:
        self._put(struct.calcsize(f"<{format}"), struct.pack(f"<{format}", value))

    def doubles(self, *values: float) -> None:
        self._put(8, struct.pack(f"<{len(values)}d", *values))

    def text(self, text: str) -> None:
        self.raw(text.encode() + b"\0")

    def raw(self, data: bytes) -> None:
        """A sequence of bytes, with its length."""
        self.number("I", len(data))
        self.data += data

    def _put(self, size: int, data: bytes) -> None:
        self.data += bytes((HEADER_SIZE - len(self.data)) % size) + data
