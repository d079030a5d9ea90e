"""How a recording of matches is laid out: as the picture is, with what came out along time below it."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from replay.frame_picture import around
from replay.match_drawing import CLOSE_M, Floats, Pictured, error_of, estimated_offset, sigmas

TIMELINE = "frame_time"
AXES = ("lon", "lat", "yaw")
"""Longitudinal and lateral in m, yaw in deg."""
SERIES = ("offset", "sigma", "error")
UNITS = np.array((1.0, 1.0, 180.0 / np.pi))
BACKGROUND = (13, 16, 17)
FIELD_OF_VIEW = math.radians(55.0)
"""Rerun's own, from top to bottom."""


def blueprint(matches: Sequence[Pictured]) -> rrb.Blueprint:
    """Columns by what is shown, rows by level; of what no match has nothing."""
    outputs = [each.match.output for each in matches if each.match.output is not None]
    levels = range(max((len(output.bev) for output in outputs), default=0))
    columns: list[Any] = [_maps(matches, score=bool(outputs))]
    if levels:
        columns.append(_column("Features", [f"/bev/features/{level}" for level in levels]))
    if any(output.logits for output in outputs):
        shown = [f"/bev/semantics/{level}" for level in levels]
        columns.append(_column("Semantic map", shown, [f"/bev/map/{level}" for level in levels]))
    if levels:
        columns.append(_histograms(levels))
    below = [rrb.Horizontal(*_plots(matches), name="Along time"), *_cameras(matches)]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.TextDocumentView(origin="/summary", name="Match"),
            rrb.Horizontal(*columns),
            rrb.Tabs(*below, active_tab=0) if len(below) > 1 else below[0],
            row_shares=[0.6, 4.2, 1.3],
        ),
        collapse_panels=True,
    )


def _maps(matches: Sequence[Pictured], *, score: bool) -> Any:
    """The points near the vehicle, with the map before, after, and by its score."""
    names = {"Map at the initial pose": "/body/map/before", "Map at the estimated pose": "/body/map/after"}
    names |= {"Share of the last score": "/body/score"} if score else {}
    half = min(CLOSE_M, matches[0].bev.half_m) if matches else CLOSE_M
    height = 1.05 * half / math.tan(FIELD_OF_VIEW / 2.0)
    views = [
        rrb.Spatial3DView(
            origin="/body",
            contents=["/body/points", f"{entity}/**"],
            name=name,
            background=BACKGROUND,
            # straight above, the direction of view and its up axis would be undefined
            eye_controls=rrb.EyeControls3D(
                position=(0.0, 0.0, height), look_target=(1e-5 * height, 0.0, 0.0), eye_up=(1.0, 0.0, 0.0)
            ),
        )
        for name, entity in names.items()
    ]
    return rrb.Vertical(*views)


def _column(name: str, shown: Sequence[str], over: Sequence[str] = ()) -> Any:
    views = []
    for level, entity in enumerate(shown):
        contents = [entity, *over[level : level + 1]]
        views.append(rrb.Spatial2DView(origin="/", contents=contents, name=f"{name} {level}", background=BACKGROUND))
    return rrb.Vertical(*views)


def _histograms(levels: range) -> Any:
    rows = []
    for level in levels:
        entity = f"/histogram/{level}"
        contents = [f"{entity}/mass", f"{entity}/ellipse", f"{entity}/poses/**"]
        mass = rrb.Spatial2DView(origin=entity, contents=contents, name=f"Histogram {level}", background=BACKGROUND)
        yaw = rrb.BarChartView(
            origin=f"{entity}/yaw", name=f"yaw {level}, deg", plot_legend=rrb.PlotLegend(visible=False)
        )
        rows.append(rrb.Horizontal(mass, yaw, column_shares=[1.4, 1.0]))
    return rrb.Vertical(*rows)


def along_time(pictured: Pictured) -> dict[str, Floats]:
    """What came out, (3,) in m, m, deg by AXES; nothing where nothing did. error: only where the truth is known."""
    match = pictured.match
    if not match.found:
        return {}
    rows = {"offset": estimated_offset(match), "sigma": sigmas(match)}
    if pictured.truth is not None:
        rows["error"] = error_of(match, pictured.truth)
    return {name: row * UNITS for name, row in rows.items()}


def _plots(matches: Sequence[Pictured]) -> list[Any]:
    """Plots of what there is, from 0 or around it; landmarks."""
    rows = [along_time(each) for each in matches]
    views = []
    for name in SERIES:
        values = [row[name] for row in rows if name in row]
        if values:
            most = 1.15 * max(float(np.abs(values).max()), 1e-3)
            views.append(_plot(name, f"{name}, m and deg", (0.0 if name == "sigma" else -most, most)))
    most = 1.15 * max((int(each.match.landmarks.max(initial=1)) for each in matches), default=1)
    return [*views, _plot("landmarks", "landmarks by level", (0.0, most))]


def _plot(entity: str, name: str, span: tuple[float, float]) -> Any:
    axis = rrb.ScalarAxis(range=span)
    return rrb.TimeSeriesView(origin=f"/{entity}", name=name, axis_y=axis, plot_legend=rrb.Corner2D.LeftTop)


def _cameras(matches: Sequence[Pictured]) -> list[Any]:
    """All images with the map before, and with it after."""
    frames = [each.frame for each in reversed(matches) if each.frame is not None]
    first = {image.name: image for frame in frames for image in frame.images}
    names = [image.name for row in around(list(first.values())) for image in row]
    return [
        rrb.Horizontal(
            *(
                rrb.Spatial2DView(
                    origin=f"/cameras/{name}",
                    contents=[f"/cameras/{name}/image", f"/cameras/{name}/{moment}"],
                    name=name,
                )
                for name in names
            ),
            name=f"Images, {moment}",
        )
        for moment in (("before", "after") if names else ())
    ]
