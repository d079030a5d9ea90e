"""metrics.json from the tables of a run: nothing else is needed, so new limits need no new replay."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.result import Reason, Sensor
from replay.config import Limits
from replay.metrics import (
    MIN_EVALUATED_NS,
    NOT_EVALUATED,
    Span,
    cover_ns,
    evaluated_span,
    method_metrics,
    well_known,
)
from replay.references import Excluded
from replay.store import Run
from sensors.clock import NS_PER_S

Floats = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]
Metrics = dict[str, Any]

END_TOLERANCE_NS = NS_PER_S
"""The last scored epoch of a hidden stretch must lie this near its end for its error to count as that of the end."""
METHODS = {"gnss": Sensor.GNSS_POSITION, "egovm": Sensor.POSE_FIX}
_UNCOUNTED = (Excluded.EVALUATED, Excluded.NOT_HIDDEN)


def score(run: Run, limits: Limits) -> Metrics:
    """The contents of metrics.json."""
    states, facts = run.states, run.facts
    evaluated, excluded = _evaluated(states, limits, heading=facts["reference"]["heading"] == "attitude")
    evaluated[:1] = False  # covers nothing
    span = evaluated_span(states["t_ns"], evaluated, states["ref_speed"], facts["period_ns"])
    metrics: Metrics = {
        "limits": {"lon_m": limits.lon_m, "lat_m": limits.lat_m, "yaw_deg": limits.yaw_deg},
        "order": facts["order"],
        "reference": facts["reference"],
        "span_s": len(states["t_ns"]) * facts["period_ns"] / NS_PER_S,
        "duration_s": span.total_ns / NS_PER_S,
        "distance_m": span.total_m,
        "epochs": int(evaluated.sum()),
        "excluded": excluded,
    }
    if facts["stretches"] is not None:
        metrics["hidden"] = _hidden(run)
    metrics["methods"] = _methods(run, evaluated, span, limits)
    metrics["alignment_s"] = facts["alignment_s"]
    metrics["decisions"] = _decision_counts(run.decisions)
    metrics["left_out"] = facts["left_out"]
    metrics["warnings"] = facts["warnings"]
    return metrics


def _evaluated(states: Columns, limits: Limits, *, heading: bool) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Which epochs are scored, and how many are not, by reason."""
    code = states["excluded"]
    evaluated = code == Excluded.EVALUATED
    counts = {why.name.lower(): int((code == why).sum()) for why in Excluded if why not in _UNCOUNTED}
    sigma = np.stack((states["ref_sigma_m"], states["ref_sigma_yaw"]), axis=-1)
    position, yaw = well_known(sigma, limits, yaw=heading)
    counts["position_sigma"] = int((evaluated & ~position).sum())
    counts["yaw_sigma"] = int((evaluated & position & ~yaw).sum())
    return evaluated & position & yaw, {reason: count for reason, count in counts.items() if count}


def _methods(run: Run, evaluated: NDArray[np.bool_], span: Span, limits: Limits) -> Metrics:
    """One entry a method that has data."""
    states, hidden = run.states, run.facts["stretches"] is not None
    present = [name for name, sensor in METHODS.items() if (run.decisions["sensor"] == sensor).any()]
    present = [name for name in present if not (hidden and name == "gnss")]
    least: float = MIN_EVALUATED_NS
    if hidden:
        least = min(least, *(0.9 * (end - start) for start, end in run.facts["stretches"] or ()))
    if span.total_ns < max(least, 1):
        return {name: dict(NOT_EVALUATED) for name in (*present, "fusion")}
    methods = {name: sensor_metrics(run.decisions, METHODS[name], span, limits) for name in present}
    weights = span.weights(states["t_ns"], cover_ns(states["t_ns"], run.facts["period_ns"]))
    time, distance = (np.where(evaluated, weight, 0.0) for weight in weights)
    methods["fusion"] = method_metrics(_error(states), time, distance, span.total_ns, span.total_m, limits)
    return methods


def sensor_metrics(decisions: Columns, sensor: Sensor, span: Span, limits: Limits) -> Metrics:
    """A sensor at its own stamps: each fix once, whatever the filter decided, if it has a position."""
    rows = np.flatnonzero((decisions["sensor"] == sensor) & (decisions["status"] != 0))
    rows = rows[np.unique(decisions["row"][rows], return_index=True)[1]]
    rows = rows[np.argsort(decisions["t_ns"][rows], kind="stable")]
    t_ns = decisions["t_ns"][rows]
    error = _error({name: decisions[name][rows] for name in ("err_lon", "err_lat", "err_yaw")})
    time, distance = span.weights(t_ns, cover_ns(t_ns))
    unknown = np.isnan(error[:, 0])  # no reference at the fix itself, though there is at part of the time it covers
    total_ns, total_m = span.total_ns - time[unknown].sum(), span.total_m - distance[unknown].sum()
    return method_metrics(error, time, distance, float(total_ns), float(total_m), limits)


def _hidden(run: Run) -> Metrics:
    """How far the filter had drifted at the end of every stretch without GNSS."""
    hide, planned = run.facts["hide_gnss"], run.facts["stretches"]
    assert hide is not None
    assert planned is not None
    stretches = [_stretch(run, index, start, end) for index, (start, end) in enumerate(planned)]
    ends = [s for s in stretches if s["end_horizontal_m"] is not None]
    error = np.array([s["end_horizontal_m"] for s in ends])
    ratio = np.array([s["end_horizontal_m"] / s["end_sigma_m"] for s in ends])
    p50, p95 = np.percentile(error, (50, 95)).tolist() if ends else (None, None)
    return {
        "stretches": len(ends),
        "length_s": hide["length_s"],
        "end_horizontal_m": {"p50": p50, "p95": p95, "max": float(error.max()) if ends else None},
        "end_error_over_sigma_rms": float(np.sqrt(np.mean(ratio**2))) if ends else None,
        "without_end": len(stretches) - len(ends),
        "per_stretch": stretches,
    }


def _stretch(run: Run, index: int, start: int, end: int) -> Metrics:
    """One stretch: start since the log's, horizontal error and sigma at its last epoch that has both."""
    states = run.states
    known = [np.isfinite(states[name]) for name in ("ref_x", "x", "y", "sigma_lon", "sigma_lat")]
    rows = np.flatnonzero((states["stretch"] == index) & np.all(known, axis=0))
    found = len(rows) > 0 and end - states["t_ns"][rows[-1]] <= END_TOLERANCE_NS
    entry: Metrics = {
        "start_s": (start - run.facts["start_ns"]) / NS_PER_S,
        "end_horizontal_m": None,
        "end_sigma_m": None,
    }
    if found:
        last = rows[-1]
        entry["end_horizontal_m"] = float(
            np.hypot(*(states[axis][last] - states[f"ref_{axis}"][last] for axis in "xy"))
        )
        entry["end_sigma_m"] = float(np.hypot(states["sigma_lon"][last], states["sigma_lat"][last]))
    entry["since_gnss_s"] = _since_gnss(run.decisions, int(states["t_ns"][rows[-1]])) if found else None
    return entry


def _since_gnss(decisions: Columns, t_ns: int) -> float | None:
    """Seconds since the last GNSS position that the filter applied."""
    used = (decisions["sensor"] == Sensor.GNSS_POSITION) & decisions["accepted"] & (decisions["t_ns"] <= t_ns)
    return (t_ns - int(decisions["t_ns"][used].max())) / NS_PER_S if used.any() else None


def _decision_counts(decisions: Columns) -> dict[str, dict[str, int]]:
    """Sensor -> reason -> number of measurements."""
    counts: dict[str, dict[str, int]] = {}
    for sensor in Sensor:
        reasons = np.bincount(decisions["reason"][decisions["sensor"] == sensor], minlength=len(Reason))
        if reasons.any():
            counts[sensor.name.lower()] = {
                reason.name.lower(): int(n) for reason, n in zip(Reason, reasons, strict=True) if n
            }
    return counts


def _error(columns: Columns) -> Floats:
    return np.stack([columns[name] for name in ("err_lon", "err_lat", "err_yaw")], axis=-1)
