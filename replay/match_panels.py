"""The panels of a match's picture: forward is up, left is left, and every place is drawn to scale."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from egovm.batch import SURFEL
from egovm.projection import plane_height
from replay.match_drawing import (
    AGAINST,
    CLOSE_M,
    COLOURS,
    FOR,
    NEUTRAL,
    Pictured,
    ends_at,
    estimated_offset,
    offset_of,
    points_of,
)
from replay.match_images import on_image
from replay.match_levels import (
    ABOVE_M,
    HEIGHTS,
    SIGMAS,
    Histogram,
    basis_of,
    coloured,
    ellipse,
    heights_shaded,
    planes_of,
    semantic_colours,
    shares,
)
from sensors.images import Image
from sensors.maps.vector_map import Kind

Floats = NDArray[np.float64]

GROUND = "#101418"
"""Behind everything that is seen from above."""
MASS = "magma"
STRENGTH = LinearSegmentedColormap.from_list("strength", (AGAINST, NEUTRAL, FOR))
OUTLINED = [withStroke(linewidth=2.0, foreground="black")]
STANDING: Mapping[int, tuple[str, float]] = {Kind.POLE: ("o", 16.0), Kind.SIGN: ("s", 20.0), SURFEL: ("o", 3.0)}
"""Symbol and area, in square points, of what is no line."""
VEHICLE = np.array([(1.9, 0.0), (-1.4, 0.95), (-0.8, 0.0), (-1.4, -0.95)])
"""An arrow about as long as a car."""


class Mark(NamedTuple):
    """How a pose is marked."""

    symbol: str
    colour: str
    size: float
    label: str

    def in_legend(self) -> Line2D:
        return Line2D([], [], ls="", label=self.label, **self.look())

    def look(self) -> dict[str, Any]:
        """For plot."""
        hollow = {"mfc": "none"} if self.symbol in "osD" else {}
        return {"marker": self.symbol, "color": self.colour, "ms": self.size, "mew": 1.6, **hollow}


START = Mark("o", "#b8bec6", 7.0, "initial pose")
MEAN = Mark("+", "#56b4e9", 11.0, f"mean of the level, {SIGMAS:g} sigma")
ESTIMATE = Mark("x", "#ffffff", 8.0, "estimate")
MODE = Mark("D", "#e69f00", 9.0, "mode of the first level, its mass")
TRUTH = Mark("s", "#00d69a", 9.0, "truth")


def points_panel(figure: Any, place: Any, pictured: Pictured) -> None:
    """All points that the network saw, coloured by their heights."""
    half = _half_m(pictured)
    points = points_of(pictured.match)
    count = "no points" if points is None or not len(points) else f"{len(points):,} points"
    axes = _from_above(figure, place, half, count)
    if points is None or not len(points):
        return
    height = points[:, 2] - plane_height(pictured.bev, pictured.bev.ground_m)
    order = np.argsort(height, kind="stable")
    scale = ScalarMappable(Normalize(*ABOVE_M), HEIGHTS)
    axes.scatter(points[order, 1], points[order, 0], c=heights_shaded(height[order]), s=1.0, linewidths=0)
    _bar(axes, scale, [0, 1, 2, 3, 4], "m above the ground")
    _box(axes, min(CLOSE_M, half))


def map_panel(figure: Any, place: Any, pictured: Pictured, offset: Floats, title: str) -> None:
    """Pieces of map at an offset over the points near the vehicle, paint bright."""
    match = pictured.match
    half = min(CLOSE_M, _half_m(pictured))
    axes = _from_above(figure, place, half, title)
    _backdrop(axes, pictured, half)
    ends = ends_at(match.pieces, offset)
    for kind, colour in COLOURS.items():
        _pieces(axes, ends, np.flatnonzero(match.pieces.type == kind), kind, colour)


def feature_panel(figure: Any, place: Any, pictured: Pictured, level: int) -> None:
    """The principal components of a level's features as red, green and blue."""
    plane = planes_of(pictured.match)[level]
    channels, cells, _ = plane.shape
    half = _half_m(pictured)
    axes = _from_above(figure, place, half, f"Features {level}: {channels} of {cells} x {cells} cells")
    _plane(axes, coloured(plane, basis_of([plane])), half, half)


def semantic_panel(figure: Any, place: Any, pictured: Pictured, level: int) -> None:
    """What the network takes each cell for near the vehicle; dotted, the map at the estimated pose."""
    assert pictured.match.output is not None
    colours, brightest = semantic_colours(pictured.match.output.logits[level][0])
    near = min(CLOSE_M, _half_m(pictured))
    axes = _from_above(figure, place, near, f"Semantic map {level}: brightest is p = {brightest:.2f}")
    _plane(axes, colours, _half_m(pictured), near)
    ends = ends_at(pictured.match.pieces, estimated_offset(pictured.match))[:, :, 1::-1]
    axes.add_collection(LineCollection(list(ends), colors="white", lw=0.7, ls=(0, (1, 4)), zorder=3))


def contribution_panel(figure: Any, place: Any, pictured: Pictured, level: int) -> None:
    """The pieces at the estimated pose, by what the level's score would lose without each, the weightiest on top."""
    match, half = pictured.match, _half_m(pictured)
    axes = _from_above(figure, place, half, f"Share of the score {level}: {match.landmarks[level]} pieces")
    _backdrop(axes, pictured, half, 0.3)
    found = shares(match)[level]
    ends = ends_at(match.pieces, estimated_offset(match))
    scale = ScalarMappable(Normalize(-found.most, found.most), STRENGTH)
    rows = np.argsort(np.abs(found.percent), kind="stable")
    rows = rows[np.isfinite(found.percent[rows])]
    for kind in COLOURS:
        chosen = rows[match.pieces.type[rows] == kind]
        _pieces(axes, ends, chosen, kind, scale.to_rgba(found.percent[chosen]))
    _bar(axes, scale, [-found.most, 0.0, found.most], "% of the score")


def histogram_panels(figure: Any, place: Any, pictured: Pictured, level: int, found: Histogram) -> None:
    """The level's posterior over forward and left, summed over yaw, and the other way round below it."""
    above, below = place.subgridspec(2, 1, height_ratios=[4.0, 1.0])
    _mass_panel(figure.add_subplot(above), pictured, level, found)
    _yaw_panel(figure.add_subplot(below), pictured, found)


def image_panel(axes: Any, pictured: Pictured, image: Image, offset: Floats, title: str) -> None:
    """The map at an offset in an image."""
    axes.imshow(image.rgb(), interpolation="antialiased")
    strokes = on_image(pictured, image, offset)
    colours = [COLOURS[kind] for kind in pictured.match.pieces.type[strokes.piece].tolist()]
    axes.add_collection(LineCollection(list(strokes.pixels), colors=colours, lw=1.6, capstyle="round"))
    axes.set(xlim=(-0.5, image.width - 0.5), ylim=(image.height - 0.5, -0.5))
    axes.set_title(f"{image.name}, {title}", fontsize=10, loc="left")


def _from_above(figure: Any, place: Any, half: float, title: str) -> Any:
    """Axes of a square around the vehicle."""
    axes = figure.add_subplot(place)
    axes.set(xlim=(half, -half), ylim=(-half, half), aspect="equal", facecolor=GROUND)
    axes.set_title(title, fontsize=12, loc="left")
    axes.set_xlabel("left, m", fontsize=10, labelpad=1)
    axes.set_ylabel("forward, m", fontsize=10, labelpad=-2)
    axes.tick_params(labelsize=9, length=2, pad=2)
    axes.add_patch(Polygon(VEHICLE[:, ::-1], fc="white", ec="black", lw=0.6, alpha=0.9, zorder=5))
    return axes


def _half_m(pictured: Pictured) -> float:
    return pictured.bev.half_m


def _plane(axes: Any, colours: NDArray[np.uint8], half: float, shown: float) -> None:
    """A raster whose rows rise with x, columns with y; shown: half of what is seen of it, m."""
    axes.imshow(colours, origin="lower", extent=(-half, half, -half, half), interpolation="antialiased")
    axes.set(xlim=(shown, -shown), ylim=(-shown, shown))


def _backdrop(axes: Any, pictured: Pictured, half: float, brightest: float = 0.75) -> None:
    """The points this far around the vehicle, the brighter the more they reflect."""
    points = points_of(pictured.match)
    if points is None:
        return
    near = points[(np.abs(points[:, :2]) <= half).all(axis=1)]
    bright = near[:, 3] / max(float(np.percentile(near[:, 3], 99.0)), 1e-9) if len(near) else near[:, 3]
    order = np.argsort(bright, kind="stable")
    shade = colormaps["gray"](0.2 + (brightest - 0.2) * bright[order].clip(0.0, 1.0))
    axes.scatter(near[order, 1], near[order, 0], c=shade, s=2.0, linewidths=0)


def _pieces(axes: Any, ends: Floats, rows: NDArray[np.int64], kind: int, colours: Any) -> None:
    """Segments as lines, points as marks."""
    if not len(rows):
        return
    xy = ends[rows][:, :, 1::-1]
    if kind in STANDING:
        symbol, size = STANDING[kind]
        axes.scatter(*xy[:, 0].T, c=colours, marker=symbol, s=size, linewidths=0, zorder=4)
    else:
        axes.add_collection(LineCollection(list(xy), colors=colours, lw=1.5, zorder=3))


def _mass_panel(axes: Any, pictured: Pictured, level: int, found: Histogram) -> None:
    step = found.forward[1] - found.forward[0]
    ends = [(along[0] - step / 2, along[-1] + step / 2) for along in (found.left, found.forward)]
    axes.imshow(found.xy, origin="lower", extent=(*ends[0], *ends[1]), cmap=MASS, interpolation="nearest")
    axes.set(xlim=ends[0][::-1], ylim=ends[1], aspect="equal")
    axes.set_title(f"Histogram {level}: cells of {step:g} m", fontsize=12, loc="left")
    axes.set_xlabel("offset left, m", fontsize=10, labelpad=1)
    axes.set_ylabel("offset forward, m", fontsize=10, labelpad=0)
    axes.tick_params(labelsize=9, length=2, pad=2)
    if np.isfinite(found.cov).all():
        axes.plot(*ellipse(found)[:, ::-1].T, color=MEAN.colour, lw=1.4)
    _marks(axes, pictured, level, found)


def _marks(axes: Any, pictured: Pictured, level: int, found: Histogram) -> None:
    """Poses, the initial one first."""
    match = pictured.match
    axes.plot(0.0, 0.0, **START.look(), ls="")
    if pictured.truth is not None:
        axes.plot(*offset_of(match, pictured.truth)[1::-1], **TRUTH.look(), ls="")
    if not match.found:
        return
    axes.plot(*found.mean[1::-1], **MEAN.look(), ls="")
    axes.plot(*estimated_offset(match)[1::-1], **ESTIMATE.look(), ls="")
    if level == 0:
        for mode, weight in zip(match.modes, match.weights, strict=True):
            if weight > 0.0:
                place = offset_of(match, mode)[1::-1]
                axes.plot(*place, **MODE.look(), ls="")
                words = {"fontsize": 10, "color": MODE.colour, "path_effects": OUTLINED}
                axes.annotate(f"{weight:.2f}", place, (0, 8), textcoords="offset points", ha="center", **words)


def _yaw_panel(axes: Any, pictured: Pictured, found: Histogram) -> None:
    """The mass over yaw as steps, with the mean and its band."""
    match = pictured.match
    yaw = np.degrees(found.yaw)
    axes.bar(yaw, found.yaw_mass, width=yaw[1] - yaw[0], color="#7a3b8f")
    axes.set(xlim=(yaw[-1] + 0.6 * (yaw[1] - yaw[0]), yaw[0] - 0.6 * (yaw[1] - yaw[0])), ylim=(0.0, None))
    if match.found:
        mean, sigma = np.degrees(found.mean[2]), np.degrees(math.sqrt(found.cov[2, 2]))
        axes.axvspan(mean - SIGMAS * sigma, mean + SIGMAS * sigma, color=MEAN.colour, alpha=0.35, lw=0)
        axes.axvline(mean, color=MEAN.colour, lw=1.4)
    if pictured.truth is not None:
        axes.axvline(np.degrees(offset_of(match, pictured.truth)[2]), color=TRUTH.colour, lw=1.6, ls="--")
    axes.set_xlabel("yaw, ° (left is positive)", fontsize=10, labelpad=1)
    axes.set_ylabel("mass", fontsize=9)
    axes.tick_params(labelsize=9, length=2, pad=2)


def _bar(axes: Any, scale: ScalarMappable, ticks: list[float], label: str) -> None:
    """A scale inside the panel, so that all panels stay as large."""
    inset = axes.inset_axes((0.07, 0.045, 0.34, 0.022))
    bar = axes.figure.colorbar(scale, cax=inset, orientation="horizontal", location="top")
    bar.set_ticks(ticks, labels=[f"{tick:.2g}" for tick in ticks])
    bar.ax.tick_params(labelsize=9, length=2, pad=1, colors="white")
    bar.set_label(label, fontsize=8, color="white", labelpad=1)
    bar.outline.set_visible(False)


def _box(axes: Any, half: float) -> None:
    """What the panels of the map show."""
    corners = np.array([(-half, -half), (-half, half), (half, half), (half, -half)])
    axes.add_patch(Polygon(corners, fc="none", ec="white", lw=0.8, ls=(0, (4, 4)), zorder=5))
