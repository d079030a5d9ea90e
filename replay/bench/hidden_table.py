"""The table of `egoloc bench hidden`: one block for each log, part of it and length."""

from collections.abc import Mapping
from itertools import groupby
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from replay.table import DASH, bare_table

Result = Mapping[str, Any]
_HEADERS = ("n", "median m", "95 % m", "error/sigma", "n yaw", "median deg", "95 % deg", "error/sigma")


def hidden_table(result: Result) -> RenderableType:
    """Horizontal and yaw errors at the end of the stretches, and these over their sigmas."""
    table = bare_table(2)
    table.add_column("log, hidden for, by")
    for header in _HEADERS:
        table.add_column(header, justify="right")
    for place, rows in groupby(result["rows"], key=lambda row: (row["log"], row["part"], row["length_s"])):
        log, part, length = place
        table.add_row(f"{log}, {length:g} s" + ("" if part == "all" else f", {part}"), *[""] * len(_HEADERS))
        for name, metrics in groupby(rows, key=lambda row: row["name"]):
            found = {row["metric"]: row for row in metrics}
            cells = _cells(found.get("end_horizontal_m")) + _cells(found.get("end_yaw_deg"))
            table.add_row(f"  {name}", *cells)
    return Group(table, *(Text(line) for line in _notes(result["conditions"])))


def _cells(row: Mapping[str, Any] | None) -> list[str]:
    if row is None:
        return [DASH] * 4
    return [str(row["count"]), f"{row['median']:.3f}", f"{row['p95']:.3f}", f"{row['error_over_sigma_rms']:.2f}"]


def _notes(facts: Mapping[str, Any]) -> list[str]:
    """What was used, what not and why, and how good the judge is."""
    lines = []
    for log, lengths in facts["stretches"].items():
        judge = facts["logs"][log]
        lines.append(f"{log}: judged by {judge['judge']}.")
        if judge["course_against_filter_deg"] is not None:
            scatter = judge["course_against_filter_deg"]
            lines.append(f"  Yaw by the course, which scatters by {scatter:.2f} deg about the filter with all sensors.")
        for length, counts in lengths.items():
            reasons = ", ".join(f"{n} {why}" for why, n in counts["not used"].items())
            lines.append(f"  {length}: {counts['used']} used" + (f"; not used: {reasons}" if reasons else "") + ".")
    return lines
