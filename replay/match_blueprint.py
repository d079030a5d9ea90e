"""How a recording of matches is laid out: as the picture is, with what came out along time below it."""

import math
from collections.abc import Sequence
from typing import Any

import rerun.blueprint as rrb

from replay.frame_picture import around
from replay.match_drawing import CLOSE_M, Pictured

TIMELINE = "frame_time"
AXES = ("lon", "lat", "yaw")
"""Longitudinal and lateral in m, yaw in deg."""
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
    below = [rrb.Horizontal(*_along_time(matches), name="Along time"), *_cameras(matches)]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.TextDocumentView(origin="/summary", name="Match"),
            rrb.Horizontal(*columns),
            rrb.Tabs(*below, active_tab=0) if len(below) > 1 else below[0],
            row_shares=[0.5, 4.2, 1.3],
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
        yaw = rrb.BarChartView(origin=f"{entity}/yaw", name=f"yaw {level}, deg")
        rows.append(rrb.Horizontal(mass, yaw, column_shares=[1.4, 1.0]))
    return rrb.Vertical(*rows)


def _along_time(matches: Sequence[Pictured]) -> list[Any]:
    shown = ["offset", "sigma"] + (["error"] if any(each.truth is not None for each in matches) else [])
    views = [rrb.TimeSeriesView(origin=f"/{name}", name=f"{name}, m and deg") for name in shown]
    return [*views, rrb.TimeSeriesView(origin="/landmarks", name="landmarks by level")]


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
