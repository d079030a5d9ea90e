"""Figures of metrics.json from states.parquet and decisions.parquet alone, by the words of docs/metrics.md.

Nothing of the package is used. All rows are held at once; the time that an output shares with the evaluated grid is a
difference of two values of a running sum. Times are float nanoseconds since the log's first row: exact, below 2^53.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

Array = NDArray[Any]
Columns = dict[str, Array]

THRESHOLDS = {"lon": (0.1, 0.2, 0.3), "lat": (0.1, 0.2, 0.3), "yaw": (0.1, 0.3, 0.6)}
SENSORS = {"gnss": "gnss_position", "egovm": "pose_fix"}
PERIOD_NS = 1e8


@dataclass(frozen=True)
class Outputs:
    """Of a method in a log: each stands for ]begin, end]; error (N, 3) m, m, deg; under (N,): has it a tag?"""

    begin: Array
    end: Array
    error: Array
    under: Array

    @property
    def known(self) -> Array:
        return np.isfinite(self.error[:, :2]).all(axis=1)

    def good(self, limits: Sequence[float]) -> Array:
        """Which are within all limits; an axis that is never estimated is left out."""
        estimated = np.isfinite(self.error[self.known]).any(axis=0)
        within: Array = (np.abs(self.error) < limits)[:, estimated].all(axis=1)
        return within


@dataclass(frozen=True)
class Drive:
    """A log: its evaluated epochs ]begin, end] with the reference's speed m/s, which have the tag, and its methods."""

    begin: Array
    end: Array
    speed: Array
    under: Array
    methods: dict[str, Outputs]

    def within(self, outputs: Outputs, rate: Array) -> Array:
        """(N,) the integral of a rate (G,) over the evaluated time that each output stands for."""
        if not len(self.begin):
            return np.zeros(len(outputs.end))
        steps = np.cumsum((self.end - self.begin) * rate)
        times, upto = np.stack((self.begin, self.end), axis=1).ravel(), np.repeat(np.append(0.0, steps), 2)[1:-1]
        shares: Array = np.interp(outputs.end, times, upto) - np.interp(outputs.begin, times, upto)
        return shares


def figures(
    logs: Sequence[Path], limits: Sequence[float], least_s: float, kind: str = "", tag: str = ""
) -> dict[str, Any]:
    """Exposure and methods over run folders. limits: m, m, deg; kind, tag: of a slice ("": the whole).

    A method with less than least_s of evaluated time is not evaluated.
    """
    drives = [_drive(log, limits, lambda row: not kind or tag in row[kind].split(",")) for log in logs]
    seconds = sum(float(((d.end - d.begin) * d.under).sum()) for d in drives) / 1e9
    metres = sum(float(((d.end - d.begin) * d.under * d.speed).sum()) for d in drives) / 1e9
    epochs = sum(int(d.under.sum()) for d in drives)
    names = [name for name in ("gnss", "egovm", "fusion") if any(name in d.methods for d in drives)]
    methods = {name: _method(name, [d for d in drives if name in d.methods], limits, least_s) for name in names}
    return {"seconds": seconds, "metres": metres, "epochs": epochs, "methods": methods}


def _method(name: str, drives: Sequence[Drive], limits: Sequence[float], least_s: float) -> dict[str, Any]:
    evaluated, covered, good = np.zeros(2), np.zeros(2), np.zeros(2)
    errors = []
    for drive in drives:
        outputs = drive.methods[name]
        rates = (drive.under * 1.0, drive.under * drive.speed)
        shares = np.stack([drive.within(outputs, rate) for rate in rates], axis=1)
        whole = np.array([((drive.end - drive.begin) * rate).sum() for rate in rates])
        lost = 0.0 if name == "fusion" else shares[~outputs.known].sum(axis=0)  # a fix where there is no reference
        evaluated += whole - lost
        covered += shares[outputs.known].sum(axis=0)
        good += shares[outputs.known & outputs.good(limits)].sum(axis=0)
        used = outputs.known & (drive.within(outputs, np.ones(len(drive.end))) > 0) & outputs.under
        errors.append(np.abs(outputs.error[used]))
    if evaluated[0] < 1e9 * least_s:
        return dict.fromkeys(("ar", "ar_distance", "coverage", *THRESHOLDS))
    size = np.concatenate(errors)
    return {
        "ar": good[0] / evaluated[0],
        "ar_distance": good[1] / evaluated[1],
        "coverage": covered[0] / evaluated[0],
        **{axis: _axis(size[:, i], THRESHOLDS[axis]) for i, axis in enumerate(THRESHOLDS)},
    }


def _axis(size: Array, thresholds: Sequence[float]) -> dict[str, Any] | None:
    size = size[np.isfinite(size)]
    if not len(size):
        return None
    p50, p95, p99 = np.percentile(size, (50, 95, 99))
    below = {str(threshold): (size < threshold).mean() for threshold in thresholds}
    rmse = np.sqrt((size**2).mean())
    return {"mae": size.mean(), "rmse": rmse, "p50": p50, "p95": p95, "p99": p99, "max": size.max(), "below": below}


def _drive(log: Path, limits: Sequence[float], tagged: Callable[[dict[str, str]], bool]) -> Drive:
    states, decisions = (_columns(log / f"{name}.parquet") for name in ("states", "decisions"))
    start = states["t_ns"][0]
    end = (states["t_ns"] - start).astype(float)
    begin = _begins(end, PERIOD_NS)
    well_known = ~(states["ref_sigma_m"] > min(limits[:2]) / 3) & ~(np.degrees(states["ref_sigma_yaw"]) > limits[2] / 3)
    evaluated = (states["excluded"] == "evaluated") & well_known & (np.arange(len(end)) > 0)
    under = _under(states, tagged)
    methods = {"fusion": Outputs(begin[evaluated], end[evaluated], _error(states)[evaluated], under[evaluated])}
    hidden = (states["stretch"] >= 0).any()
    for name, sensor in SENSORS.items():
        if hidden and name == "gnss":  # the reference itself
            continue
        rows = np.flatnonzero((decisions["sensor"] == sensor) & (decisions["status"] != 0))
        rows = rows[np.unique(decisions["row"][rows], return_index=True)[1]]
        if len(rows):
            fixes = {key: column[rows] for key, column in decisions.items()}
            t = (fixes["t_ns"] - start).astype(float)
            period = float(np.median(np.diff(t[t <= t[0] + 300e9])))
            methods[name] = Outputs(_begins(t, period), t, _error(fixes), _under(fixes, tagged))
    speed = np.nan_to_num(states["ref_speed"][evaluated])
    return Drive(begin[evaluated], end[evaluated], speed, under[evaluated], methods)


def _begins(end: Array, period: float) -> Array:
    """Back to the one before, 1.5 nominal periods at most; the first stands for nothing."""
    return np.maximum(np.append(end[:1], end[:-1]), end - 1.5 * period)


def _error(columns: Columns) -> Array:
    return np.stack((columns["err_lon"], columns["err_lat"], np.degrees(columns["err_yaw"])), axis=1)


def _under(columns: Columns, tagged: Callable[[dict[str, str]], bool]) -> Array:
    rows = zip(columns["scene"], columns["mode"], strict=True)
    return np.array([tagged({"scene": scene, "mode": mode}) for scene, mode in rows], bool)


def _columns(path: Path) -> Columns:
    names = ("t_ns", "err_lon", "err_lat", "err_yaw", "scene", "mode")
    more = {
        "states.parquet": ("excluded", "ref_speed", "ref_sigma_m", "ref_sigma_yaw", "stretch"),
        "decisions.parquet": ("sensor", "status", "row"),
    }
    table = pq.read_table(path, columns=[*names, *more[path.name]])
    texts = {field.name for field in table.schema if str(field.type).startswith("dictionary")}
    return {
        name: np.array(table[name].to_pylist()) if name in texts else table[name].to_numpy()
        for name in table.column_names
    }
