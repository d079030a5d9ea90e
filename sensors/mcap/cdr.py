"""ROS 2 message definitions (schema text) and where their fields lie in a CDR message (XCDR1, little-endian).

A message is a 4-byte header ``00 01 xx xx`` and fields aligned to their own size, counted from after that header.
Strings and sequences carry a uint32 length, so the place of what follows depends on the lengths in the message itself:
``walk`` finds all offsets of one message, and every message with the same size and lengths is laid out alike.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from sensors.errors import EgolocError

HEADER_SIZE = 4
LITTLE_ENDIAN = b"\x00\x01"
MAX_MESSAGE = 1 << 16
"""The largest message that is walked, bytes; bounds the time that a message full of wrong lengths can cost."""
MAX_DEPTH = 32
"""The deepest nesting of types that is followed."""
MAX_TRAILING = 7
"""Serializers may pad a message's end up to the largest alignment, bytes."""

PRIMITIVES = {
    "bool": "u1", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2",
    "int32": "<i4", "uint32": "<u4", "int64": "<i8", "uint64": "<u8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_TIME = "int32 sec\nuint32 nanosec"
_FIELD = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)$"
)
_KINDS = {0: "big-endian CDR", 2: "PL_CDR", 3: "PL_CDR"} | dict.fromkeys(range(6, 12), "XCDR2")


class MalformedMessageError(ValueError):
    """A message that does not hold what its schema says."""


class Member(NamedTuple):
    """One field of a definition. length: None a single value, -1 a sequence, N a fixed array."""

    name: str
    type: str
    length: int | None


@dataclass(frozen=True)
class Schema:
    """A message type with everything that it is made of: definitions maps ``pkg/Type`` to its members."""

    name: str
    definitions: dict[str, tuple[Member, ...]]


class Leaf(NamedTuple):
    """Where numbers lie in a message: offset from its first byte, numpy type, how many."""

    offset: int
    dtype: str
    length: int


@dataclass
class Walk:
    """All offsets of one message: leaves and texts by path, the offsets of its uint32 lengths, and its size."""

    leaves: dict[str, Leaf] = field(default_factory=dict)
    texts: dict[str, tuple[int, int]] = field(default_factory=dict)
    lengths: list[tuple[int, int]] = field(default_factory=list)
    size: int = HEADER_SIZE


def short_name(name: str) -> str:
    """``pkg/Type`` of ``pkg/msg/Type``."""
    return name.replace("/msg/", "/")


def parse_schema(name: str, text: str) -> Schema:
    """Read a ros2msg schema: the message's fields, then ``MSG: pkg/Type`` sections behind lines of ``===``."""
    root = short_name(name)
    definitions = {
        "builtin_interfaces/Time": _members(_TIME, "builtin_interfaces"),
        "builtin_interfaces/Duration": _members(_TIME, "builtin_interfaces"),
    }
    for number, section in enumerate(re.split(r"^={3,}[ \t]*\r?$", text, flags=re.MULTILINE)):
        section_name = root
        if number:
            heading, _, section = section.strip().partition("\n")  # noqa: PLW2901
            if not heading.startswith("MSG:"):
                raise EgolocError(f"schema {name}: expected a line 'MSG: package/Type', got {heading[:40]!r}")
            section_name = short_name(heading[4:].strip())
        definitions[section_name] = _members(section, section_name.split("/")[0])
    schema = Schema(root, definitions)
    _check(schema, root, (), set())
    return schema


def _members(text: str, package: str) -> tuple[Member, ...]:
    members = []
    for line in text.splitlines():
        match = _FIELD.match(line.split("#")[0].strip())
        if match is None or match["rest"].startswith("="):
            continue
        array = match["array"]
        length = None if array is None else int(array[1:-1]) if array[1:-1].isdigit() else -1
        members.append(Member(match["name"], _full_type(match["type"], package), length))
    # rosidl gives a message without fields one byte
    return tuple(members) or (Member("structure_needs_at_least_one_member", "uint8", None),)


def _full_type(type_name: str, package: str) -> str:
    if type_name in PRIMITIVES or type_name in {"string", "wstring"}:
        return type_name
    if "/" in type_name:
        return short_name(type_name)
    return "std_msgs/Header" if type_name == "Header" else f"{package}/{type_name}"


def _check(schema: Schema, type_name: str, above: tuple[str, ...], done: set[str]) -> None:
    """Raise unless every type is defined, supported, not part of itself and nested at most MAX_DEPTH deep."""
    if type_name in above or len(above) > MAX_DEPTH:
        raise EgolocError(f"schema {schema.name}: type {type_name} contains itself or is nested too deep")
    if type_name not in schema.definitions:
        raise EgolocError(f"schema {schema.name}: type {type_name} is not defined in its text")
    for inner in {m.type for m in schema.definitions[type_name]} - set(PRIMITIVES) - {"string"} - done:
        if inner == "wstring":
            raise EgolocError(f"schema {schema.name}: type wstring is not supported")
        _check(schema, inner, (*above, type_name), done)
    done.add(type_name)


def field_dtype(schema: Schema, path: str) -> str:
    """The numpy type at a path such as ``pose.covariance[7]``; EgolocError where the schema has no such number."""
    current = schema.name
    steps = path.split(".")
    for depth, step in enumerate(steps):
        name, _, index = step.partition("[")
        member = next((m for m in schema.definitions.get(current, ()) if m.name == name), None)
        inside = index == "" or (member is not None and member.length is not None and int(index[:-1]) < member.length)
        if member is None or not inside or (member.length is not None) != bool(index):
            break
        if depth == len(steps) - 1 and member.type in PRIMITIVES:
            return PRIMITIVES[member.type]
        current = member.type
    raise EgolocError(f"schema {schema.name}: expected a number at {path}")


def header_problem(data: bytes) -> str | None:
    """Why a message's CDR header cannot be read, or None."""
    if len(data) < HEADER_SIZE:
        return "message is shorter than a CDR header"
    if data[:2] == LITTLE_ENDIAN:
        return None
    kind = _KINDS.get(data[1], "not CDR") if data[0] == 0 else "not CDR"
    return f"{kind} (header {data[:2].hex(' ')}), expected little-endian CDR (00 01)"


def walk(schema: Schema, data: bytes) -> Walk:
    """Offsets of one message's fields; MalformedMessageError where it is shorter or longer than its schema says."""
    if problem := header_problem(data):
        raise MalformedMessageError(problem)
    if len(data) > MAX_MESSAGE:
        raise MalformedMessageError(f"message is larger than {MAX_MESSAGE} bytes")

    def length_at(offset: int, _path: str, _is_text: bool) -> int:
        return int.from_bytes(data[offset : offset + 4], "little")

    result = _Walker(schema, length_at, len(data)).walk()
    if len(data) - result.size > MAX_TRAILING:
        raise MalformedMessageError("message is longer than its schema says")
    return result


def template(schema: Schema, texts: dict[str, str]) -> tuple[Walk, bytes]:
    """Offsets and bytes of a message with the given texts by path; all else is empty or zero."""
    encoded = {path: text.encode() + b"\0" for path, text in texts.items()}

    def length_of(_offset: int, path: str, is_text: bool) -> int:
        return len(encoded.get(path, b"\0")) if is_text else 0

    result = _Walker(schema, length_of, MAX_MESSAGE).walk()
    data = bytearray(result.size)
    data[:2] = LITTLE_ENDIAN
    for offset, value in result.lengths:
        data[offset : offset + 4] = value.to_bytes(4, "little")
    for path, text in encoded.items():
        offset, size = result.texts[path]
        data[offset : offset + size] = text
    return result, bytes(data)


class _Walker:
    """Walks a schema in serialization order; length_of(offset, path, is_text) gives each uint32 length."""

    def __init__(self, schema: Schema, length_of: Callable[[int, str, bool], int], limit: int) -> None:
        self.definitions = schema.definitions
        self.root = schema.name
        self.length_of = length_of
        self.limit = limit
        self.found = Walk()

    def walk(self) -> Walk:
        self._members(self.root, "")
        return self.found

    def _members(self, type_name: str, prefix: str) -> None:
        for member in self.definitions[type_name]:
            path = prefix + member.name
            count = member.length
            if count is not None and count < 0:
                count = self._length(path, is_text=False)
            if member.type in PRIMITIVES:
                self._primitive(path, PRIMITIVES[member.type], 1 if count is None else count)
            else:
                for k in range(1 if count is None else count):
                    self._value(member.type, path if count is None else f"{path}[{k}]")

    def _value(self, type_name: str, path: str) -> None:
        if type_name != "string":
            self._members(type_name, f"{path}.")
            return
        size = self._length(path, is_text=True)
        self.found.texts[path] = (self._take(1, size), size)

    def _length(self, path: str, *, is_text: bool) -> int:
        offset = self._take(4, 4)
        value = self.length_of(offset, path, is_text)
        self.found.lengths.append((offset, value))
        return value

    def _primitive(self, path: str, dtype: str, count: int) -> None:
        size = int(dtype[-1])
        # an empty sequence has no element to align
        offset = self._take(size, size * count) if count else self.found.size
        self.found.leaves[path] = Leaf(offset, dtype, count)

    def _take(self, alignment: int, size: int) -> int:
        relative = self.found.size - HEADER_SIZE
        offset = HEADER_SIZE + -(-relative // alignment) * alignment
        if size > self.limit - offset:
            raise MalformedMessageError("message is shorter than its schema says")
        self.found.size = offset + size
        return offset
