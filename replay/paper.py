"""A campaign beside the road test of the EgoVM paper: "EgoVM: Achieving Precise Ego-Localization using Lightweight
Vectorized Maps" (He et al. 2023), Table 5.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from replay.segments import AXES
from replay.table import METHOD_NAMES, PLAIN_WIDTH, ar_digits, axis_cells, axis_headers, bare_table, percent

PAPER_KM = 16_500
TABLE_5: Mapping[str, Any] = {
    "gnss": {
        "ar": 0.9367,
        "lon": {"mae": 0.132, "rmse": 1.082, "below": {"0.1": 0.9141, "0.2": 0.9333, "0.3": 0.9412}},
        "lat": {"mae": 0.122, "rmse": 0.950, "below": {"0.1": 0.9126, "0.2": 0.9363, "0.3": 0.9454}},
        "yaw": None,
    },
    "egovm": {
        "ar": 0.9982,
        "lon": {"mae": 0.037, "rmse": 0.104, "below": {"0.1": 0.9699, "0.2": 0.9966, "0.3": 0.9977}},
        "lat": {"mae": 0.026, "rmse": 0.035, "below": {"0.1": 0.9854, "0.2": 0.9993, "0.3": 0.9999}},
        "yaw": {"mae": 0.131, "rmse": 0.506, "below": {"0.1": 0.4249, "0.3": 0.9629, "0.6": 0.9975}},
    },
    "fusion": {
        "ar": 1.0,
        "lon": {"mae": 0.030, "rmse": 0.040, "below": {"0.1": 0.9780, "0.2": 0.9984, "0.3": 0.9996}},
        "lat": {"mae": 0.026, "rmse": 0.036, "below": {"0.1": 0.9790, "0.2": 0.9989, "0.3": 1.0}},
        "yaw": {"mae": 0.122, "rmse": 0.192, "below": {"0.1": 0.4441, "0.3": 0.9731, "0.6": 0.9974}},
    },
}
"""The paper's rows, in the units of metrics.json."""


def paper_table(metrics: Mapping[str, Any], width: int) -> Group:
    """The paper's row and ours below it, for each method; an axis below the other where that is too wide."""
    km = metrics["distance_m"] / 1000
    title = f"EgoVM paper, Table 5 ({PAPER_KM:,} km on roads), and this simulation ({km:,.0f} km)"
    groups = [AXES] if width >= PLAIN_WIDTH else [(axis,) for axis in AXES]
    tables = [part for axes in groups for part in ("", _table(metrics, axes))]
    return Group(Text(title, style="bold"), *tables[1:])


def _table(metrics: Mapping[str, Any], axes: Sequence[str]) -> Table:
    table = bare_table(2)
    for header in ("\nmethod", "\nsource"):
        table.add_column(header, no_wrap=True)
    with_ar = axes[0] == AXES[0]
    for header in (*(["\nAR"] if with_ar else []), *(header for axis in axes for header in axis_headers(axis))):
        table.add_column(header, justify="right", no_wrap=True)
    for method, row in TABLE_5.items():
        ours = metrics["methods"].get(method, {"ar": None, **dict.fromkeys(AXES)})
        for name, source, figures in ((METHOD_NAMES[method], "paper", row), ("", "here", ours)):
            cells = [cell for axis in axes for cell in axis_cells(figures[axis], 2)]
            ar = percent(figures["ar"], 2 if source == "paper" else ar_digits(metrics))
            table.add_row(name, source, *([ar] if with_ar else []), *cells)
    return table
