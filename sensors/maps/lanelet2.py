"""Lanelet2 maps (``.osm``), also as Autoware writes them: ways are lines and faces, lanelets say what they bound.

Read with a hardened reader of our own, not with the package ``lanelet2`` (1.2.3): that one wants the map's place before
it reads, and returns no node at all of an Autoware file with empty lat and lon.

Coordinates: lat and lon where they are real, because the file does not say what local_x and local_y are measured from
(an MGRS square, a transverse Mercator, a tangent plane). They are real where no node lacks them and where, if there
are local coordinates too, both show the same shape; else Autoware lets them "be anything", and the map is a local plane
without georeference (``placing.LOCAL``). ``ele`` is taken for the ellipsoidal height; where it is missing so is z.
"""

from pathlib import Path

import numpy as np

from sensors.errors import EgolocError
from sensors.geodesy import Floats, MapFrame
from sensors.maps.builder import Builder
from sensors.maps.lanelet2_shapes import face, pole
from sensors.maps.lanelet2_tags import (
    DASH_ENDS,
    DRIVING,
    FACES,
    LINES,
    NO_ELEMENT,
    OF_CROSSING,
    colour_of,
    style_of,
)
from sensors.maps.osm import Nodes, Osm, Relation, Way, read_osm
from sensors.maps.placing import LOCAL, placed, refuse_far, refuse_frame
from sensors.maps.rings import closed, ring_of_sides
from sensors.maps.road_length import polyline_m, road_km
from sensors.maps.vector_map import Colour, Kind, Style, VectorMap
from sensors.records import LeftOut

SAME_SHAPE_M = 1.0
"""Between lat and lon and local coordinates, after shift, turn and scale. Written by one program they agree to 1 um."""
MAX_HEIGHT_M = 1000.0
"""Of a pole or a face."""
MAX_SCALE = 0.01
"""Between them; that of a projection is 0.0004 to 0.001."""


def read(path: Path, frame: MapFrame | None = None) -> tuple[VectorMap, tuple[LeftOut, ...]]:
    """The map of a file, and what of it is not in the map.

    Raises EgolocError for a damaged file, one without any element of Lanelet2, and a frame that is not its place's.
    """
    osm = read_osm(path)
    if not any("type" in way.tags for way in osm.ways.values()):
        raise EgolocError(f"{path}: expected ways with a Lanelet2 type (line_thin, road_border, ...), got none")
    builder = Builder(f"{path.name} (Lanelet2)")
    frame, xyz = _coordinates(path, osm, frame, builder)
    importer = _Importer(path, osm, xyz, builder)
    importer.take_all()
    return builder.built(frame, road_km=importer.road_km()), builder.left_out


def _coordinates(path: Path, osm: Osm, frame: MapFrame | None, builder: Builder) -> tuple[MapFrame, Floats]:
    """The frame, and (N, 3) coordinates of all nodes in it; NaN for nodes that nothing uses and that have none."""
    nodes = osm.nodes
    rows = _used(osm)
    real, local = (np.isfinite(pair[rows]).all(axis=1) for pair in (nodes.lat_lon, nodes.local))
    if not (real.all() or local.all()):
        row = rows[int(np.argmin(real if real.sum() >= local.sum() else local))]
        name = next(key for key, value in nodes.row.items() if value == row)
        raise EgolocError(f"{path}: node {name}: expected lat and lon, or local_x and local_y, as its neighbours have")
    refuse_far(str(path), np.column_stack((nodes.local[rows], nodes.height[rows])))
    xyz = np.full((len(nodes.tags), 3), np.nan)
    if real.all() and not (local.all() and not _same_shape(nodes, rows)):
        llh = np.column_stack((np.radians(nodes.lat_lon[rows]), nodes.height[rows]))
        frame, xyz[rows] = placed(str(path), llh, frame)
        return frame, xyz
    refuse_frame(str(path), frame)
    if real.any():
        builder.leave_out("latitudes and longitudes that do not fit local_x and local_y", int(real.sum()))
    xyz[rows] = np.column_stack((nodes.local[rows], nodes.height[rows]))
    return LOCAL, xyz


def _used(osm: Osm) -> list[int]:
    """Rows of the nodes that elements can come from."""
    in_ways = {row for way in osm.ways.values() for row in way.nodes}
    return sorted(in_ways | {row for row, tags in enumerate(osm.nodes.tags) if tags.get("type") == "pole"})


def _same_shape(nodes: Nodes, rows: list[int]) -> bool:
    """Whether lat, lon and local coordinates differ by a shift, a small scale and a turn."""
    llh = np.column_stack((np.radians(nodes.lat_lon[rows]), np.zeros(len(rows))))
    try:
        earth = placed("", llh, None)[1][:, :2] @ (1, 1j)
    except EgolocError:  # they are no place of a map
        return False
    local = nodes.local[rows] @ (1, 1j)
    earth, local = earth - earth.mean(), local - local.mean()
    turn = np.vdot(local, earth) / max(np.vdot(local, local).real, 1e-9)
    return bool(abs(abs(turn) - 1.0) < MAX_SCALE and np.abs(earth - turn * local).max() < SAME_SHAPE_M)


class _Importer:
    """One file's elements on their way into a builder."""

    def __init__(self, path: Path, osm: Osm, xyz: Floats, builder: Builder) -> None:
        self.path, self.osm, self.xyz, self.builder = path, osm, xyz, builder
        lanelets = [relation for relation in osm.relations.values() if relation.tags.get("type") == "lanelet"]
        self.sides_of = {lane.id: _sides(path, lane) for lane in lanelets}
        self.crosswalks = [lane.id for lane in lanelets if lane.tags.get("subtype") == "crosswalk"]
        self.driving = [lane.id for lane in lanelets if lane.tags.get("subtype", "") in DRIVING]
        self.sides = {ref for lane in self.crosswalks for ref in self.sides_of[lane]}
        others = self.sides_of.keys() - set(self.crosswalks)
        self.bounds = {ref for lane in others for ref in self.sides_of[lane]}
        self.centres = {ref for lane in lanelets for ref in lane.refs("way", "centerline")}

    def take_all(self) -> None:
        """Add every element, and count what is none."""
        if self.osm.deleted:
            self.builder.leave_out("what an editor marked as deleted, or file data", self.osm.deleted)
        for way in self.osm.ways.values():
            self._way(way)
        self._crossings()
        self._poles_of_nodes()
        for relation in self.osm.relations.values():
            what, subtype = relation.tags.get("type", ""), relation.tags.get("subtype", "")
            if what != "lanelet":
                self.builder.leave_out(f"{what or 'relation'} {subtype}: a rule or an area, its lines are ways")

    def road_km(self) -> float:
        """Of driving lanelets, each as long as the mean of its bounds; those side by side are one road."""
        keys = [self.sides_of[lane] for lane in self.driving]
        length = {ref: polyline_m(self._line(self.osm.ways[ref])) for pair in keys for ref in pair}
        return road_km([0.5 * (length[left] + length[right]) for left, right in keys], keys)

    def _line(self, way: Way) -> Floats:
        return self.xyz[list(way.nodes)]

    def _way(self, way: Way) -> None:
        what, name = way.tags.get("type", ""), f"way {way.id}"
        if reason := self._reason(way, what):
            self.builder.leave_out(reason)
        elif what in FACES:
            xyz = face(self._line(way), self._height(way))
            self.builder.add(Kind.SIGN, xyz, FACES[what], name=name)
        elif what == "pole":
            self.builder.add(Kind.POLE, pole(self._line(way), self._height(way)), name=name)
        elif not (way.id in self.sides and way.id not in self.bounds and what in OF_CROSSING):
            self._add_line(way, what, name)

    def _reason(self, way: Way, what: str) -> str:
        """Why a way is no element; nothing where it is one."""
        bounds = way.id in self.bounds or way.id in self.sides
        if way.id in self.centres and not bounds:
            return "centre lines of lanelets: nothing painted"
        if what in NO_ELEMENT:
            return NO_ELEMENT[what]
        if not what and not bounds:
            return "ways without a type that bound no lanelet"
        if what and what not in LINES and what not in FACES and what != "pole":
            return f"ways of type {what}: not a known type of a thing that is seen"
        if not way.nodes or (len(way.nodes) < 2 and (what in LINES or not what)):
            return "lines of fewer than two nodes"
        return ""

    def _add_line(self, way: Way, what: str, name: str) -> None:
        kind, usual = LINES.get(what, (Kind.LANE_LINE, Style.UNKNOWN))
        xyz, style, colour = self._line(way), style_of(way.tags, usual), colour_of(way.tags)
        if way.tags.get("area") == "yes" or kind is Kind.CROSSING:
            xyz = closed(xyz)
        if what == "pedestrian_marking" and way.nodes[0] == way.nodes[-1]:
            style = Style.ZEBRA  # a stripe's outline
        if style is None:
            self.builder.leave_out(
                f"subtypes {way.tags['subtype']} of {what}: not known, the line is taken without style"
            )
        if colour is None:
            self.builder.leave_out("colours that are not known: the line is taken without")
        self.builder.add(kind, xyz, style or Style.UNKNOWN, colour or Colour.UNKNOWN, name)

    def _height(self, way: Way) -> float:
        """How high a face or pole is, m; NaN where that is not said."""
        try:
            height = float(way.tags.get("height", "nan"))
        except ValueError:
            height = -1.0
        if height < 0 or height > MAX_HEIGHT_M:
            raise EgolocError(f"{self.path}: way {way.id}: height: expected metres, got {way.tags['height']!r}")
        return height

    def _crossings(self) -> None:
        """Outlines of crosswalk lanelets, where no crosswalk_polygon says it better."""
        rules = [rule for rule in self.osm.relations.values() if rule.refs("way", "crosswalk_polygon")]
        better = {ref for rule in rules for ref in rule.refs("relation", "refers")}
        for lane in self.crosswalks:
            if lane in better:
                self.builder.leave_out("crosswalk lanelets: their crosswalk_polygon is taken")
                continue
            left, right = (self.osm.ways[ref] for ref in self.sides_of[lane])
            zebra = "zebra_marking" in (left.tags.get("type"), right.tags.get("type"))
            xyz = ring_of_sides(self._line(left), self._line(right))
            self.builder.add(Kind.CROSSING, xyz, Style.ZEBRA if zebra else Style.UNKNOWN, name=f"lanelet {lane}")

    def _poles_of_nodes(self) -> None:
        """Nodes that are poles, but posts of guard rails and fences; other types of nodes are counted."""
        in_ways = {row for way in self.osm.ways.values() for row in way.nodes}
        for key, row in self.osm.nodes.row.items():
            what = self.osm.nodes.tags[row].get("type", "")
            if what == "pole" and row not in in_ways:
                self.builder.add(Kind.POLE, self.xyz[[row]], name=f"node {key}")
            elif what == "pole":
                self.builder.leave_out("posts of a barrier: parts of its line")
            elif what in DASH_ENDS:
                self.builder.leave_out("ends of single dashes: the line is taken whole")
            elif what:
                self.builder.leave_out(f"nodes of type {what}: not a known type of a thing that is seen")


def _sides(path: Path, lane: Relation) -> tuple[str, str]:
    """Ids of the ways left and right of a lanelet."""
    sides = lane.refs("way", "left"), lane.refs("way", "right")
    if [len(side) for side in sides] != [1, 1]:
        got = f"{len(sides[0])} left and {len(sides[1])} right"
        raise EgolocError(f"{path}: lanelet {lane.id}: expected one way on its left and one on its right, got {got}")
    return sides[0][0], sides[1][0]
