"""The table of a run, laid out as the EgoVM paper's Table 5, and what was left out of it."""

from collections.abc import Iterator, Mapping
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from replay.metrics import THRESHOLDS

Metrics = Mapping[str, Any]

WIDE = 120
"""Columns from which everything stands in one table."""
PLAIN_WIDTH = 132
"""Columns taken where the output is no terminal."""
AXES = {"lon": "lon m", "lat": "lat m", "yaw": "yaw deg"}
DASH = "-"
MANY = 1000.0
"""Numbers from here on are written with an exponent, so that no column is cut off."""

METHOD_NAMES = {"gnss": "GNSS-RTK", "egovm": "EgoVM", "fusion": "Fusion"}

EXCLUDED_TEXT = {
    "outside": "before or after the reference",
    "gap": "in a gap of the reference",
    "no_heading": "the reference has no heading there",
    "slow": "the reference has no heading and moves below 1 m/s",
    "position_sigma": "the reference's position is not well below the limits",
    "yaw_sigma": "the reference's yaw is not well below the limits",
}


def print_run(metrics: Metrics, console: Console | None = None) -> None:
    """Print tables and notes; plain text where the output is no terminal."""
    console = console or output_console()
    console.print(render(metrics, console.width))


def output_console() -> Console:
    """Standard output; as wide as the terminal, or PLAIN_WIDTH where it is none."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)


def render(metrics: Metrics, width: int) -> RenderableType:
    """Methods side by side, hidden stretches if any, then warnings and notes."""
    groups = [("lon", "lat", "yaw")] if width >= WIDE else [("lon", "lat"), ("yaw",)]
    parts: list[RenderableType] = []
    for axes in groups:
        parts += [_method_table(metrics, axes, gap=2 if width >= WIDE else 1), ""]
    if "hidden" in metrics:
        parts += [_stretch_table(metrics["hidden"]), ""]
    warnings = [Text(f"WARNING: {entry['text']}", style="bold red") for entry in metrics["warnings"]]
    return Group(*parts, *warnings, *(Text(note) for note in notes(metrics)))


def notes(metrics: Metrics) -> Iterator[str]:
    """Lines on what was scored, against what, and what was left out."""
    limits = metrics["limits"]
    yield (
        f"AR: share of time with errors below {limits['lon_m']:g} m longitudinal, {limits['lat_m']:g} m lateral, "
        f"{limits['yaw_deg']:g} deg yaw; cov: share of time with output; all in %."
    )
    yield _scored(metrics)
    yield from _unestimated(metrics)
    if "hidden" in metrics:
        yield from _drift(metrics["hidden"])
    if metrics["alignment_s"] is not None:  # else a warning says so
        yield f"Aligned {metrics['alignment_s']:.1f} s after the first IMU sample."
    for reason, count in metrics["excluded"].items() if metrics["reference"]["kind"] else ():
        yield f"Excluded: {count} epochs: {EXCLUDED_TEXT[reason]}."
    for entry in metrics["left_out"]:
        count = f"{entry['count']} of " if entry["count"] else ""
        yield f"Left out: {count}{entry['source']}: {entry['reason']}."
    for sensor, reasons in metrics["decisions"].items():
        counts = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in reasons.items())
        yield f"Filter, {sensor.replace('_', ' ')}: {counts}."


def _method_table(metrics: Metrics, axes: tuple[str, ...], gap: int) -> Table:
    first = axes[0] == "lon"
    table = _bare_table(gap)
    table.add_column("\nmethod", no_wrap=True)
    for header in ("\nAR", "\ncov") if first else ():
        table.add_column(header, justify="right", no_wrap=True)
    for axis in axes:
        for header in _axis_headers(axis):
            table.add_column(header, justify="right", no_wrap=True)
    for name, method in metrics["methods"].items():
        shares = [_percent(method["ar"], 2), _percent(method["coverage"])] if first else []
        cells = [cell for axis in axes for cell in _axis_cells(method[axis])]
        table.add_row(METHOD_NAMES.get(name, name), *shares, *cells)
    return table


def _bare_table(gap: int) -> Table:
    """A table with one line below its head and gap (1 or more) blanks between columns."""
    return Table(box=box.SIMPLE_HEAD, padding=(0, gap - 1, 0, 0), pad_edge=False, show_edge=False, header_style="bold")


def _axis_headers(axis: str) -> list[str]:
    return [f"{AXES[axis]}\nMAE", "\nRMSE", *(f"%\n<{threshold:g}" for threshold in THRESHOLDS[axis])]


def _axis_cells(axis: Metrics | None) -> list[str]:
    if axis is None:
        return [DASH] * 5
    return [_number(axis["mae"], 3), _number(axis["rmse"], 3), *(_percent(share) for share in axis["below"].values())]


def _percent(share: float | None, digits: int = 1) -> str:
    """Per cent; only the whole is printed as 100."""
    if share is None:
        return DASH
    return "100" if share >= 1 else f"{min(100 * share, 100 - 10**-digits):.{digits}f}"


def _stretch_table(hidden: Metrics) -> Table:
    """Every stretch without GNSS: when, and how far off at its end."""
    table = _bare_table(2)
    for header in ("hidden from\ns", "end error\nm", "sigma\nm", "error/\nsigma", "since GNSS\ns"):
        table.add_column(header, justify="right", no_wrap=True)
    for entry in hidden["per_stretch"]:
        error, sigma, since = entry["end_horizontal_m"], entry["end_sigma_m"], entry["since_gnss_s"]
        ratio = DASH if error is None else _number(error / sigma, 2)
        table.add_row(f"{entry['start_s']:.1f}", _number(error, 3), _number(sigma, 3), ratio, _number(since, 1))
    return table


def _number(value: float | None, digits: int) -> str:
    """Fixed digits as long as the column holds them."""
    if value is None:
        return DASH
    return f"{value:.{digits}f}" if abs(value) < MANY else f"{value:.1e}"


def _scored(metrics: Metrics) -> str:
    reference = metrics["reference"]
    if reference["kind"] is None:
        return "Not evaluated: the log has no reference (see --reference and --hide-gnss)."
    heading = "" if reference["heading"] == "attitude" else ", which has no heading: axes from its course"
    amount = f"{metrics['epochs']} epochs, {metrics['duration_s']:.1f} s, {metrics['distance_m'] / 1000:.3f} km"
    against = f"against {reference['kind']}{heading}"
    if all(method["ar"] is None for method in metrics["methods"].values()):
        return f"Not evaluated: too little reference: {amount} {against}."
    where = ", at the antenna in the hidden stretches" if "hidden" in metrics else ""
    return f"Scored: {amount} {against}{where}; the filter's state at each time, in {metrics['order']} order."


def _unestimated(metrics: Metrics) -> Iterator[str]:
    """Axes that a method with output leaves out."""
    if metrics["reference"]["heading"] == "course":
        yield "Yaw is not scored: the reference has no heading; AR is that of the other axes."
        return
    for name, method in metrics["methods"].items():
        if method["lon"] is not None and method["yaw"] is None:
            yield f"{METHOD_NAMES.get(name, name)} does not estimate yaw: its AR is that of the other axes."


def _drift(hidden: Metrics) -> Iterator[str]:
    end = hidden["end_horizontal_m"]
    if end["p50"] is not None:
        yield (
            f"Horizontal error at the end of {hidden['stretches']} stretches of {hidden['length_s']:g} s: "
            f"median {end['p50']:.3f} m, 95 % {end['p95']:.3f} m, largest {end['max']:.3f} m; "
            f"error over sigma, rms {hidden['end_error_over_sigma_rms']:.2f}."
        )
    if hidden["without_end"]:
        yield f"{hidden['without_end']} stretches have no fixed fix or no state at their end."


def bench_table(result: Metrics) -> Table:
    """A benchmark's rows, how many times a peer egoloc makes, and the other ratios on lines of their own."""
    table = _bare_table(2)
    table.add_column("name")
    table.add_column("metric")
    for header in ("median", "min", "max", "ratio"):
        table.add_column(header, justify="right")
    ratios = dict(result["ratios"])
    for row in result["rows"]:
        ratio = ratios.pop(row["name"], None)
        figures = [f"{row[key]:.4g}" for key in ("median", "min", "max")]
        table.add_row(row["name"], row["metric"], *figures, "" if ratio is None else f"{ratio:.3g}")
    for name, ratio in ratios.items():
        table.add_row(name, "", "", "", "", f"{ratio:.3g}")
    return table
