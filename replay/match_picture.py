"""A match as a picture: the points, the map before and after, and what each level of the network made of them."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from replay.frame_picture import around
from replay.match_drawing import COLOURS, Pictured, error_of, estimated_offset, histograms, kind_name, planes_of, sigmas
from replay.match_panels import (
    ESTIMATE,
    MEAN,
    MODE,
    START,
    TRUTH,
    contribution_panel,
    feature_panel,
    histogram_panels,
    image_panel,
    map_panel,
    points_panel,
    semantic_panel,
)
from sensors.clock import NS_PER_S
from sensors.whole_file import whole_file

Floats = NDArray[np.float64]

PANEL_IN = 3.9
"""Side of a panel, inches."""
IMAGES_BY_ROW = 4
DPI = 100
HEAD_IN, FOOT_IN = 0.75, 0.75
"""Room for the title and the legend, inches."""


def draw_match(pictured: Pictured, path: Path) -> None:
    """Write a PNG, whole or not at all.

    Columns: points and map before and after; by level the features, the semantic maps where the matcher was asked for
    them, what each piece adds to the score, and the histogram. Below them the images of the frame, where it has any.
    """
    columns = _columns(pictured)
    images = [image for row in around(pictured.frame.images) for image in row] if pictured.frame else []
    rows = max(len(column) for column in columns)
    across = min(len(images), IMAGES_BY_ROW)
    width = (PANEL_IN + 0.5) * len(columns)
    shown_in = _images_in(pictured, width / across) * -(-len(images) // across) * 2 if images else 0.0
    height = (PANEL_IN + 0.5) * rows
    figure = Figure(figsize=(width, height + shown_in + HEAD_IN + FOOT_IN), layout="constrained")
    FigureCanvasAgg(figure)
    whole = height + shown_in + HEAD_IN + FOOT_IN
    figure.get_layout_engine().set(h_pad=0.08, rect=(0.0, FOOT_IN / whole, 1.0, 1.0 - (HEAD_IN + FOOT_IN) / whole))
    parts = figure.subfigures(2, 1, height_ratios=[height, shown_in]) if images else [figure]
    grid = parts[0].add_gridspec(rows, len(columns))
    for number, column in enumerate(columns):
        for row, panel in enumerate(column):
            panel(parts[0], grid[row, number])
    if images:
        _images(parts[1], pictured, images, across)
    _words(figure, pictured, whole)
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=DPI, format="png", metadata={"Software": None})


Panel = Callable[[Any, Any], None]


def _columns(pictured: Pictured) -> list[list[Panel]]:
    """What stands where: each draws itself into a figure at a place of its grid."""
    match = pictured.match
    after = estimated_offset(match)
    columns: list[list[Panel]] = [
        [
            lambda figure, place: points_panel(figure, place, pictured),
            lambda figure, place: map_panel(figure, place, pictured, np.zeros(3), "Map at the initial pose"),
            lambda figure, place: map_panel(figure, place, pictured, after, "Map at the estimated pose"),
        ]
    ]
    if match.output is None:
        return [[panel] for panel in columns[0][:2]]
    levels = range(len(planes_of(match)))
    columns.append([_of_level(feature_panel, pictured, level) for level in levels])
    if match.output.logits:
        columns.append([_of_level(semantic_panel, pictured, level) for level in levels])
    if found := histograms(match):
        columns.append([_of_level(contribution_panel, pictured, level) for level in levels])
        columns.append([_of_level(histogram_panels, pictured, level, found[level]) for level in levels])
    return columns


def _of_level(draw: Callable[..., None], *given: Any) -> Panel:
    return lambda figure, place: draw(figure, place, *given)


def _images_in(pictured: Pictured, width: float) -> float:
    """Height of an image that is so wide, with its title, inches."""
    assert pictured.frame is not None
    return width * max(image.height / image.width for image in pictured.frame.images) + 0.3


def _images(figure: Any, pictured: Pictured, images: list[Any], across: int) -> None:
    """Each image with the map before, and below it after."""
    rows = -(-len(images) // across)
    grid = figure.subplots(2 * rows, across, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    after = estimated_offset(pictured.match)
    for number, image in enumerate(images):
        row, column = 2 * (number // across), number % across
        image_panel(grid[row, column], pictured, image, np.zeros(3), "initial pose")
        image_panel(grid[row + 1, column], pictured, image, after, "estimated pose")


def _words(figure: Any, pictured: Pictured, height_in: float) -> None:
    """The title, and the legend of everything."""
    first, second = title(pictured)
    figure.text(0.008, 1.0 - 0.12 / height_in, first, fontsize=13, weight="bold", va="top")
    figure.text(0.008, 1.0 - 0.42 / height_in, second, fontsize=11.5, va="top")
    kinds = [kind for kind in COLOURS if (pictured.match.pieces.type == kind).any()]
    handles = [Line2D([], [], color=COLOURS[kind], lw=4, label=kind_name(kind)) for kind in kinds]
    if histograms(pictured.match):
        marks = [START, MEAN, ESTIMATE, MODE] + ([TRUTH] if pictured.truth is not None else [])
        handles += [mark.in_legend() for mark in marks]
    legend = figure.legend(
        handles=handles, loc="lower left", ncols=max(len(handles), 1), fontsize=11, frameon=True, facecolor="#30363d"
    )
    for text in legend.get_texts():
        text.set_color("white")


def title(pictured: Pictured) -> tuple[str, str]:
    """What was found, in two lines."""
    match = pictured.match
    moment = datetime.fromtimestamp(match.t_ns / NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]
    used = "/".join(map(str, match.landmarks))
    left_out = f", {match.left_out} more left out" if match.left_out else ""
    rest = f"landmarks {used} of {len(match.pieces)}{left_out}; {1e3 * match.seconds:.0f} ms"
    if not match.found:
        return f"{moment} UTC: no fix, {match.reason}", rest
    x, y, yaw = estimated_offset(match)
    lon, lat, turn = sigmas(match)
    moved = f"offset {x:+.3f} m forward, {y:+.3f} m left, {np.degrees(yaw):+.3f}°"
    stated = f"sigma {lon:.3f} m lon, {lat:.3f} m lat, {np.degrees(turn):.3f}°"
    if pictured.truth is not None:
        forward, left, wrong = error_of(match, pictured.truth)
        stated += f";  error {forward:+.3f} m lon, {left:+.3f} m lat, {np.degrees(wrong):+.3f}°"
    return f"{moment} UTC:  {moved}", f"{stated};  {rest}"
