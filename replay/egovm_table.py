"""The table of ``egoloc eval``."""

from collections.abc import Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from replay.table import bare_table, number, percent

NAMES = {"initial": "initial pose", "egovm": "EgoVM"}
AXES = {"lon": "longitudinal, m", "lat": "lateral, m", "yaw": "yaw, deg"}


def evaluation_table(report: Mapping[str, Any]) -> Group:
    """Errors by axis and method, whether the covariance is honest, and what the figures are of."""
    parts: list[RenderableType] = [_errors(report["methods"]), "", *map(Text, _notes(report))]
    return Group(*parts)


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


def _notes(report: Mapping[str, Any]) -> list[str]:
    nees, ms = report["nees"], report["network_ms"]
    notes = [
        f"{report['frames']} frames of worlds not trained on, initial poses off by {report['noise']},"
        f" {report['without_landmarks']} without landmarks; {ms['p50']:.0f} ms a frame (median)."
    ]
    if nees is None:
        return [*notes, "No covariance is stated."]
    axes = ", ".join(f"{axis} {nees[axis]:.2f}" for axis in AXES)
    return [
        *notes,
        f"NEES/3: mean {nees['mean_by_3']:.2f}, median {nees['median_by_3']:.2f} (1 and 0.79 of true covariances);"
        f" by axis {axes}; beyond 99 %: {percent(nees['beyond_99'])}; without any width: {nees['without_width']}.",
    ]
