"""A match as a picture: the points, the map before and after, and what each level of the network made of them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from replay.frame_picture import around
from replay.match_drawing import COLOURS, Pictured, estimated_offset, kind_name, title
from replay.match_levels import histograms, planes_of
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
from sensors.images import Image
from sensors.whole_file import whole_file

Floats = NDArray[np.float64]

Panel = Callable[[Any, Any], None]
"""Draws itself into a figure at a place of its grid."""
PANEL_IN = 3.9
"""Side of a panel, inches."""
IMAGES_BY_ROW = 4
LEGEND_IN = 1.65
"""Width of an entry of the legend, inches."""
DPI = 100
HEAD_IN, FOOT_IN = 0.75, 0.75
"""Room for the title and the legend, inches."""


def draw_match(pictured: Pictured, path: Path) -> None:
    """Write a PNG, whole or not at all."""
    figure = figure_of(pictured)
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=DPI, format="png", metadata={"Software": None})


def figure_of(pictured: Pictured) -> Any:
    """A match as a figure.

    Columns: points and map before and after; by level the features, the semantic maps where the matcher was asked for
    them, what each piece adds to the score, and the histogram. Below them the images of the frame, where it has any.
    """
    columns = _columns(pictured)
    pairs = _pairs(pictured)
    rows = max(len(column) for column in columns)
    width, height = (PANEL_IN + 0.5) * len(columns), (PANEL_IN + 0.5) * rows
    below = len(pairs) * _image_in(pictured, width / len(pairs[0])) if pairs else 0.0
    heights = [HEAD_IN, height, *([below] if pairs else []), FOOT_IN]
    figure = Figure(figsize=(width, sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(hspace=0.025, wspace=0.01)
    head, body, *middle, foot = figure.subfigures(len(heights), 1, height_ratios=heights)
    grid = body.add_gridspec(rows, len(columns))
    for number, column in enumerate(columns):
        for row, panel in enumerate(column):
            panel(body, grid[row, number])
    for each in middle:
        _images(each, pictured, pairs)
    first, second = title(pictured)
    head.text(0.008, 0.8, first, fontsize=13, weight="bold", va="top")
    head.text(0.008, 0.4, second, fontsize=11.5, va="top")
    _legend(foot, pictured, width)
    return figure


def _columns(pictured: Pictured) -> list[list[Panel]]:
    """What stands where, from above."""
    match = pictured.match
    after, late = estimated_offset(match), "Map at the estimated pose" + ("" if match.found else ": none")
    columns: list[list[Panel]] = [
        [
            lambda figure, place: points_panel(figure, place, pictured),
            lambda figure, place: map_panel(figure, place, pictured, np.zeros(3), "Map at the initial pose"),
            lambda figure, place: map_panel(figure, place, pictured, after, late),
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


def _pairs(pictured: Pictured) -> list[list[tuple[Image, bool]]]:
    """Rows of images, each with whether the map is drawn after rather than before: one row above the other, or of a
    single image beside each other."""
    images = [image for row in around(pictured.frame.images) for image in row] if pictured.frame else []
    if len(images) == 1:
        return [[(images[0], False), (images[0], True)]]
    across = -(-len(images) // max(-(-len(images) // IMAGES_BY_ROW), 1))
    begins = range(0, len(images), max(across, 1))
    return [[(image, late) for image in images[i : i + across]] for i in begins for late in (False, True)]


def _image_in(pictured: Pictured, width: float) -> float:
    """Height of an image that is so wide, with its title, inches."""
    assert pictured.frame is not None
    return width * max(image.height / image.width for image in pictured.frame.images) + 0.3


def _images(figure: Any, pictured: Pictured, pairs: list[list[tuple[Image, bool]]]) -> None:
    """Each image with the map before and after."""
    grid = figure.subplots(len(pairs), len(pairs[0]), squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    after = estimated_offset(pictured.match)
    for row, panels in zip(pairs, grid, strict=True):
        for (image, late), axes in zip(row, panels, strict=False):
            offset, words = (after, "estimated pose") if late else (np.zeros(3), "initial pose")
            image_panel(axes, pictured, image, offset, words)


def _legend(figure: Any, pictured: Pictured, width_in: float) -> None:
    """Of everything that is drawn."""
    kinds = [kind for kind in COLOURS if (pictured.match.pieces.type == kind).any()]
    handles = [Line2D([], [], color=COLOURS[kind], lw=4, label=kind_name(kind)) for kind in kinds]
    if histograms(pictured.match):
        marks = [START, MEAN, ESTIMATE, MODE] + ([TRUTH] if pictured.truth is not None else [])
        handles += [mark.in_legend() for mark in marks]
    if not handles:
        return
    across = min(len(handles), max(int(width_in / LEGEND_IN), 1))
    legend = figure.legend(handles=handles, loc="center left", ncols=across, fontsize=11, facecolor="#30363d")
    for text in legend.get_texts():
        text.set_color("white")
