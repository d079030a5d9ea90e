"""A frame as a picture: its images, with the LiDAR's points where they appear, coloured by their distance."""

import math
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from replay.chosen_frames import ChosenFrame
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.images import Image
from sensors.motion import Standing, points_at

Floats = NDArray[np.float64]

COLOURS = "turbo_r"
"""Near is red, far is blue."""
NEAR_M, FAR_M = 2.5, 70.0
PANEL_IN = 5.6
"""Width of an image, inches."""


class OnImage(NamedTuple):
    """LiDAR points that appear in an image. pixels: (N, 2) column and row; depth: (N,) m along its axis."""

    pixels: Floats
    depth: Floats


def on_image(chosen: ChosenFrame, image: Image) -> OnImage:
    """The points of all sweeps, brought to the moment of the exposure."""
    frame, motion = chosen.frame, chosen.motion
    parts = [points_at(sweep, frame.t_ns, motion, image.t_ns) for sweep in frame.sweeps]
    seen = image.seen(np.concatenate([np.empty((0, 3)), *parts]))
    return OnImage(seen.pixels[seen.inside], seen.depth[seen.inside])


def around(images: Sequence[Image]) -> list[list[Image]]:
    """Images in rows: those that look ahead, from left to right, then those that look back, the left one first."""
    ahead = sorted((image for image in images if _looks(image)[0] >= 0.0), key=lambda image: -_azimuth(image))
    back = [image for image in images if _looks(image)[0] < 0.0]
    back.sort(key=lambda image: _azimuth(image) % (2.0 * math.pi))
    return [row for row in (ahead, back) if row]


def _looks(image: Image) -> Floats:
    """Where a camera's axis points, in body axes."""
    return image.T_body_camera[:3, 2]


def _azimuth(image: Image) -> float:
    forward, left, _ = _looks(image)
    return math.atan2(left, forward)


def draw_frame(chosen: ChosenFrame, path: Path) -> None:
    """Write a PNG, whole or not at all."""
    rows = around(chosen.frame.images)
    columns = max(map(len, rows))
    aspect = max(image.height / image.width for image in chosen.frame.images)
    figure = Figure(figsize=(PANEL_IN * columns, (PANEL_IN * aspect + 0.1) * len(rows) + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for images, panels in zip(rows, grid, strict=True):
        for image, axes in zip(images, panels, strict=False):
            _panel(axes, chosen, image)
    scale = ScalarMappable(LogNorm(NEAR_M, FAR_M), COLOURS)
    bar = figure.colorbar(scale, ax=grid, shrink=0.7, pad=0.005, aspect=40)
    bar.set_ticks([3, 5, 10, 20, 50], labels=["3", "5", "10", "20", "50"])
    bar.ax.minorticks_off()
    bar.set_label("m from the camera")
    figure.suptitle(_title(chosen), fontsize=12, x=0.005, ha="left")
    _save(figure, path)


def _panel(axes: Any, chosen: ChosenFrame, image: Image) -> None:
    axes.imshow(image.rgb(), interpolation="antialiased")
    seen = on_image(chosen, image)
    far_first = np.argsort(-seen.depth, kind="stable")
    axes.scatter(
        *seen.pixels[far_first].T, c=colours(seen.depth[far_first]), s=3.0, marker="o", linewidths=0, alpha=0.85
    )
    axes.set(xlim=(-0.5, image.width - 0.5), ylim=(image.height - 0.5, -0.5))
    late_ms = (image.t_ns - chosen.frame.t_ns) / 1e6
    axes.set_title(f"{image.name}, {late_ms:+.1f} ms, {len(seen.depth):,} points", fontsize=10, loc="left")


def colours(depth: Floats) -> Floats:
    """(N, 4) of distances, m."""
    found: Floats = np.asarray(colormaps[COLOURS](LogNorm(NEAR_M, FAR_M, clip=True)(depth)))
    return found


def _title(chosen: ChosenFrame) -> str:
    moved = "no motion known" if isinstance(chosen.motion, Standing) else "moved by the reference to each exposure"
    points = sum(map(len, chosen.frame.sweeps))
    return f"{chosen.at_s:.1f} s ({chosen.frame.t_ns / NS_PER_S:.3f}): {points:,} LiDAR points, {moved}"


def _save(figure: Figure, path: Path) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        figure.savefig(partial, dpi=130, format="png", metadata={"Software": None})
        partial.replace(path)
    except OSError as error:
        raise EgolocError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
