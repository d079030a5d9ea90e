"""A run, or two on one timeline, as a rerun recording: columns only, thinned to 20 Hz, under a blueprint."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from replay.appearance import PLACED, styles
from replay.blueprint import Scene, arrange
from replay.canvas import Canvas
from replay.drawing import INNOVATIONS, LIMIT_KEYS, SCALE, MapPlace, draw_lanes, draw_limits, draw_run
from replay.run_columns import AXES, RunColumns, load_columns
from replay.run_summary import facts, summary
from sensors.errors import EgolocError
from sensors.whole_file import whole_file

WRITING_S = 300.0
"""Longest wait for the disk; without it rerun waits for ever."""


def write_recording(run: Path, rrd: Path | None = None, other: Path | None = None) -> Path:
    """The recording of one run, or of two on one timeline, from their folders alone; returns its path.

    rrd: by default RUN/run.rrd, of two runs RUN_and_OTHER.rrd beside RUN. Written under a temporary name and renamed.
    """
    runs = [load_columns(folder) for folder in ([run] if other is None else [run, other])]
    beside = run.resolve().with_name(f"{runs[0].name}_and_{runs[-1].name}.rrd")
    target = rrd or (run / "run.rrd" if other is None else beside)
    if target.suffix != ".rrd":  # it is replaced if it exists: it must not be a log
        raise EgolocError(f"{target}: expected a file name that ends in .rrd")
    span_ns = _common_span(runs, [run, other or run])
    place = _place(runs)
    roots = ["run"] if other is None else ["A", "B"]
    with whole_file(target, RuntimeError) as part:  # rerun's own, where the disk is full
        part.touch()  # rerun's own message would not be an OSError
        recording = rr.RecordingStream("egoloc" if other is None else "egoloc_two_runs")
        recording.save(part, default_blueprint=arrange(_scene(runs, roots, span_ns, place)))
        _draw(recording, runs, roots, span_ns, place)
        recording.flush(timeout_sec=WRITING_S)
        recording.disconnect()
    return target


def open_viewer(rrd: Path) -> bool:
    """Open a recording in the rerun viewer, which outlives this process; False where there is no display."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    command = [sys.executable, "-m", "rerun", "--new", "--bind", "127.0.0.1", str(rrd)]
    subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    return True


def _draw(
    recording: rr.RecordingStream,
    runs: Sequence[RunColumns],
    roots: Sequence[str],
    span_ns: tuple[int, int],
    place: MapPlace,
) -> None:
    everything = Canvas(recording, span_ns[0], "")
    everything.still("summary", rr.TextDocument(summary(runs), media_type=rr.MediaType.MARKDOWN))
    recording.send_recording_name(" and ".join(run.name for run in runs))
    recording.send_property("map_centre", rr.AnyValues(x_m=place.centre[0], y_m=place.centre[1]))
    draw_limits(Canvas(recording, span_ns[0], "threshold"), runs[0].metrics.get("limits", {}), span_ns)
    for run, root, style in zip(runs, roots, styles(roots, same_log=_same_log(runs)), strict=True):
        recording.send_property(root, rr.AnyValues(run=run.name, **facts(run)))
        draw_run(Canvas(recording, span_ns[0], root), run, place, style)
        draw_lanes(everything, run, style)


def _same_log(runs: Sequence[RunColumns]) -> bool:
    hashes = {run.manifest.get("log", {}).get("sha256") for run in runs}
    return len(hashes) == 1 and None not in hashes


def _common_span(runs: Sequence[RunColumns], folders: Sequence[Path]) -> tuple[int, int]:
    """First and last stamp of all runs, which must overlap."""
    spans = []
    for run, folder in zip(runs, folders, strict=False):
        span = run.span_ns()
        if span is None:
            raise EgolocError(f"{folder}: expected a run with states or decisions, both tables are empty")
        spans.append(span)
    if max(start for start, _ in spans) > min(end for _, end in spans):
        raise EgolocError(f"{folders[1]}: expected a run over the same time as {folders[0]}, they do not overlap")
    return min(start for start, _ in spans), max(end for _, end in spans)


def _place(runs: Sequence[RunColumns]) -> MapPlace:
    """The middle and size of all tracks."""
    tables = [table for run in runs for table in (run.states, *(run.sensors[s] for s in PLACED if s in run.sensors))]
    points = np.concatenate([np.stack((table["x"], table["y"]), axis=-1) for table in tables])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return MapPlace(np.zeros(2), (0.0, 0.0))
    low, high = points.min(axis=0), points.max(axis=0)
    return MapPlace((low + high) / 2, (float(high[0] - low[0]), float(high[1] - low[1])))


def _scene(runs: Sequence[RunColumns], roots: Sequence[str], span_ns: tuple[int, int], place: MapPlace) -> Scene:
    sensors = dict.fromkeys(sensor for run in runs for sensor in run.sensors)
    lanes = sum(
        1 + len(run.sensors) + ("gnss_position" in run.sensors) + bool((run.states["stretch"] >= 0).any())
        for run in runs
    )
    return Scene(
        roots=roots,
        duration_s=(span_ns[1] - span_ns[0]) * 1e-9,
        extent_m=place.extent_m,
        error_range=_error_range(runs),
        nis_range={s: 2.0 * _largest(_rows(runs, s, "threshold"), 100.0, 1.0) for s in sensors},
        innovation_range={
            s: [
                scale * 4.0 * _largest(_rows(runs, s, f"innovation_sigma_{i}"), 95.0, 1e-3)
                for i, (_, scale) in enumerate(INNOVATIONS.get(s, ()))
            ]
            for s in sensors
        },
        lanes=lanes,
    )


def _error_range(runs: Sequence[RunColumns]) -> dict[str, float]:
    """Half height of each error plot: nearly all errors and 3 sigma; the limit too, unless it would flatten them.

    Of one run also the sensors' errors; two runs are compared by their fused poses.
    """
    result = {}
    for axis in AXES:
        errors = np.concatenate([run.states[f"err_{axis}"] for run in runs])
        if np.isfinite(errors).any():
            sigmas = np.concatenate([run.states[f"sigma_{axis}"] for run in runs])[np.isfinite(errors)]
            top = max(_largest(errors, 99.9, 1e-6), 3.0 * _largest(sigmas, 95.0, 1e-6))
            if len(runs) == 1:
                top = max([top, *(_largest(_rows(runs, sensor, f"err_{axis}"), 95.0, 1e-6) for sensor in PLACED)])
            limit = float(runs[0].metrics.get("limits", {}).get(LIMIT_KEYS[axis], 0.0)) / SCALE[axis]
            result[axis] = 1.15 * SCALE[axis] * (limit if top < limit < 8.0 * top else top)
    return result


def _rows(runs: Sequence[RunColumns], sensor: str, column: str) -> NDArray[Any]:
    return np.concatenate([np.empty(0), *(run.sensors[sensor][column] for run in runs if sensor in run.sensors)])


def _largest(values: NDArray[Any], percentile: float, least: float) -> float:
    """A percentile of the finite magnitudes, `least` where there are none."""
    finite = np.abs(values[np.isfinite(values)])
    return max(float(np.percentile(finite, percentile)), least) if len(finite) else least
