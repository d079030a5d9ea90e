"""Small OpenDRIVE files, written by the tests."""

from pathlib import Path

from sensors.maps import opendrive
from sensors.maps.vector_map import Kind, VectorMap
from sensors.records import LeftOut

LINE = '<geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry>'
ARC = '<geometry s="0" x="0" y="0" hdg="0" length="100"><arc curvature="0.02"/></geometry>'
WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
RIGHT = f'<right><lane id="-1" type="driving">{WIDTH}<roadMark sOffset="0" type="solid" color="white"/></lane></right>'


def road(
    lanes: str, geometry: str = LINE, more: str = "", attributes: str = 'id="1" junction="-1" length="100"'
) -> str:
    """A road; lanes: what is in <lanes>; more: what stands beside it."""
    return f"<road {attributes}><planView>\n{geometry}\n</planView>{more}<lanes>{lanes}</lanes></road>"


def section(sides: str, start: float = 0.0) -> str:
    """A lane section of these sides."""
    return f'<laneSection s="{start}">{sides}</laneSection>'


def written(folder: Path, *roads: str, header: str = "") -> Path:
    """A file of these roads."""
    path = folder / "map.xodr"
    path.write_text(f"<OpenDRIVE>\n<header>{header}</header>\n" + "\n".join(roads) + "\n</OpenDRIVE>")
    return path


def imported(folder: Path, *roads: str, header: str = "") -> tuple[VectorMap, dict[str, int]]:
    """The map of these roads, and what was left out."""
    vector_map, left_out = opendrive.read(written(folder, *roads, header=header))
    return vector_map, counts(left_out)


def counts(left_out: tuple[LeftOut, ...]) -> dict[str, int]:
    """Reasons and how often."""
    return {row.reason: row.count for row in left_out}


def only(vector_map: VectorMap, kind: Kind) -> VectorMap:
    """The map's elements of one kind."""
    return VectorMap(vector_map.frame, vector_map.elements.chosen(vector_map.elements.kind == kind), sources=("test",))
