"""The contents of metrics.json, of a log or a campaign, from its sums (docs/metrics.md)."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.result import Sensor
from replay.config import Limits
from replay.health import health_metrics
from replay.segments import AXES, BELOW, METHODS, THRESHOLDS, Segments, tags
from replay.sketch import Sketch, percentiles
from replay.sums import Counts, Sums
from sensors.clock import NS_PER_S

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Metrics = dict[str, Any]

SENSORS = {"gnss": Sensor.GNSS_POSITION, "egovm": Sensor.POSE_FIX}
"""Methods that are a sensor's fixes."""
SIGMA_SHARE = 1 / 3
"""The reference's sigma must not exceed this share of the limit."""
MIN_EVALUATED_NS = 10 * NS_PER_S
"""With less evaluated time than this nothing is said of a method."""
MIN_DISTANCE_M = 1.0
"""With less evaluated distance than this there is no distance-weighted ratio, m."""
SHARES = {"p50": 50, "p95": 95, "p99": 99}
NOT_EVALUATED: Mapping[str, None] = dict.fromkeys(("ar", "ar_distance", "coverage", *AXES))


def metrics_of(sums: Sums, logs: Mapping[str, Any] | None = None) -> Metrics:
    """metrics.json. logs: of a campaign, how many there are, were done, and failed ("total", "done", "failed")."""
    counts, segments = sums.counts, sums.segments
    metrics: Metrics = {
        "limits": {"lon_m": counts.limits.lon_m, "lat_m": counts.limits.lat_m, "yaw_deg": counts.limits.yaw_deg},
        "order": counts.order,
        "reference": counts.reference,
        "span_s": counts.span_ns / NS_PER_S,
        **_exposure(segments),
        "excluded": counts.excluded,
    }
    if counts.hidden_length_s is not None:
        metrics["hidden"] = _hidden(counts)
    metrics["methods"] = _methods(counts, segments, sums.sketch)
    metrics["slices"] = {kind: _slices(sums, kind) for kind in ("scene", "mode") if segments.tags(kind)}
    metrics["alignment_s"] = counts.alignment_s
    metrics["health"] = health_metrics(counts.health)
    if logs is None:
        metrics["estimates"] = counts.estimates
    metrics["decisions"] = counts.decisions
    metrics["left_out"] = counts.left_out
    metrics["warnings"] = counts.warnings
    if logs is not None:
        metrics["warning_counts"] = counts.warning_counts
        metrics["logs"] = dict(logs)
    return metrics


def well_known(sigma: Floats, limits: Limits, *, heading: Mask) -> tuple[Mask, Mask]:
    """Which epochs (N,) have a reference well below the limits, in position and, where it has a heading, in yaw.

    sigma: (N, 2) m and rad; NaN (unknown) passes.
    """
    position = ~(sigma[:, 0] > SIGMA_SHARE * min(limits.lon_m, limits.lat_m))
    return position, ~heading | ~(sigma[:, 1] > SIGMA_SHARE * np.radians(limits.yaw_deg))


def _exposure(segments: Segments) -> Metrics:
    """How much was evaluated: fusion can be compared wherever there is a reference."""
    of = segments.of_method("fusion")
    return {
        "duration_s": int(segments.columns["evaluated_ns"][of].sum()) / NS_PER_S,
        "distance_m": math.fsum(segments.columns["evaluated_m"][of]),
        "epochs": int(segments.columns["epochs"][of].sum()),
    }


def _slices(sums: Sums, kind: str) -> Metrics:
    """Exposure and methods by scene tag or mode; a row with several tags counts in each."""
    place = ("scene", "mode").index(kind)
    slices = {}
    for tag in sums.segments.tags(kind):
        segments = sums.segments.chosen(sums.segments.tagged(kind, tag))
        exposure = _exposure(segments)
        slices[tag] = {
            "hours": exposure["duration_s"] / 3600,
            "km": exposure["distance_m"] / 1000,
            "epochs": exposure["epochs"],
            "methods": _methods(sums.counts, segments, sums.sketch.chosen(lambda key: tag in tags(key[place]))),  # noqa: B023
        }
    return slices


def _methods(counts: Counts, segments: Segments, sketch: Sketch) -> Metrics:
    """One entry a method that has data."""
    least: float = MIN_EVALUATED_NS
    if counts.hidden_length_s is not None:
        least = min(least, 0.9 * counts.hidden_length_s * NS_PER_S)
    return {
        method: method_metrics(segments.chosen(segments.of_method(method)), sketch, method, least)
        for method in methods_of(counts)
    }


def methods_of(counts: Counts) -> list[str]:
    """The methods with data, in the order of METHODS."""
    present = {name for name, sensor in SENSORS.items() if sensor.name.lower() in counts.decisions}
    if counts.hidden_length_s is not None:
        present.discard("gnss")  # it is the reference
    present |= {"fusion", "smoothed"} if counts.smoothed else {"fusion"}
    return [name for name in METHODS if name in present]


def method_metrics(rows: Segments, sketch: Sketch, method: str, least_ns: float = 1) -> Metrics:
    """One method's entry of metrics.json, from its rows; nothing is said of less than least_ns of evaluated time."""
    columns = rows.columns
    total_ns, total_m = int(columns["evaluated_ns"].sum()), math.fsum(columns["evaluated_m"])
    if total_ns < max(least_ns, 1):
        return dict(NOT_EVALUATED)
    return {
        "ar": int(columns["good_ns"].sum()) / total_ns,
        "ar_distance": _share(math.fsum(columns["good_m"]), total_m) if total_m >= MIN_DISTANCE_M else None,
        "coverage": int(columns["covered_ns"].sum()) / total_ns,
        **{axis: _axis_metrics(rows, sketch, method, axis) for axis in AXES},
    }


def _axis_metrics(rows: Segments, sketch: Sketch, method: str, axis: str) -> Metrics | None:
    """MAE, RMSE, percentiles and shares below thresholds of an axis; None if it has no error."""
    columns = rows.columns
    count = int(columns[f"{axis}_count"].sum())
    if not count:
        return None
    largest = float(columns[f"{axis}_max"].max())
    histogram = sketch.total(lambda key: key[2:] == (method, axis))
    return {
        "mae": math.fsum(columns[f"{axis}_abs"]) / count,
        "rmse": math.sqrt(math.fsum(columns[f"{axis}_squared"]) / count),
        **dict(zip(SHARES, percentiles(histogram, SHARES.values(), largest), strict=True)),
        "max": largest,
        "below": {
            f"{threshold:g}": int(columns[name].sum()) / count
            for threshold, name in zip(THRESHOLDS[axis], BELOW[axis], strict=True)
        },
    }


def _hidden(counts: Counts) -> Metrics:
    """How far the filter had drifted at the end of every stretch without GNSS, and at worst within it."""
    ends = [stretch for stretch in counts.stretches if stretch["end_horizontal_m"] is not None]
    error = np.array([stretch["end_horizontal_m"] for stretch in ends])
    ratio = [stretch["end_horizontal_m"] / stretch["end_sigma_m"] for stretch in ends]
    p50, p95 = np.percentile(error, (50, 95)).tolist() if ends else (None, None)
    return {
        "stretches": len(ends),
        "length_s": counts.hidden_length_s,
        "end_horizontal_m": {"p50": p50, "p95": p95, "max": float(error.max()) if ends else None},
        "end_error_over_sigma_rms": math.sqrt(math.fsum(r * r for r in ratio) / len(ends)) if ends else None,
        **_within([stretch.get("within") for stretch in counts.stretches]),
        **({"smoothed": _within([stretch.get("smoothed") for stretch in counts.stretches])} if counts.smoothed else {}),
        "without_end": len(counts.stretches) - len(ends),
        "per_stretch": counts.stretches,
    }


def _within(stretches: Sequence[Metrics | None]) -> Metrics:
    """The largest errors within stretches, and the rms of their ratios of error to sigma."""
    known = [stretch for stretch in stretches if stretch is not None]
    largest = np.array([stretch["largest_horizontal_m"] for stretch in known])
    squares = [stretch["error_over_sigma_rms"] ** 2 for stretch in known]
    p50, p95 = np.percentile(largest, (50, 95)).tolist() if known else (None, None)
    return {
        "largest_horizontal_m": {"p50": p50, "p95": p95, "max": float(largest.max()) if known else None},
        "error_over_sigma_rms": math.sqrt(math.fsum(squares) / len(known)) if known else None,
    }


def _share(part: float, whole: float) -> float:
    """A ratio whose rounding errors do not leave 0..1."""
    return min(part / whole, 1.0)
