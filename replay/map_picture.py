"""A map as a picture: its elements, and the predicted sigmas along the route, red where they degenerate."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from numpy.typing import NDArray

from replay.map_drawing import KIND_COLOURS, MOST_ELEMENTS, Drawn, drawn_elements, pieces, round_length
from replay.map_info import SCALE, UNITS
from sensors.errors import EgolocError
from sensors.maps.localizability import AXES, Localizability
from sensors.maps.map_file import MapFile
from sensors.maps.route import Route
from sensors.whole_file import whole_file

if TYPE_CHECKING:
    from replay.map_info import Info

COLOURS = "RdYlBu_r"
"""Blue is well below what is degenerate, red is beyond; the middle is just it."""
DECADE = 10.0
"""The scale goes from a tenth of what is degenerate to ten times that."""
TITLES = {"lon": "Longitudinal sigma, m", "lat": "Lateral sigma, m", "yaw": "Yaw sigma, deg"}
ROAD_M = 14.0
"""Width that the route is drawn in, m, as far as that can be seen."""
PANEL_POINTS = 700.0
"""Width of the large map, points."""
WIDE = 1.6
"""Width over height from which the small maps are below the large one."""
NAMED = 3
"""Of the longest stretches, so many are named at most."""
BACKGROUND = "#f7f6f3"


def draw(opened: MapFile, route: Route, found: Localizability, info: "Info", path: Path) -> None:
    """Write a PNG, whole or not at all: the map coloured by longitudinal sigma, small ones by lateral and yaw."""
    shapes = drawn_elements(opened)
    low, high = _extent(opened, path)
    figure = Figure(figsize=(15.0, 9.2), layout="constrained")
    FigureCanvasAgg(figure)
    if (high - low)[0] > WIDE * (high - low)[1]:
        grid = figure.add_gridspec(2, 2, height_ratios=[1.7, 1.0])
        places = {"lon": grid[0, :], "lat": grid[1, 0], "yaw": grid[1, 1]}
    else:
        grid = figure.add_gridspec(2, 2, width_ratios=[2.2, 1.0])
        places = {"lon": grid[:, 0], "lat": grid[0, 1], "yaw": grid[1, 1]}
    for axis, place in places.items():
        axes = figure.add_subplot(place)
        _frame(axes, low, high)
        _elements(axes, shapes, large=axis == "lon")
        if len(route):
            _route(figure, axes, route, found, info, axis)
        axes.set_title(TITLES[axis], fontsize=12 if axis == "lon" else 10, loc="left")
        if axis == "lon":
            _scale_bar(axes, float((high - low)[0]))
            _legend(axes, opened, shapes)
            _name_stretches(axes, info, float((high - low).max()))
    figure.suptitle(_title(info), fontsize=12, x=0.01, ha="left")
    _save(figure, path)


def _extent(opened: MapFile, path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of what is shown: the map and 3 % around it."""
    if not len(opened.boxes):
        raise EgolocError(f"{path}: cannot be drawn: {opened.path} is empty")
    low, high = opened.boxes[:, :2].min(axis=0), opened.boxes[:, 2:].max(axis=0)
    margin = 0.03 * max(float((high - low).max()), 50.0)
    return low - margin, high + margin


def _frame(axes: Any, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
    axes.plot(*np.stack((low, high), axis=1), alpha=0.0)  # spans the view; fixed limits would fight the aspect
    axes.margins(0.0)
    axes.set(aspect="equal", adjustable="datalim", xticks=[], yticks=[])
    axes.set_facecolor(BACKGROUND)
    for side in axes.spines.values():
        side.set(color="#cccccc")


def _elements(axes: Any, shapes: Drawn, *, large: bool) -> None:
    """Surfels as dots, lines as lines, poles and signs as marks."""
    scale = 1.0 if large else 0.5
    if len(shapes.surfels):
        axes.plot(*shapes.surfels.T, ",", color="#c9c4b8", zorder=1, rasterized=True)
    for kind, lines in shapes.lines.items():
        widths = {"lane_line": 0.5, "road_boundary": 0.8}.get(kind, 1.0)
        axes.add_collection(LineCollection(lines, colors=KIND_COLOURS[kind], lw=widths * scale, zorder=2))
    for kind, points in shapes.points.items():
        axes.plot(*points.T, "o" if kind == "pole" else "s", color=KIND_COLOURS[kind], ms=2.2 * scale, mew=0, zorder=4)


def _route(figure: Figure, axes: Any, route: Route, found: Localizability, info: "Info", axis: str) -> None:
    """Pieces from pose to pose in the colour of their sigma, the worst on top, and the colours' scale."""
    column = AXES.index(axis)
    beyond = info["localizability"]["degenerate_beyond"][UNITS[axis]]
    sigma = found.sigma[:, column] * SCALE[column]
    order = np.argsort(sigma, kind="stable")
    width = float(np.clip(PANEL_POINTS / _extent_m(route) * ROAD_M, 1.6, 7.0)) * (1.0 if axis == "lon" else 0.6)
    lines = LineCollection(
        pieces(route)[order],
        array=np.clip(sigma[order], beyond / DECADE, beyond * DECADE),
        cmap=COLOURS,
        norm=LogNorm(beyond / DECADE, beyond * DECADE),
        lw=width,
        capstyle="round",
        zorder=3,
    )
    axes.add_collection(lines)
    bar = figure.colorbar(lines, ax=axes, orientation="horizontal", fraction=0.05, pad=0.01, aspect=45)
    ticks = [beyond * factor for factor in (0.1, 0.3, 1.0, 3.0, 10.0)]
    bar.set_ticks(ticks, labels=[f"{tick:.2g}" for tick in ticks])
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=8, length=2)
    bar.ax.axvline(beyond, color="black", lw=1.0)
    bar.outline.set_visible(False)
    share = 100.0 * info["localizability"]["degenerate"][axis]
    bar.set_label(f"right of the mark: degenerate, {share:.1f} % of the way", fontsize=8)


def _extent_m(route: Route) -> float:
    """Its larger side."""
    return max(float(np.ptp(route.xy, axis=0).max()), 50.0)


def _scale_bar(axes: Any, width: float) -> None:
    """A round length at the lower left."""
    length = round_length(width / 5.0)
    text = f"{length / 1000:g} km" if length >= 1000.0 else f"{length:g} m"
    bar = AnchoredSizeBar(axes.transData, length, text, "lower left", pad=0.6, sep=4, frameon=False)
    bar.set_zorder(6)
    axes.add_artist(bar)


def _legend(axes: Any, opened: MapFile, shapes: Drawn) -> None:
    """What is drawn, with counts; of a map that is too large for it, a word that it is not."""
    counts = opened.facts.counts
    handles = []
    for kind, colour in KIND_COLOURS.items():
        if counts.get(kind):
            marker = {"pole": "o", "sign": "s", "surfel": "."}.get(kind, "")
            line = "" if marker else "-"
            label = f"{kind.replace('_', ' ')} ({counts[kind]:,})"
            handles.append(Line2D([], [], color=colour, ls=line, marker=marker, ms=4, lw=1.5, label=label))
    title = None if shapes.complete else f"not drawn: more than {MOST_ELEMENTS:,} elements"
    axes.legend(handles=handles, loc="upper right", fontsize=8, framealpha=0.9, title=title, title_fontsize=8)


def _name_stretches(axes: Any, info: "Info", extent: float) -> None:
    """The longest of longitudinal degeneracy, as far as their names do not cover each other."""
    found = info["localizability"]
    if found is None:
        return
    named: list[NDArray[np.float64]] = []
    for stretch in [row for row in found["stretches"] if row["axis"] == "lon"]:
        place = np.array([stretch["x"], stretch["y"]])
        if len(named) == NAMED or any(np.hypot(*(place - other)) < 0.1 * extent for other in named):
            continue
        named.append(place)
        axes.annotate(
            f"{stretch['length_m']:,.0f} m",
            (stretch["x"], stretch["y"]),
            (14, 14),
            textcoords="offset points",
            fontsize=9,
            zorder=7,
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "#b2182b", "lw": 0.8},
            arrowprops={"arrowstyle": "-", "color": "#b2182b", "lw": 0.8},
        )


def _title(info: "Info") -> str:
    km = f"{info['km']:,.1f} km of road" if info["km"] else "length of road unknown"
    size = f"{info['bytes'] / 1e6:,.2f} MB" + (f", {info['mb_per_km']:.3f} MB/km" if info["mb_per_km"] else "")
    found = info["localizability"]
    share = (
        f"{100 * found['degenerate']['any']:.1f} % of the way degenerate along some axis"
        if found
        else "no line to judge it along"
    )
    return f"{Path(info['map']).name}: {km}, {size}; {share}"


def _save(figure: Figure, path: Path) -> None:
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=110, format="png", metadata={"Software": None})
