"""Where things stand on the screen: map and scores on the left, plots and lanes over one time axis on the right."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from replay.appearance import sensor_words
from replay.canvas import TIMELINE
from replay.drawing import INNOVATIONS, OUTSIDE

FIELD_OF_VIEW = math.radians(55.0)
"""Of rerun's 3-D view, vertical."""
NARROWEST = 0.85
"""The map is laid out for a view of this width over height, or wider."""
LINKED = rrb.TimeAxis(link="LinkToGlobal")
"""All views are zoomed and shifted in time together."""


@dataclass(frozen=True)
class Scene:
    """What there is to show.

    roots: entity path of each run; extent_m: (width, height) of the tracks; error_range: axis -> half height of its
    plot, without axes that are not scored; nis_range, innovation_range: sensor -> top of the NIS plot, half height of
    each component's plot.
    """

    roots: Sequence[str]
    duration_s: float
    extent_m: tuple[float, float]
    error_range: Mapping[str, float]
    nis_range: Mapping[str, float]
    innovation_range: Mapping[str, Sequence[float]]
    lanes: int


def arrange(scene: Scene) -> rrb.Blueprint:
    """The blueprint of a recording."""
    left = rrb.Vertical(
        rrb.Tabs(_map(scene), _close_up(scene), active_tab=0),
        rrb.TextDocumentView(origin="/summary", name="Scores"),
        row_shares=[7, 3],
    )
    tabs = [_errors(scene)] if scene.error_range else []
    tabs += [_gates(scene, sensor) for sensor in scene.nis_range if sensor in OUTSIDE]
    tabs += [_vehicle(scene)] if set(scene.nis_range) - OUTSIDE else []
    tabs += [_states(scene)]
    lanes = min(80 + 42 * scene.lanes, 400)
    right = rrb.Vertical(rrb.Tabs(*tabs, active_tab=0), _lanes(), row_shares=[1000 - lanes, lanes])
    return _OverWholeDrive(
        scene.duration_s,
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
    )


def grid_spacing(extent: float) -> float:
    """1, 2 or 5 times a power of ten: between a tenth and a quarter of the extent."""
    step = max(extent, 1.0) / 10.0
    power = 10.0 ** math.floor(math.log10(step))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= step)


def _map(scene: Scene) -> rrb.Spatial3DView:
    spacing = grid_spacing(max(scene.extent_m))
    width, depth = scene.extent_m
    height = 0.5 * max(width / NARROWEST, depth, 10.0) / math.tan(FIELD_OF_VIEW / 2) * 1.1
    return _from_above(scene, f"Map, grid {spacing:g} m", spacing, height, "far")


def _close_up(scene: Scene) -> rrb.Spatial3DView:
    return _from_above(scene, "Close-up at the cursor, grid 1 m", 1.0, 10.0, "near", f"/{scene.roots[0]}/near/vehicle")


def _from_above(
    scene: Scene, name: str, spacing: float, height: float, part: str, follow: str | None = None
) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin="/",
        contents=[f"/{root}/{part}/**" for root in scene.roots],
        name=name,
        background=(13, 16, 17),
        line_grid=rrb.LineGrid3D(visible=True, spacing=spacing, color=(255, 255, 255, 25)),
        # straight above, the direction of view and its up axis would be undefined
        eye_controls=rrb.EyeControls3D(
            position=(0.0, 0.0, height),
            look_target=(0.0, 1e-5 * height, 0.0),
            eye_up=(0.0, 1.0, 0.0),
            tracking_entity=follow,
        ),
    )


def _errors(scene: Scene) -> rrb.Vertical:
    names = {"lon": "Longitudinal error, m", "lat": "Lateral error, m", "yaw": "Yaw error, deg"}
    views = [
        _plot(scene, names[axis], f"error/{axis}", (-top, top), extra=f"/threshold/{axis}/**")
        for axis, top in scene.error_range.items()
    ]
    if not OUTSIDE.isdisjoint(scene.nis_range):
        views.append(_plot(scene, "Innovations: NIS over its gate", "gate_ratio", (0.0, 1.5), extra="/threshold/gate"))
    return rrb.Vertical(*views, name="Errors")


def _gates(scene: Scene, sensor: str) -> rrb.Vertical:
    views = [_plot(scene, "NIS and its gate", f"nis/{sensor}", (0.0, scene.nis_range[sensor]))]
    for i, (component, _) in enumerate(INNOVATIONS.get(sensor, ())):
        top = scene.innovation_range[sensor][i]
        views.append(_plot(scene, f"Innovation {component}", f"innovation/{sensor}/{i}", (-top, top)))
    return rrb.Vertical(*views, name=sensor_words(sensor))


def _vehicle(scene: Scene) -> rrb.Vertical:
    views = [
        _plot(scene, f"NIS and its gate: {sensor_words(sensor)}", f"nis/{sensor}", (0.0, top))
        for sensor, top in scene.nis_range.items()
        if sensor not in OUTSIDE
    ]
    return rrb.Vertical(*views, name="Vehicle motion")


def _states(scene: Scene) -> rrb.Vertical:
    return rrb.Vertical(
        _plot(scene, "Gyro bias, deg/h", "bias/gyro"),
        _plot(scene, "Accelerometer bias, milli-g", "bias/accel"),
        _plot(scene, "Speed, m/s", "motion/speed"),
        _plot(scene, "Height in the map, m", "motion/height"),
        name="Biases and motion",
    )


def _plot(
    scene: Scene, name: str, path: str, y: tuple[float, float] | None = None, extra: str | None = None
) -> rrb.TimeSeriesView:
    contents = [f"/{root}/{path}/**" for root in scene.roots] + ([extra] if extra else [])
    return rrb.TimeSeriesView(
        origin="/",
        contents=contents,
        name=name,
        axis_x=LINKED,
        axis_y=rrb.ScalarAxis(range=y) if y else None,
        plot_legend=rrb.PlotLegend(corner="RightTop"),
    )


def _lanes() -> rrb.StateTimelineView:
    lanes = ["/health/**", "/gnss_status/**", "/gnss_hidden/**", "/update/**"]
    return rrb.StateTimelineView(origin="/", contents=lanes, name="Health, GNSS status and gates", time_view=LINKED)


class _OverWholeDrive(rrb.Blueprint):  # type: ignore[misc]
    """A blueprint whose linked time axes start out over the whole drive, with room for legends on the right.

    Otherwise they show a minute about the cursor. The viewer keeps the range of linked axes with a dummy view of fixed
    id (re_viewer_context::GLOBAL_VIEW_ID), for which rerun's Python API has no word.
    """

    shared = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"

    def __init__(self, duration_s: float, *parts: rrb.BlueprintPart) -> None:
        super().__init__(*parts, collapse_panels=True)
        self.duration_s = duration_s

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        start, end = (rrb.TimeRangeBoundary.absolute(seconds=second) for second in (0.0, 1.13 * self.duration_s))
        stream.log(self.shared, rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end)))
