"""Small Lanelet2 files, written by tests."""

from collections.abc import Mapping, Sequence
from pathlib import Path

LAT, LON = 49.0, 8.4


def tags(values: Mapping[str, str]) -> str:
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in values.items())


def node(key: int, x: float, y: float, z: float | None = None, **more: str) -> str:
    """A node x, y metres east and north of a place in Karlsruhe, to some centimetres."""
    lat, lon = LAT + y / 111_200.0, LON + x / 73_000.0
    height = {} if z is None else {"ele": str(z)}
    return f'<node id="{key}" lat="{lat:.11f}" lon="{lon:.11f}">{tags({**height, **more})}</node>'


def local(key: int, x: float, y: float, z: float = 0.0) -> str:
    """A node as Autoware writes it where it knows no place."""
    return f'<node id="{key}" lat="" lon="">{tags({"local_x": str(x), "local_y": str(y), "ele": str(z)})}</node>'


def way(key: int, nodes: Sequence[int], type: str = "", subtype: str = "", **more: str) -> str:
    named = {key: value for key, value in (("type", type), ("subtype", subtype)) if value}
    refs = "".join(f'<nd ref="{ref}"/>' for ref in nodes)
    return f'<way id="{key}">{refs}{tags({**named, **more})}</way>'


def lanelet(key: int, left: int, right: int, subtype: str = "road", centre: int | None = None) -> str:
    members = [(left, "left"), (right, "right"), *([(centre, "centerline")] if centre else [])]
    return relation(key, [("way", ref, role) for ref, role in members], type="lanelet", subtype=subtype)


def relation(key: int, members: Sequence[tuple[str, int, str]], **more: str) -> str:
    inside = "".join(f'<member type="{kind}" ref="{ref}" role="{role}"/>' for kind, ref, role in members)
    return f'<relation id="{key}">{inside}{tags(more)}</relation>'


def osm(path: Path, *elements: str) -> Path:
    path.write_text('<?xml version="1.0"?>\n<osm>\n' + "\n".join(elements) + "\n</osm>\n")
    return path
