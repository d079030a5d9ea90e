"""What a run came to, as Markdown: its scores and, of two runs, where their configs differ."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from replay.run_columns import RunColumns

COLOURS = "Reference grey, GNSS orange, EgoVM green, smoothed cyan, fused blue; bands: 1 and 3 sigma of the fused pose."
METHODS = {"gnss": "GNSS", "egovm": "EgoVM", "fusion": "fusion", "smoothed": "smoothed"}


def summary(runs: Sequence[RunColumns]) -> str:
    """What a run covers and its scores; of two runs also the configs' differences, key by key."""
    named = zip("AB" if len(runs) == 2 else ("",), runs, strict=True)
    parts = [_extent(letter, run) for letter, run in named]
    if len(runs) == 2:
        parts.append(_differences(*runs))
    parts += [_scores(runs), *(_hidden(run) for run in runs), *(_warnings(run) for run in runs)]
    parts.append(COLOURS + (" Run B: fused pink, all else darker." if len(runs) == 2 else ""))
    return "\n\n".join(part for part in parts if part) + "\n"


def facts(run: RunColumns) -> dict[str, str]:
    """What the manifest and the metrics say of the run as a whole: key -> text."""
    plain = {**_flat(run.manifest), **_flat({k: v for k, v in run.metrics.items() if k != "methods"})}
    return {key: str(value) for key, value in plain.items()}


def _scores(runs: Sequence[RunColumns]) -> str:
    limits = runs[0].metrics.get("limits", {})
    within = ", ".join(
        f"{axis} {limits[key]:g} {unit}"
        for axis, key, unit in (("lon", "lon_m", "m"), ("lat", "lat_m", "m"), ("yaw", "yaw_deg", "deg"))
        if key in limits
    )
    rows = ["| run | method | AR | lon RMSE | lat RMSE | yaw RMSE |", "|---|---|---|---|---|---|"]
    names = [runs[0].name] if len(runs) == 1 else ["A", "B"]
    for label, run in zip(names, runs, strict=True):
        for method, name in METHODS.items():
            score = run.metrics.get("methods", {}).get(method)
            if score is not None:
                axes = (_rmse(score.get("lon"), "m"), _rmse(score.get("lat"), "m"), _rmse(score.get("yaw"), "deg"))
                rows.append(f"| {label} | {name} | {_percent(score.get('ar'))} | {' | '.join(axes)} |")
    if len(rows) == 2:
        return "No reference: nothing is scored."
    return "\n".join(rows) + (f"\n\nAR: share of time within {within}" if within else "")


def _extent(letter: str, run: RunColumns) -> str:
    span = run.span_ns()
    if span is None:
        return ""
    start = np.datetime64(span[0], "ns").astype("datetime64[s]")
    distance = run.metrics.get("distance_m")
    driven = f", {distance / 1000:.2f} km scored" if distance else ""
    name = f"{letter}: {run.name}" if letter else run.name
    return f"{name}: {(span[1] - span[0]) * 1e-9:.0f} s from {start} UTC{driven}"


def _hidden(run: RunColumns) -> str:
    hidden = run.metrics.get("hidden")
    if not hidden:
        return ""
    end = hidden.get("end_horizontal_m") or {}
    quantiles = ", ".join(f"{key} {end[key]:.2f} m" for key in ("p50", "p95", "max") if end.get(key) is not None)
    return f"{run.name}: GNSS hidden {hidden['stretches']} x {hidden['length_s']:g} s; error at the end: {quantiles}"


def _warnings(run: RunColumns) -> str:
    return "\n\n".join(f"**{run.name}: {entry.get('text', '')}**" for entry in run.metrics.get("warnings", ()))


def _differences(a: RunColumns, b: RunColumns) -> str:
    left, right = dict(_flat(a.config)), dict(_flat(b.config))
    changed = [key for key in dict.fromkeys([*left, *right]) if left.get(key) != right.get(key)]
    if not changed:
        return "The configs are equal."
    rows = ["| config | A | B |", "|---|---|---|"]
    return "\n".join(rows + [f"| {key} | {left.get(key, '-')} | {right.get(key, '-')} |" for key in changed])


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    return dict(_leaves(table, prefix))


def _leaves(table: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _rmse(axis: Mapping[str, Any] | None, unit: str) -> str:
    return f"{axis['rmse']:.3f} {unit}" if axis and axis.get("rmse") is not None else "-"


def _percent(share: float | None) -> str:
    return f"{100 * share:.2f} %" if share is not None else "-"
