"""What is drawn of a run: tracks, errors, innovations against their gates, lanes, biases and motion.

Angles are drawn in degrees, gyro biases in deg/h, accelerometer biases in milli-g. The map is flat, each track on
its own layer, and starts at a given centre, so that float32 is fine enough for it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from replay.appearance import (
    GATE_COLOURS,
    HEALTH,
    HEALTH_COLOURS,
    HIDDEN_COLOURS,
    LIMIT,
    PLACED,
    REJECTED,
    STATUS,
    STATUS_COLOURS,
    WIDTHS,
    Style,
    sensor_words,
)
from replay.canvas import Canvas, Colour
from replay.run_columns import AXES, Columns, Floats, RunColumns, strips, thin

DEGREE = 180.0 / np.pi
SCALE = {"lon": 1.0, "lat": 1.0, "yaw": DEGREE}
VALUES = ("innovation", "innovation_sigma")
LIMIT_KEYS = {"lon": "lon_m", "lat": "lat_m", "yaw": "yaw_deg"}
BIASES = {"gyro": 3600.0 * DEGREE, "accel": 1000.0 / 9.80665}
OUTSIDE = {"gnss_position", "gnss_velocity", "gnss_yaw", "pose_fix"}
"""Sensors that see more than the vehicle itself: the overview of gates is theirs."""
YAW = ("yaw, deg", DEGREE)
INNOVATIONS = {
    "gnss_position": (("east, m", 1.0), ("north, m", 1.0), ("up, m", 1.0)),
    "gnss_velocity": (("east, m/s", 1.0), ("north, m/s", 1.0), ("up, m/s", 1.0)),
    "gnss_yaw": (YAW,),
    "pose_fix": (("along, m", 1.0), ("left, m", 1.0), YAW),
}
"""Components of an innovation that are drawn, and their scale; of other sensors only the NIS is."""


@dataclass(frozen=True, eq=False)
class MapPlace:
    """Where the map is drawn: about centre (2,) map m, tracks stacked by so many metres in the view from far and near.

    The depth of a pixel is coarse seen from far; seen from near, a wide stack would shift tracks against each other.
    """

    centre: Floats
    extent_m: tuple[float, float]

    @property
    def layer(self) -> dict[str, float]:
        """Metres from one layer to the next."""
        return {"far": 1e-3 * max(*self.extent_m, 10.0), "near": 1e-3}

    def points(self, x: Floats, y: Floats, height: float) -> Floats:
        """(N, 3) points, m."""
        return np.stack((x - self.centre[0], y - self.centre[1], np.full(len(x), height)), axis=-1)


def draw_run(canvas: Canvas, run: RunColumns, place: MapPlace, style: Style) -> None:
    """Everything of one run but its lanes."""
    draw_tracks(canvas, run, place, style)
    draw_errors(canvas, run, style)
    draw_innovations(canvas, run, style)
    draw_states(canvas, run, style)


def draw_tracks(canvas: Canvas, run: RunColumns, place: MapPlace, style: Style) -> None:
    """Tracks as lines, each narrower than the one below it; fixes as dots; the fused position as a moving dot."""
    rows = thin(run.states["t_ns"])
    t = run.states["t_ns"][rows]
    columns = {name: run.states[name][rows] for name in ("ref_x", "ref_y", "x", "y")}
    _track(canvas, "reference", t, columns["ref_x"], columns["ref_y"], style.palette, place)
    for sensor, name in PLACED.items():
        if sensor in run.sensors and style.sensors:
            fixes = _thinned(run.sensors[sensor])
            _track(canvas, name, fixes["t_ns"], fixes["x"], fixes["y"], style.palette, place)
            points = place.points(fixes["x"], fixes["y"], 2e-3)
            dots = rr.Points3D(points[np.isfinite(points).all(axis=1)], colors=[style.palette[name]], radii=0.02)
            canvas.still(f"near/fixes/{name}", dots)
    if run.smoothed is not None:
        smoothed = _thinned_states(run.smoothed)
        _track(canvas, "smoothed", smoothed["t_ns"], smoothed["x"], smoothed["y"], style.palette, place)
    _track(canvas, "fused", t, columns["x"], columns["y"], style.palette, place)
    for view in ("far", "near"):
        places = place.points(columns["x"], columns["y"], len(style.palette) * place.layer[view])
        canvas.vehicle(f"{view}/vehicle", t, places, style.palette["fused"], style.label.strip() or "fused")


def draw_errors(canvas: Canvas, run: RunColumns, style: Style) -> None:
    """Errors of the fused pose within its 1 and 3 sigma, of the smoothed one, of the sensors at their own stamps."""
    rows = thin(run.states["t_ns"])
    t = run.states["t_ns"][rows]
    for axis in AXES:
        error, sigma = (SCALE[axis] * run.states[f"{kind}_{axis}"][rows] for kind in ("err", "sigma"))
        for sensor, name in PLACED.items():
            if sensor in run.sensors and style.sensors:
                fixes = _thinned(run.sensors[sensor])
                values = SCALE[axis] * fixes[f"err_{axis}"]
                path, words, colour = f"error/{axis}/{name}", name + style.label, style.palette[name]
                canvas.line(path, fixes["t_ns"], values, words, colour, 1.0, shown=style.alone)
        canvas.band(f"error/{axis}/sigma_3", t, 3.0 * sigma, f"3 sigma{style.label}", style.palette["fused"])
        canvas.band(f"error/{axis}/sigma", t, sigma, f"1 sigma{style.label}", style.palette["fused"])
        if run.smoothed is not None:
            smoothed = _thinned_states(run.smoothed)
            values, colour = SCALE[axis] * smoothed[f"err_{axis}"], style.palette["smoothed"]
            canvas.line(f"error/{axis}/smoothed", smoothed["t_ns"], values, f"smoothed{style.label}", colour)
        # lines lie on each other in alphabetical order of their paths: this one on top
        canvas.line(f"error/{axis}/solution", t, error, f"fused{style.label}", style.palette["fused"])


def draw_limits(canvas: Canvas, limits: Mapping[str, float], span_ns: tuple[int, int]) -> None:
    """Horizontal lines: the limits of localization, and the gate as 1 where NIS is drawn over its threshold."""
    t = np.array(span_ns, np.int64)
    for axis, key in LIMIT_KEYS.items():
        for side, sign in (("upper", 1.0), ("lower", -1.0)):
            if key in limits:
                values = np.full(2, sign * limits[key])
                canvas.steps(f"{axis}/{side}", t, values, f"limit {limits[key]:g}", LIMIT)
    canvas.steps("gate", t, np.ones(2), "gate", LIMIT)


def draw_innovations(canvas: Canvas, run: RunColumns, style: Style) -> None:
    """Of each sensor: NIS against its threshold, and the components with one sigma; what was left out is red."""
    for sensor, all_rows in run.sensors.items():
        rows = _thinned(all_rows)
        t, passed = rows["t_ns"], rows["accepted"].astype(bool)
        colour = style.of_sensor(sensor)
        if sensor in OUTSIDE:
            with np.errstate(invalid="ignore", divide="ignore"):
                ratio = np.where(rows["threshold"] > 0, rows["nis"] / rows["threshold"], np.nan)
            canvas.marks(f"gate_ratio/{sensor}", t, ratio, sensor_words(sensor) + style.label, colour)
        _by_fate(canvas, f"nis/{sensor}", t, rows["nis"], passed, colour, style.label)
        canvas.steps(f"nis/{sensor}/threshold", t, rows["threshold"], f"gate{style.label}", LIMIT)
        # of partly accepted pose fixes the components are not axes but kept directions, in units of the gate
        whole = ~np.isin(rows["reason"], [run.code(reason) for reason in ("partly_accepted", "modes_agree")])
        for i, (_, scale) in enumerate(INNOVATIONS.get(sensor, ())):
            path = f"innovation/{sensor}/{i}"
            value, sigma = (scale * np.where(whole, rows[f"{name}_{i}"], np.nan) for name in VALUES)
            canvas.band(f"{path}/sigma", t, sigma, f"1 sigma{style.label}", colour)
            _by_fate(canvas, path, t, value, passed, colour, style.label)


def draw_lanes(canvas: Canvas, run: RunColumns, style: Style) -> None:
    """The filter's health, GNSS status, stretches of hidden GNSS, and what the gates decided."""
    canvas.lane(f"health{style.suffix}", run.states["t_ns"], run.states["health"], HEALTH, HEALTH_COLOURS)
    if "gnss_position" in run.sensors and style.sensors:
        fixes = run.sensors["gnss_position"]
        known = fixes["status"] >= 0
        canvas.lane(f"gnss_status{style.suffix}", fixes["t_ns"][known], fixes["status"][known], STATUS, STATUS_COLOURS)
    hidden = run.states["stretch"] >= 0
    if hidden.any():
        codes = np.where(hidden, 0, -1)
        canvas.lane(f"gnss_hidden{style.suffix}", run.states["t_ns"], codes, tuple(HIDDEN_COLOURS), HIDDEN_COLOURS)
    for sensor, rows in run.sensors.items():
        canvas.lane(f"update/{sensor}{style.suffix}", rows["t_ns"], rows["reason"], run.reasons, GATE_COLOURS)


def draw_states(canvas: Canvas, run: RunColumns, style: Style) -> None:
    """Biases, speed and height."""
    rows = thin(run.states["t_ns"])
    columns = {name: column[rows] for name, column in run.states.items()}
    t = columns["t_ns"]
    for kind, scale in BIASES.items():
        for axis, colour in zip("xyz", style.xyz, strict=True):
            canvas.line(f"bias/{kind}/{axis}", t, scale * columns[f"{kind}_bias_{axis}"], axis + style.label, colour)
    canvas.line(
        "motion/speed/reference", t, columns["ref_speed"], f"reference{style.label}", style.palette["reference"], 3.0
    )
    speed = np.hypot(columns["ve"], columns["vn"])
    canvas.line("motion/speed/solution", t, speed, f"fused{style.label}", style.palette["fused"])
    canvas.line("motion/height/solution", t, columns["z"], f"fused{style.label}", style.palette["fused"])


def _by_fate(
    canvas: Canvas,
    path: str,
    t_ns: NDArray[np.int64],
    values: Floats,
    passed: NDArray[np.bool_],
    colour: Colour,
    label: str,
) -> None:
    canvas.marks(f"{path}/accepted", t_ns[passed], values[passed], f"accepted{label}", colour)
    canvas.marks(f"{path}/rejected", t_ns[~passed], values[~passed], f"left out{label}", REJECTED, 2.5)


def _thinned_states(rows: Columns) -> dict[str, NDArray[Any]]:
    kept = thin(rows["t_ns"])
    return {name: column[kept] for name, column in rows.items()}


def _thinned(rows: Columns) -> dict[str, NDArray[Any]]:
    """Thinned, but every change of fate stays."""
    kept = thin(rows["t_ns"], marks=rows["reason"])
    return {name: column[kept] for name, column in rows.items()}


def _track(
    canvas: Canvas,
    name: str,
    t_ns: NDArray[np.int64],
    x: Floats,
    y: Floats,
    palette: Mapping[str, Colour],
    place: MapPlace,
) -> None:
    """A line, cut at pauses, above those of the palette's earlier names."""
    number = list(palette).index(name)
    radius = rr.Radius.ui_points(WIDTHS[number])
    for view, layer in place.layer.items():
        lines = strips(t_ns, place.points(x, y, number * layer))
        canvas.still(f"{view}/track/{name}", rr.LineStrips3D(lines, colors=[palette[name]], radii=radius))
