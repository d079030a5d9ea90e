"""The table of a run, laid out as the EgoVM paper's Table 5, and what was left out of it."""

from collections.abc import Iterator, Mapping
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from replay.calibration import calibration_notes
from replay.health import health_note
from replay.segments import AXES, THRESHOLDS

Metrics = Mapping[str, Any]

WIDE = 120
"""Columns from which everything stands in one table."""
PLAIN_WIDTH = 132
"""Columns taken where the output is no terminal."""
UNITS = {"lon": "lon m", "lat": "lat m", "yaw": "yaw deg"}
DASH = "-"
MANY = 1000.0
"""Numbers from here on are written with an exponent, so that no column is cut off."""
MOST_STRETCHES = 40
"""Tables of hidden stretches that are longer than this are left to metrics.json."""
MOST_EXAMPLES = 3
"""Warnings of a kind that are printed of a campaign."""

METHOD_NAMES = {"gnss": "GNSS-RTK", "egovm": "EgoVM", "fusion": "Fusion", "smoothed": "Smoothed"}

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
    """Methods side by side, hidden stretches and slices if any, then warnings and notes."""
    groups = [("lon", "lat", "yaw")] if width >= WIDE else [("lon", "lat"), ("yaw",)]
    parts: list[RenderableType] = []
    for axes in groups:
        parts += [_method_table(metrics, axes, gap=2 if width >= WIDE else 1), ""]
    if "hidden" in metrics and len(metrics["hidden"]["per_stretch"]) <= MOST_STRETCHES:
        parts += [_stretch_table(metrics["hidden"]), ""]
    if metrics["slices"]:
        parts += [_slice_table(metrics, wide=width >= WIDE), ""]
    warnings = [Text(f"WARNING: {text}", style="bold red") for text in _warnings(metrics)]
    return Group(*parts, *warnings, *(Text(note) for note in notes(metrics)))


def _warnings(metrics: Metrics) -> Iterator[str]:
    """One line each; of a campaign, how many logs a kind concerns, and examples."""
    if "logs" not in metrics:
        yield from (entry["text"] for entry in metrics["warnings"])
        return
    for kind, count in metrics["warning_counts"].items():
        yield f"{kind.replace('_', ' ')}: {count} of {metrics['logs']['done']} logs"
        examples = [entry for entry in metrics["warnings"] if entry["kind"] == kind]
        yield from (f"  {entry['log']}: {entry['text']}" for entry in examples[:MOST_EXAMPLES])


def notes(metrics: Metrics) -> Iterator[str]:
    """Lines on what was scored, against what, and what was left out."""
    limits = metrics["limits"]
    yield (
        f"AR: share of time with errors below {limits['lon_m']:g} m longitudinal, {limits['lat_m']:g} m lateral, "
        f"{limits['yaw_deg']:g} deg yaw; cov: share with output; all in %, 100: without exception."
    )
    if "logs" in metrics:
        yield _logs(metrics["logs"])
    yield _scored(metrics)
    yield from _unestimated(metrics)
    if "hidden" in metrics:
        yield from _drift(metrics["hidden"])
    if metrics["alignment_s"] is not None:  # else a warning says so
        within = ", the slowest log" if "logs" in metrics else ""
        yield f"Aligned {metrics['alignment_s']:.1f} s after the first IMU sample{within}."
    if metrics["health"]:
        yield health_note(metrics["health"])
    yield from calibration_notes(metrics.get("estimates", ()))
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
    table = bare_table(gap)
    table.add_column("\nmethod", no_wrap=True)
    for header in ("\nAR", "\ncov") if first else ():
        table.add_column(header, justify="right", no_wrap=True)
    for axis in axes:
        for header in axis_headers(axis):
            table.add_column(header, justify="right", no_wrap=True)
    for name, method in metrics["methods"].items():
        shares = [percent(method["ar"], ar_digits(metrics)), percent(method["coverage"])] if first else []
        cells = [cell for axis in axes for cell in axis_cells(method[axis])]
        table.add_row(METHOD_NAMES.get(name, name), *shares, *cells)
    return table


def bare_table(gap: int) -> Table:
    """A table with one line below its head and gap (1 or more) blanks between columns."""
    return Table(box=box.SIMPLE_HEAD, padding=(0, gap - 1, 0, 0), pad_edge=False, show_edge=False, header_style="bold")


def axis_headers(axis: str) -> list[str]:
    return [f"{UNITS[axis]}\nMAE", "\nRMSE", *(f"%\n<{threshold:g}" for threshold in THRESHOLDS[axis])]


def axis_cells(axis: Metrics | None, digits: int = 1) -> list[str]:
    """MAE, RMSE and the shares below the thresholds, in % with so many digits."""
    if axis is None:
        return [DASH] * 5
    return [
        number(axis["mae"], 3),
        number(axis["rmse"], 3),
        *(percent(share, digits) for share in axis["below"].values()),
    ]


def _slice_table(metrics: Metrics, *, wide: bool) -> Table:
    """Exposure and figures by scene tag and by drive mode; without RMSE where it is narrow."""
    table = bare_table(2 if wide else 1)
    for header in ("\nslice", "\nmethod"):
        table.add_column(header, no_wrap=True)
    errors = [(axis, figure) for axis in AXES for figure in (("mae", "rmse") if wide else ("mae",))]
    headers = [f"{UNITS[axis] if figure == 'mae' else ''}\n{figure.upper()}" for axis, figure in errors]
    for header in ("\nh", "\nkm", "\nAR", "\ncov", *headers):
        table.add_column(header, justify="right", no_wrap=True)
    digits = 2 if metrics["duration_s"] >= 3600 else 3
    for kind, tags in metrics["slices"].items():
        for tag, part in tags.items():
            exposure = (f"{part['hours']:.{digits}f}", f"{part['km']:.{digits - 1}f}")
            for i, (name, method) in enumerate(part["methods"].items()):
                first = (tag if kind == "scene" else f"{kind}: {tag}", exposure) if i == 0 else ("", ("", ""))
                cells = [number(method[axis] and method[axis][figure], 3) for axis, figure in errors]
                shares = (percent(method["ar"], ar_digits(metrics)), percent(method["coverage"]))
                table.add_row(first[0], METHOD_NAMES.get(name, name), *first[1], *shares, *cells)
    return table


def _logs(logs: Metrics) -> str:
    failed = f"; {len(logs['failed'])} failed and are not in these figures" if logs["failed"] else ""
    return f"Logs: {logs['done']} of {logs['total']}{failed}."


def ar_digits(metrics: Metrics) -> int:
    """Of availability ratios: those of campaigns tell 99.99 from 99.999 %."""
    return 3 if "logs" in metrics else 2


def percent(share: float | None, digits: int = 1) -> str:
    """Per cent; only the whole is printed as 100."""
    if share is None:
        return DASH
    return "100" if share >= 1 else f"{min(100 * share, 100 - 10**-digits):.{digits}f}"


def _stretch_table(hidden: Metrics) -> Table:
    """Every stretch without GNSS: when, how far off at its end and, of a smoothed drive, at worst before and after."""
    table = bare_table(2)
    named = any("log" in entry for entry in hidden["per_stretch"])  # a campaign's
    if named:
        table.add_column("\nlog", no_wrap=True)
    for header in ("hidden from\ns", "end error\nm", "sigma\nm", "error/\nsigma", "since GNSS\ns"):
        table.add_column(header, justify="right", no_wrap=True)
    for header in ("largest\nm", "smoothed\nm", "error/\nsigma") if "smoothed" in hidden else ():
        table.add_column(header, justify="right", no_wrap=True)
    for entry in hidden["per_stretch"]:
        error, sigma, since = entry["end_horizontal_m"], entry["end_sigma_m"], entry["since_gnss_s"]
        ratio = DASH if error is None else number(error / sigma, 2)
        cells = (f"{entry['start_s']:.1f}", number(error, 3), number(sigma, 3), ratio, number(since, 1))
        worst = _worst(entry) if "smoothed" in hidden else ()
        table.add_row(*([entry["log"]] if named else []), *cells, *worst)
    return table


def _worst(entry: Metrics) -> tuple[str, str, str]:
    """The largest error of a stretch, that of the smoothed states, and the rms of their error over sigma."""
    before, after = entry.get("within") or {}, entry.get("smoothed") or {}
    worst, smoothed = (number(found.get("largest_horizontal_m"), 3) for found in (before, after))
    return worst, smoothed, number(after.get("error_over_sigma_rms"), 2)


def number(value: float | None, digits: int) -> str:
    """Fixed digits as long as the column holds them."""
    if value is None:
        return DASH
    return f"{value:.{digits}f}" if abs(value) < MANY else f"{value:.1e}"


def _scored(metrics: Metrics) -> str:
    reference = metrics["reference"]
    if reference["kind"] is None:
        return "Not evaluated: the log has no reference (see --reference and --hide-gnss)."
    heading = "" if reference["heading"] == "attitude" else ", which has no heading: axes from its course"
    amount = _amount(metrics)
    against = f"against {reference['kind']}{heading}"
    if all(method["ar"] is None for method in metrics["methods"].values()):
        return f"Not evaluated: too little reference: {amount} {against}."
    where = ", at the antenna in the hidden stretches" if "hidden" in metrics else ""
    return f"Scored: {amount} {against}{where}; the filter's state at each time, in {metrics['order']} order."


def _amount(metrics: Metrics) -> str:
    """How much was scored; hours once it is more than one."""
    seconds, km = metrics["duration_s"], metrics["distance_m"] / 1000
    if seconds < 3600:
        return f"{metrics['epochs']} epochs, {seconds:.1f} s, {km:.3f} km"
    return f"{metrics['epochs']:,} epochs, {seconds / 3600:,.2f} h, {km:,.1f} km"


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
    if hidden.get("smoothed", {}).get("error_over_sigma_rms") is not None:
        before, after = hidden["largest_horizontal_m"], hidden["smoothed"]["largest_horizontal_m"]
        yield (
            f"Largest horizontal error within them: median {before['p50']:.3f} m, largest {before['max']:.3f} m; "
            f"smoothed: median {after['p50']:.3f} m, largest {after['max']:.3f} m, error over sigma, rms "
            f"{hidden['smoothed']['error_over_sigma_rms']:.2f}."
        )
    if hidden["without_end"]:
        yield f"{hidden['without_end']} stretches have no fixed fix or no state at their end."


def bench_table(result: Metrics) -> Table:
    """A benchmark's rows, how many times a peer egoloc makes, and the other ratios on lines of their own."""
    table = bare_table(2)
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
