"""The table of two runs side by side."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from replay.compare import LEAST_PAIRS
from replay.table import METHOD_NAMES, UNITS, bare_table, output_console, percent

Row = Mapping[str, Any]

SHARES = {"ar": "AR %", "coverage": "coverage %"}


def print_comparison(comparison: Mapping[str, Any], console: Console | None = None) -> None:
    """Print it; plain text where the output is no terminal."""
    (console or output_console()).print(render_comparison(comparison))


def render_comparison(comparison: Mapping[str, Any]) -> RenderableType:
    """Every figure of the methods that differ, overall and by slice; then the conditions."""
    rows: Sequence[Row] = comparison["rows"]
    differing = [method for method in METHOD_NAMES if any(r["difference"] for r in rows if r["method"] == method)]
    shown = [row for row in rows if row["method"] in differing]
    parts: list[RenderableType] = [_table(shown), ""] if shown else []
    return Group(*parts, *(Text(note) for note in _notes(comparison, differing)))


def _table(rows: Sequence[Row]) -> Table:
    table = bare_table(2)
    table.add_column("slice", no_wrap=True)
    table.add_column("pairs", justify="right", no_wrap=True)
    for header in ("method", "figure"):
        table.add_column(header, no_wrap=True)
    for header in ("A", "B", "B - A", "from", "to"):
        table.add_column(header, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    before: tuple[Any, ...] = (None, None)
    for row in rows:
        place = (row["slice"], row["tag"]), row["method"]
        named = (_slice(row), f"{row['pairs']:,}") if place[0] != before[0] else ("", "")
        method = METHOD_NAMES[row["method"]] if place != before else ""
        table.add_row(*named, method, _figure(row["figure"]), *_numbers(row), "*" if row["significant"] else "")
        before = place
    return table


def _slice(row: Row) -> str:
    if row["slice"] == "all":
        return "all"
    return str(row["tag"]) if row["slice"] == "scene" else f"mode: {row['tag']}"


def _figure(name: str) -> str:
    """``lon_mae`` as ``lon m MAE``."""
    axis, _, what = name.partition("_")
    return SHARES.get(name) or f"{UNITS[axis]} {what.upper()}"


def _numbers(row: Row) -> list[str]:
    """A, B, the difference and its interval; shares in per cent."""
    share = row["figure"] in SHARES
    factor, digits = (100, 3) if share else (1, 4)
    plain = [percent(row[key], 3) if share else f"{row[key]:.4f}" for key in ("a", "b")]
    ends = ["-" if row[key] is None else f"{factor * row[key]:+.{digits}f}" for key in ("difference", "low", "high")]
    return plain + ends


def _notes(comparison: Mapping[str, Any], differing: Sequence[str]) -> Iterator[str]:
    yield f"A: {comparison['a']}"
    yield f"B: {comparison['b']}"
    present = dict.fromkeys(row["method"] for row in comparison["rows"])
    equal = [METHOD_NAMES[method] for method in present if method not in differing]
    if equal:
        yield f"Equal in every figure: {', '.join(equal)}."
    yield (
        f"Over the {comparison['pairs']:,} segments of 60 s that both evaluated; only A: {comparison['only_a']:,}, "
        f"only B: {comparison['only_b']:,}, left out."
    )
    if not differing:
        return
    yield (
        f"from, to: the middle {100 * comparison['confidence']:g} % of the differences in {comparison['resamples']:,} "
        f"resamples of these pairs (paired bootstrap, seed {comparison['seed']}), where there are {LEAST_PAIRS}; "
        "*: the interval excludes zero."
    )
