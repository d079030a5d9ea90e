"""Matches as a rerun recording along time: the points with the map before and after, what each level of the network
made of them, and what came out.

What is seen from above in 2-D is drawn in cells of its level: rerun's 2-D views know no other scale.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from matplotlib import colormaps
from numpy.typing import NDArray

from egovm.batch import SURFEL
from egovm.projection import plane_height
from replay.match_blueprint import AXES, SERIES, TIMELINE, along_time, blueprint
from replay.match_drawing import (
    AGAINST,
    COLOURS,
    FOR,
    NEUTRAL,
    Pictured,
    ends_at,
    estimated_offset,
    offset_of,
    points_of,
    rgb,
    title,
)
from replay.match_images import on_image
from replay.match_levels import (
    Basis,
    Histogram,
    basis_of,
    coloured,
    ellipse,
    heights_shaded,
    histograms,
    planes_of,
    semantic_colours,
    shares,
)
from replay.viewer import WRITING_S
from sensors.images import RAW, Image
from sensors.maps.vector_map import Kind
from sensors.whole_file import whole_file

Floats = NDArray[np.float64]

BASIS_FRAMES = 8
"""Principal components are taken of so many frames, evenly along the recording, and serve for all."""
CLEARED = ("body", "bev", "histogram", "cameras")
"""Nothing of the frame before is left there where a frame has none."""
DASH = 0.2
"""Of a piece's length, what is drawn over a semantic map."""
SERIES_COLOURS = ((86, 180, 233), (230, 159, 0), (204, 121, 167))
"""Of the axes, and of the levels."""
_KINDS = {"jpeg": "image/jpeg", "png": "image/png"}


def write_matches(matches: Sequence[Pictured], path: Path) -> None:
    """Write the recording, whole or not at all."""
    with whole_file(path, RuntimeError) as partial:  # rerun's own, where the disk is full
        partial.touch()  # rerun's own message would not be an OSError
        recording = rr.RecordingStream("egoloc_matches")
        recording.save(partial, default_blueprint=blueprint(matches))
        recording.log("body", rr.ViewCoordinates.FLU, static=True)
        _series(recording)
        bases = _bases(matches)
        for each in matches:
            recording.set_time(TIMELINE, timestamp=np.datetime64(each.match.t_ns, "ns"))
            _draw(recording, each, bases)
        recording.flush(timeout_sec=WRITING_S)
        recording.disconnect()


def _series(recording: rr.RecordingStream) -> None:
    """Points, for a recording of one frame has no lines."""
    for name in (*SERIES, "landmarks"):
        for number, colour in enumerate(SERIES_COLOURS):
            entity, label = (number, f"level {number}") if name == "landmarks" else (AXES[number], AXES[number])
            points = rr.SeriesPoints(colors=colour, names=label, marker_sizes=3.0)
            recording.log(f"{name}/{entity}", points, static=True)


def _bases(matches: Sequence[Pictured]) -> list[Basis]:
    """Of each level, the same for all frames."""
    seen = [each.match for each in matches if each.match.output is not None]
    chosen = seen[:: -(-len(seen) // BASIS_FRAMES)] if seen else []
    return [basis_of(planes) for planes in zip(*map(planes_of, chosen), strict=True)]


def _draw(recording: rr.RecordingStream, pictured: Pictured, bases: Sequence[Basis]) -> None:
    for entity in CLEARED:
        recording.log(entity, rr.Clear(recursive=True))
    after = estimated_offset(pictured.match)
    _points(recording, pictured)
    _pieces(recording, pictured, np.zeros(3), "before")
    _pieces(recording, pictured, after, "after")
    _score(recording, pictured, after)
    for level, (plane, basis) in enumerate(zip(planes_of(pictured.match), bases, strict=False)):
        recording.log(f"bev/features/{level}", _from_above(coloured(plane, basis)))
    logits = () if pictured.match.output is None else pictured.match.output.logits
    for level, each in enumerate(logits):
        recording.log(f"bev/semantics/{level}", _from_above(semantic_colours(each[0])[0]))
        recording.log(f"bev/map/{level}", _over_cells(pictured, after, each.shape[-1]))
    for level, found in enumerate(histograms(pictured.match)):
        _histogram(recording, pictured, level, found)
    _images(recording, pictured, after)
    _figures(recording, pictured)


def _points(recording: rr.RecordingStream, pictured: Pictured) -> None:
    points = points_of(pictured.match)
    if points is not None:
        height = points[:, 2] - plane_height(pictured.bev, pictured.bev.ground_m)
        shades = (255.0 * heights_shaded(height)[:, :3]).astype(np.uint8)
        drawn = rr.Points3D(points[:, :3], colors=shades, radii=rr.Radius.ui_points(1.2))
        recording.log("body/points", drawn)


def _pieces(recording: rr.RecordingStream, pictured: Pictured, offset: Floats, name: str) -> None:
    """Segments and poles as strips in the colours of their kinds, signs and surfels as points."""
    pieces = pictured.match.pieces
    colours = np.array([rgb(COLOURS[kind]) for kind in pieces.type.tolist()], np.uint8).reshape(-1, 3)
    _shapes(recording, pictured, offset, colours, f"body/map/{name}")


def _score(recording: rr.RecordingStream, pictured: Pictured, offset: Floats) -> None:
    """The same by what they add to the last level's score."""
    found = shares(pictured.match)
    if not found:
        return
    share = found[-1].percent
    part = (np.nan_to_num(share) / found[-1].most).clip(-1.0, 1.0)[:, None]
    end = np.where(part < 0.0, rgb(AGAINST), rgb(FOR))
    colours = ((1.0 - np.abs(part)) * rgb(NEUTRAL) + np.abs(part) * end).astype(np.uint8)
    _shapes(recording, pictured, offset, colours, "body/score")


def _shapes(
    recording: rr.RecordingStream, pictured: Pictured, offset: Floats, colours: NDArray[np.uint8], entity: str
) -> None:
    pieces = pictured.match.pieces
    ends = ends_at(pieces, offset)
    ends[..., 2] += plane_height(pictured.bev, pictured.bev.ground_m)
    pole = pieces.type == Kind.POLE
    ends[pole, 1, 2] += pieces.height[pole]
    single = (ends[:, 0] == ends[:, 1]).all(axis=1)
    sizes = np.where(pieces.type == SURFEL, 1.5, 4.0)
    strips = rr.LineStrips3D(ends[~single], colors=colours[~single], radii=rr.Radius.ui_points(1.6))
    recording.log(f"{entity}/lines", strips)
    places = rr.Points3D(ends[single, 0], colors=colours[single], radii=rr.Radius.ui_points(sizes[single]))
    recording.log(f"{entity}/places", places)


def _from_above(colours: NDArray[np.uint8]) -> Any:
    """(H, W, 3) whose rows rise with x, columns with y, as an image: forward is up, left is left."""
    return rr.Image(np.ascontiguousarray(colours[::-1, ::-1]))


def _over_cells(pictured: Pictured, offset: Floats, cells: int) -> Any:
    """The map in pixels of such an image of so many cells, dashed: of each piece only the middle is drawn, for it
    would cover what it is compared with."""
    ends = ends_at(pictured.match.pieces, offset)[:, :, 1::-1]
    ends = ends.mean(axis=1, keepdims=True) + DASH * (ends - ends.mean(axis=1, keepdims=True))
    pixels = cells / 2.0 * (1.0 - ends / pictured.bev.half_m)
    return rr.LineStrips2D(pixels, colors=[(255, 255, 255)], radii=rr.Radius.ui_points(0.5))


def _histogram(recording: rr.RecordingStream, pictured: Pictured, level: int, found: Histogram) -> None:
    """The mass over x and y as an image, poses over it, and that over yaw as bars."""
    match, entity = pictured.match, f"histogram/{level}"
    colours = colormaps["magma"](found.xy / max(float(found.xy.max()), 1e-30))[..., :3]
    recording.log(f"{entity}/mass", _from_above((255.0 * colours).astype(np.uint8)))
    poses = {"initial": (np.zeros(3), (184, 190, 198))}
    if match.found:
        poses["mean"] = found.mean, (86, 180, 233)
        poses["estimate"] = estimated_offset(match), (255, 255, 255)
        outline = rr.LineStrips2D([_pixels(found, ellipse(found))], colors=[(86, 180, 233)])
        recording.log(f"{entity}/ellipse", outline)
    if pictured.truth is not None:
        poses["truth"] = offset_of(match, pictured.truth), (0, 214, 154)
    if level == 0:
        modes = [offset_of(match, mode) for mode in match.modes[match.weights > 0.0]]
        poses |= {f"mode {number + 1}": (mode, (230, 159, 0)) for number, mode in enumerate(modes)}
    for name, (pose, colour) in poses.items():
        place = _pixels(found, pose[None, :2])
        mark = rr.Points2D(place, colors=[colour], radii=rr.Radius.ui_points(4.0), labels=[name], show_labels=False)
        recording.log(f"{entity}/poses/{name.replace(' ', '_')}", mark)
    yaw = np.degrees(found.yaw)
    widths = np.full(len(yaw), yaw[1] - yaw[0])
    bars = rr.BarChart(found.yaw_mass, abscissa=yaw, widths=widths, color=(150, 85, 170))
    recording.log(f"{entity}/yaw", bars)


def _pixels(found: Histogram, xy: Floats) -> Floats:
    """(N, 2) column and row of offsets (N, 2) forward and left in the image of a histogram."""
    step = found.forward[1] - found.forward[0]
    last = np.array((found.left[-1], found.forward[-1])) + step / 2.0
    pixels: Floats = (last - xy[:, ::-1]) / step
    return pixels


def _images(recording: rr.RecordingStream, pictured: Pictured, after: Floats) -> None:
    """As they were recorded, the map in them before and after."""
    for image in () if pictured.frame is None else pictured.frame.images:
        recording.log(f"cameras/{image.name}/image", _picture(image))
        for name, offset in (("before", np.zeros(3)), ("after", after)):
            strokes = on_image(pictured, image, offset)
            kinds = pictured.match.pieces.type[strokes.piece].tolist()
            colours = np.array([rgb(COLOURS[kind]) for kind in kinds], np.uint8).reshape(-1, 3)
            lines = rr.LineStrips2D(strokes.pixels, colors=colours, radii=rr.Radius.ui_points(1.2))
            recording.log(f"cameras/{image.name}/{name}", lines)


def _picture(image: Image) -> Any:
    if image.format in RAW:
        return rr.Image(image.rgb()).compress(jpeg_quality=90)
    return rr.EncodedImage(contents=image.data, media_type=_KINDS[image.format])


def _figures(recording: rr.RecordingStream, pictured: Pictured) -> None:
    """What came out, in m and deg; nothing where nothing did."""
    match = pictured.match
    recording.log("summary", rr.TextDocument("\n\n".join(title(pictured)), media_type=rr.MediaType.MARKDOWN))
    recording.log("time/ms", rr.Scalars(1e3 * match.seconds))
    for level, count in enumerate(match.landmarks.tolist()):
        recording.log(f"landmarks/{level}", rr.Scalars(count))
    if not match.found:
        return
    for name, row in along_time(pictured).items():
        for axis, value in zip(AXES, row, strict=True):
            recording.log(f"{name}/{axis}", rr.Scalars(value))
