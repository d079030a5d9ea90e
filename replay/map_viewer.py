"""A map as a rerun recording: elements by kind, surfels by their normals, the route by what is predicted along it."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import colormaps
from numpy.typing import NDArray

from replay.blueprint import FIELD_OF_VIEW, NARROWEST, grid_spacing
from replay.map_drawing import by_kind, pieces, shown
from replay.map_info import SCALE, UNITS
from replay.map_picture import COLOURS, DECADE, TITLES
from replay.viewer import WRITING_S
from sensors.errors import EgolocError
from sensors.maps.localizability import AXES, Localizability
from sensors.maps.map_file import MapFile
from sensors.maps.route import Route
from sensors.maps.vector_map import Elements, Kind, Surfels
from sensors.whole_file import whole_file

if TYPE_CHECKING:
    from replay.map_info import Info

Floats = NDArray[np.float64]

COLOURS_OF: dict[Kind, tuple[int, int, int]] = {
    Kind.LANE_LINE: (200, 205, 210),
    Kind.ROAD_BOUNDARY: (120, 128, 138),
    Kind.STOP_LINE: (225, 95, 205),
    Kind.CROSSING: (150, 125, 245),
    Kind.MARKING: (200, 210, 110),
    Kind.POLE: (245, 245, 245),
    Kind.SIGN: (70, 215, 170),
}
ROUTE_ABOVE = 1 / 400
"""The route is drawn so far above the ground near it, as a share of the map's size: nothing hides it from above, and
it does not look shifted."""
LIGHTER = 0.36
"""Half of the colours' scale that is used: its ends are too dark before a dark ground."""


def write_map_recording(opened: MapFile, route: Route, found: Localizability, info: "Info", path: Path) -> None:
    """Write the recording, whole or not at all. Coordinates are from the middle of the map; heights from its ground.

    Of a map that is too large for its elements to be seen the route alone is written.
    """
    if not len(opened.boxes):
        raise EgolocError(f"{path}: cannot be drawn: {opened.path} is empty")
    low, high = opened.boxes[:, :2].min(axis=0), opened.boxes[:, 2:].max(axis=0)
    with whole_file(path, RuntimeError) as partial:  # rerun's own, where the disk is full
        partial.touch()  # rerun's own message would not be an OSError
        recording = rr.RecordingStream("egoloc_map")
        recording.save(partial, default_blueprint=_blueprint(high - low, route))
        recording.send_recording_name(Path(info["map"]).name)
        _draw(recording, opened, route, found, info, (low + high) / 2.0)
        recording.flush(timeout_sec=WRITING_S)
        recording.disconnect()


def _draw(
    recording: rr.RecordingStream, opened: MapFile, route: Route, found: Localizability, info: "Info", centre: Floats
) -> None:
    recording.send_property("map_centre", rr.AnyValues(x_m=centre[0], y_m=centre[1]))
    recording.log("summary", rr.TextDocument(_summary(info), media_type=rr.MediaType.MARKDOWN), static=True)
    route_z = np.zeros(len(route))
    whole = shown(opened)
    if whole is not None:
        heights = np.concatenate((whole.elements.xyz[:, 2], whole.surfels.z))
        ground = float(np.nanmedian(heights)) if np.isfinite(heights).any() else 0.0
        origin = np.array([*centre, ground])
        for kind, part in by_kind(whole.elements):
            _shapes(recording, kind, part, origin)
        if len(whole.surfels):
            recording.log("map/surfel", _surfels(whole.surfels, origin), static=True)
        route_z = _heights(route, whole.elements, ground)
    if len(route):
        for axis in AXES:
            recording.log(f"predicted/{axis}", _route(route, found, info, axis, centre, route_z), static=True)


def _shapes(recording: rr.RecordingStream, kind: Kind, part: Elements, origin: Floats) -> None:
    """Strips, and points where an element is but one vertex."""
    path, colour = f"map/{kind.name.lower()}", COLOURS_OF[kind]
    single = np.diff(part.first) == 1
    width = 1.4 if kind in (Kind.STOP_LINE, Kind.CROSSING, Kind.POLE, Kind.SIGN) else 0.8
    if single.any():
        places = _lifted(part.chosen(single).xyz) - origin
        points = rr.Points3D(places, colors=[colour], radii=rr.Radius.ui_points(2.5))
        recording.log(f"{path}/places", points, static=True)
    if not single.all():
        lines = part.chosen(~single)
        strips = np.split(_lifted(lines.xyz) - origin, lines.first[1:-1])
        drawn = rr.LineStrips3D(strips, colors=[colour], radii=rr.Radius.ui_points(width))
        recording.log(f"{path}/lines", drawn, static=True)


def _lifted(xyz: Floats) -> Floats:
    """Heights that are not known are those that are usual."""
    known = np.isfinite(xyz[:, 2])
    usual = float(np.median(xyz[known, 2])) if known.any() else 0.0
    return np.column_stack((xyz[:, :2], np.where(known, xyz[:, 2], usual)))


def _surfels(surfels: Surfels, origin: Floats) -> Any:
    """Coloured by the direction that they face: hue of the azimuth, the paler the more level."""
    xyz = _lifted(np.column_stack((surfels.p, surfels.z))) - origin
    azimuth = np.arctan2(surfels.normal[:, 1], surfels.normal[:, 0]) % np.pi / np.pi
    upright = np.hypot(*surfels.normal[:, :2].T)[:, None]
    hue = colormaps["hsv"](azimuth)[:, :3]
    colours = (120.0 * (upright * hue + (1.0 - upright) * 0.35)).astype(np.uint8)
    return rr.Points3D(xyz, colors=colours, radii=rr.Radius.ui_points(1.2))


def _heights(route: Route, elements: Elements, ground: float) -> Floats:
    """(N,) height of the map's lines nearest to each pose, from the ground; 0 where none is known."""
    from scipy.spatial import cKDTree

    known = elements.xyz[
        np.isfinite(elements.xyz[:, 2])
        & ~np.isin(np.repeat(elements.kind, np.diff(elements.first)), (Kind.POLE, Kind.SIGN))
    ]
    if not len(known) or not len(route):
        return np.zeros(len(route))
    nearest: Floats = known[cKDTree(known[:, :2]).query(route.xy)[1], 2] - ground
    return nearest


def _route(route: Route, found: Localizability, info: "Info", axis: str, centre: Floats, z: Floats) -> Any:
    """Pieces from pose to pose in the picture's colours."""
    column = AXES.index(axis)
    sigma = found.sigma[:, column] * SCALE[column]
    beyond = info["localizability"]["degenerate_beyond"][UNITS[axis]]
    level = 0.5 + LIGHTER * np.clip(np.log(sigma / beyond) / math.log(DECADE), -1.0, 1.0)
    colours = (255.0 * colormaps[COLOURS](level)[:, :3]).astype(np.uint8)
    xy = pieces(route) - centre
    above = ROUTE_ABOVE * float(np.ptp(route.xy, axis=0).max())
    strips = np.concatenate((xy, np.repeat(z + above, 2).reshape(-1, 2, 1)), axis=2)
    return rr.LineStrips3D(strips, colors=colours, radii=rr.Radius.ui_points(2.5))


def _summary(info: "Info") -> str:
    """What stands beside the map."""
    km = f"{info['km']:,.2f} km of road" if info["km"] else "length of road unknown"
    lines = [
        f"# {Path(info['map']).name}",
        f"{km}, {info['bytes'] / 1e6:,.2f} MB",
        "",
        "| kind | elements |",
        "|---|---|",
    ]
    lines += [f"| {kind.replace('_', ' ')} | {count:,} |" for kind, count in info["elements"].items() if count]
    found = info["localizability"]
    if found is None:
        return "\n".join([*lines, "", "No line to judge it along."])
    lines += ["", "| predicted sigma | median | 95 % | degenerate |", "|---|---|---|---|"]
    for axis, title in TITLES.items():
        unit = UNITS[axis]
        sigma = found["sigma"][unit]
        share = 100.0 * found["degenerate"][axis]
        lines.append(f"| {title} | {sigma['p50']:.3f} | {sigma['p95']:.3f} | {share:.1f} % |")
    marks = ", ".join(f"{found['degenerate_beyond'][UNITS[axis]]:.2g} {UNITS[axis].partition('_')[2]}" for axis in AXES)
    return "\n".join([*lines, "", f"Yellow is just degenerate ({marks}), red is worse, blue is fine."])


def _blueprint(extent: Floats, route: Route) -> rrb.Blueprint:
    """The map from above, coloured by each axis in turn, and what it holds."""
    width, depth = extent.tolist()
    height = 0.5 * max(width / NARROWEST, depth, 10.0) / math.tan(FIELD_OF_VIEW / 2) * 1.1
    spacing = grid_spacing(max(width, depth))
    views = [
        rrb.Spatial3DView(
            origin="/",
            contents=["/map/**", f"/predicted/{axis}"],
            name=f"{TITLES[axis].partition(',')[0]}, grid {spacing:g} m",
            background=(13, 16, 17),
            line_grid=rrb.LineGrid3D(visible=True, spacing=spacing, color=(255, 255, 255, 25)),
            # straight above, the direction of view and its up axis would be undefined
            eye_controls=rrb.EyeControls3D(
                position=(0.0, 0.0, height), look_target=(0.0, 1e-5 * height, 0.0), eye_up=(0.0, 1.0, 0.0)
            ),
        )
        for axis in (AXES if len(route) else AXES[:1])
    ]
    text = rrb.TextDocumentView(origin="/summary", name="Map")
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*views, active_tab=0), text, column_shares=[3, 1]), collapse_panels=True
    )
