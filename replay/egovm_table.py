"""The table of ``egoloc eval``."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from replay.table import bare_table, number, percent

NAMES = {"initial": "initial pose", "egovm": "EgoVM"}
AXES = {"lon": "longitudinal, m", "lat": "lateral, m", "yaw": "yaw, deg"}


def evaluation_table(report: Mapping[str, Any]) -> Group:
    """Errors by axis and method, whether the covariances of the levels are honest, and what the figures are of."""
    parts: list[RenderableType] = [_errors(report["methods"]), ""]
    if report["covariance"] is not None:
        parts += [_covariances(report["covariance"], report["stated"]), ""]
    return Group(*parts, *map(Text, _notes(report)))


def _errors(methods: Mapping[str, Any]) -> Table:
    table = bare_table(2)
    table.add_column("error")
    table.add_column("method")
    for header in ("MAE", "RMSE", "95 %", "max"):
        table.add_column(header, justify="right")
    table.add_column("below", justify="right")
    for axis, words in AXES.items():
        for method, name in NAMES.items():
            found = methods[method][axis]
            figures = [number(found[key], 3) for key in ("mae", "rmse", "p95", "max")]
            shares = " ".join(f"{limit}: {percent(share)}" for limit, share in found["below"].items())
            table.add_row(words, name, *figures, shares)
    return table


def _covariances(levels: Sequence[Mapping[str, Any]], stated: Mapping[str, Any] | None) -> Table:
    """A row for each level as its histogram has it, and one calibrated; and what fixes state."""
    table = bare_table(2)
    for header in ("\ncovariance of", ""):
        table.add_column(header)
    for header in ("NEES/3\nmean", "\nmedian", "NEES\nlon", "\nlat", "\nyaw", "beyond\n99 %"):
        table.add_column(header, justify="right")
    for header in ("ENCE\nlon", "\nlat", "\nyaw"):
        table.add_column(header, justify="right")
    for level in levels:
        first = f"{level['step_m']:g} m, {level['step_deg']:g} deg"
        for kind in ("raw", "calibrated"):
            if level[kind] is not None:
                table.add_row(first, kind, *_honesty(level[kind]))
                first = ""
    if stated is not None:
        table.add_row("a fix", "", *_honesty(stated))
    return table


def _honesty(found: Mapping[str, Any]) -> list[str]:
    nees, ence = ([number(found[name][axis], 2) for axis in AXES] for name in ("nees", "ence"))
    totals = [number(found[name], 2) for name in ("mean_by_3", "median_by_3")]
    return [*totals, *nees, percent(found["beyond_99"]), *ence]


def _notes(report: Mapping[str, Any]) -> Iterator[str]:
    levels, ms = report["covariance"], report["network_ms"]
    yield (
        f"{report['frames']} frames of worlds not trained on, initial poses off by {report['noise']}, map"
        f" {report['map']}: {report['without_landmarks']} without landmarks; {ms['p50']:.0f} ms a frame (median)."
    )
    last = None if levels is None else levels[-1]["raw"]
    if last is None:
        yield "No covariance is stated."
        return
    yield (
        f"Of true covariances: NEES/3 has mean 1 and median 0.79, an axis 1; 1 % lie beyond; ENCE is"
        f" {last['ence_of_true']:.2f} on so many frames. A fix states the last level and what an earlier one left open."
    )
    outside = [level["truth_outside"] for level in levels]
    if any(outside):
        yield f"Frames whose truth lies outside the levels' windows: {', '.join(map(str, outside))}."
    if last["without_width"]:
        yield f"Frames whose last histogram has no width, left out of its raw figures: {last['without_width']}."
    yield _calibration(report["calibration"])


def _calibration(fit: Mapping[str, Any] | None) -> str:
    if fit is None:
        return "These weights have no calibration: --calibrate fits one."
    return f"Calibrated on {fit['frames']} frames of other worlds again."
