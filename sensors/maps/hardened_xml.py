"""XML of maps into elements that know their line: no entities, no document types, nothing fetched, a limit on size.

Map formats need no document type declaration, and every known XML bomb does (entity expansion, external entities),
so one is refused before it is read. The parser is the standard library's expat.
"""

import math
from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from sensors.errors import EgolocError

MAX_BYTES = 1 << 28
"""A map of some hundred kilometres of road; elements in memory take about ten times as much."""
MAX_DEPTH = 64
"""Elements inside each other; OpenDRIVE and OSM use ten."""


LARGEST = 1e12
"""Numbers beyond this are no lengths, angles or coefficients, and overflow when squared often enough."""


class Node(Element):
    """An element and where it stands."""

    __slots__ = ("line", "path")
    path: Path
    line: int


def parse(path: Path, max_bytes: int = MAX_BYTES) -> Node:
    """The root element of a file; every element in it is a Node.

    Raises EgolocError, one line that names the file, where it cannot be opened, is larger than max_bytes, holds a
    document type, or is not well-formed XML (with its line).
    """
    reader = _Reader(path)
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise EgolocError(f"{path}: expected at most {max_bytes >> 20} MB of XML, got {size / (1 << 20):.0f} MB")
        with path.open("rb") as handle:
            return reader.root(handle.read(max_bytes))
    except OSError as error:
        raise EgolocError(f"{path}: cannot be read: {error.strerror}") from error
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise EgolocError(f"{path}: line {error.lineno}: expected well-formed XML: {reason}") from error
    except (LookupError, ValueError) as error:
        if isinstance(error, EgolocError):
            raise
        raise EgolocError(f"{path}: line 1: expected XML in a known encoding: {error}") from error


class _Reader:
    """Expat's events of one file, built into a tree."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.depth = 0
        self.tree = TreeBuilder(element_factory=Node)
        self.expat = expat.ParserCreate()
        self.expat.buffer_text = True
        self.expat.StartDoctypeDeclHandler = self.doctype
        self.expat.StartElementHandler = self.start
        self.expat.EndElementHandler = self.end
        self.expat.CharacterDataHandler = self.tree.data

    def root(self, text: bytes) -> Node:
        self.expat.Parse(text, True)
        root = self.tree.close()
        assert isinstance(root, Node)  # expat refuses a document without a root
        return root

    def doctype(self, *_: object) -> NoReturn:
        where = f"{self.path}: line {self.expat.CurrentLineNumber}"
        raise EgolocError(f"{where}: expected a map without document type or entities, got <!DOCTYPE")

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            where = f"{self.path}: line {self.expat.CurrentLineNumber}"
            raise EgolocError(f"{where}: expected at most {MAX_DEPTH} elements inside each other")
        node = self.tree.start(tag, attributes)
        assert isinstance(node, Node)
        node.path, node.line = self.path, self.expat.CurrentLineNumber

    def end(self, tag: str) -> None:
        self.depth -= 1
        self.tree.end(tag)


def mistake(element: Element, what: str) -> EgolocError:
    """The error that names an element's file, line and tag: what was expected there, what came."""
    where = f"{element.path}: line {element.line}: " if isinstance(element, Node) else ""
    return EgolocError(f"{where}<{element.tag}>: {what}")


def number(element: Element, key: str, default: float | None = None) -> float:
    """A finite number of an attribute, LARGEST at most; default where the attribute is absent, None: it is required."""
    text = element.get(key)
    if text is None:
        if default is None:
            raise mistake(element, f"expected the attribute {key}")
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST:
        raise mistake(element, f"{key}: expected a finite number, got {text[:40]!r}")
    return value
