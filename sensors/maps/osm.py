"""OpenStreetMap XML as plain records: nodes as columns, ways and relations by id. Lanelet2 maps are written in it."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from sensors.geodesy import Floats
from sensors.maps.hardened_xml import mistake, number, parse

Tags = dict[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """N nodes. row: their ids' rows; lat_lon: (N, 2) deg; local: (N, 2) m; height: (N,) m; all NaN where not given."""

    row: dict[str, int]
    lat_lon: Floats
    local: Floats
    height: Floats
    tags: tuple[Tags, ...]


@dataclass(frozen=True, slots=True)
class Way:
    """A line. nodes: rows of Nodes."""

    id: str
    nodes: tuple[int, ...]
    tags: Tags


@dataclass(frozen=True, slots=True)
class Member:
    """Of a relation: "node", "way" or "relation", its id, and what it is there."""

    type: str
    ref: str
    role: str


@dataclass(frozen=True, slots=True)
class Relation:
    """Things that belong together."""

    id: str
    members: tuple[Member, ...]
    tags: Tags

    def refs(self, kind: str, role: str) -> list[str]:
        """Ids of the members of a type in a role."""
        return [member.ref for member in self.members if member.type == kind and member.role == role]


@dataclass(frozen=True, slots=True, eq=False)
class Osm:
    """A file. deleted: how many things an editor marked as deleted; they are not here."""

    nodes: Nodes
    ways: dict[str, Way]
    relations: dict[str, Relation]
    deleted: int


def read_osm(path: Path) -> Osm:
    """All nodes, ways and relations of a file.

    Raises EgolocError naming file and line for a root that is not ``osm``, an id that is missing or there twice, a
    number that is not finite, and a way or relation whose node or way is missing.
    """
    root = parse(path)
    if root.tag != "osm":
        raise mistake(root, "expected <osm>, the root of an OpenStreetMap or Lanelet2 file")
    kept = [element for element in root if not _deleted(element)]
    nodes = _nodes(_by_id(kept, "node"))
    ways = {key: _way(key, element, nodes.row) for key, element in _by_id(kept, "way").items()}
    relations = {key: _relation(key, element, ways) for key, element in _by_id(kept, "relation").items()}
    return Osm(nodes, ways, relations, len(root) - len(kept))


def _deleted(element: Element) -> bool:
    return element.get("action") == "delete" or element.get("visible") == "false"


def _by_id(elements: list[Element], tag: str) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in elements:
        if element.tag == tag:
            key = element.get("id")
            if not key or key in found:
                raise mistake(element, f"expected an id of its own, got {key or 'none'}")
            found[key] = element
    return found


def _tags(element: Element) -> Tags:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iterfind("tag")}


def _nodes(elements: dict[str, Element]) -> Nodes:
    values, tags = np.full((len(elements), 5), np.nan), []
    for row, element in enumerate(elements.values()):
        # Autoware writes lat="" where it knows none
        values[row, :2] = [number(element, key) if element.get(key) else np.nan for key in ("lat", "lon")]
        children = {tag.get("k", ""): tag for tag in element.iterfind("tag")}
        for column, key in enumerate(("local_x", "local_y", "ele"), 2):
            if key in children:
                values[row, column] = number(children[key], "v")
        tags.append({key: tag.get("v", "") for key, tag in children.items()})
    row_of = {key: row for row, key in enumerate(elements)}
    return Nodes(row_of, values[:, :2], values[:, 2:4], values[:, 4], tuple(tags))


def _way(key: str, element: Element, row: dict[str, int]) -> Way:
    refs = [child.get("ref", "") for child in element.iterfind("nd")]
    missing = next((ref for ref in refs if ref not in row), None)
    if missing is not None:
        raise mistake(element, f"way {key}: expected its node {missing or '(no ref)'} in the file")
    return Way(key, tuple(row[ref] for ref in refs), _tags(element))


def _relation(key: str, element: Element, ways: dict[str, Way]) -> Relation:
    members = tuple(
        Member(child.get("type", ""), child.get("ref", ""), child.get("role", ""))
        for child in element.iterfind("member")
    )
    missing = next((member.ref for member in members if member.type == "way" and member.ref not in ways), None)
    if missing is not None:
        raise mistake(element, f"relation {key}: expected its way {missing or '(no ref)'} in the file")
    return Relation(key, members, _tags(element))
