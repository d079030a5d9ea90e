"""The tables of ``egoloc map info``."""

from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from replay.map_info import UNITS
from replay.table import DASH, bare_table, number, percent

WORDS = {"lon": "longitudinal", "lat": "lateral", "yaw": "yaw"}


def info_tables(info: Mapping[str, Any]) -> Group:
    """Size by kind, predicted sigmas, the longest degenerate stretches, and notes."""
    parts: list[RenderableType] = [_heading(info), "", _sizes(info), ""]
    found = info["localizability"]
    if found is not None:
        parts += [_sigmas(found), ""]
        if found["stretches"]:
            parts += [_stretches(found["stretches"]), ""]
    return Group(*parts, *(Text(note) for note in _notes(info)))


def _heading(info: Mapping[str, Any]) -> Text:
    frame = info["frame"]
    where = f"UTM zone {frame['zone']}{'S' if frame['south'] else 'N'}" if frame["kind"] == "utm" else "local plane"
    km = f"{info['km']:,.2f} km of road" if info["km"] else "length of road unknown"
    return Text(f"{info['map']}: {km}, {info['bytes'] / 1e6:,.3f} MB, {where}", style="bold")


def _sizes(info: Mapping[str, Any]) -> Table:
    table = bare_table(2)
    table.add_column("kind")
    for header in ("elements", "per km", "MB/km"):
        table.add_column(header, justify="right")
    for kind, count in info["elements"].items():
        if count:
            per_km = f"{count / info['km']:,.1f}" if info["km"] else DASH
            table.add_row(kind.replace("_", " "), f"{count:,}", per_km, number(info["mb_per_km_by_type"][kind], 4))
    total = sum(info["elements"].values())
    per_km = f"{total / info['km']:,.1f}" if info["km"] else DASH
    table.add_row("all, one file", f"{total:,}", per_km, number(info["mb_per_km"], 4))
    return table


def _sigmas(found: Mapping[str, Any]) -> Table:
    table = bare_table(2)
    table.add_column("predicted sigma")
    for header in ("median", "95 %", "largest", "degenerate %", "beyond"):
        table.add_column(header, justify="right")
    for axis, word in WORDS.items():
        unit = UNITS[axis]
        figures = [number(found["sigma"][unit][key], 3) for key in ("p50", "p95", "max")]
        share = percent(found["degenerate"][axis])
        table.add_row(f"{word}, {unit.partition('_')[2]}", *figures, share, number(found["degenerate_beyond"][unit], 3))
    return table


def _stretches(rows: list[Mapping[str, Any]]) -> Table:
    table = bare_table(2)
    table.add_column("degenerate stretch")
    for header in ("length m", "sigma", "x m", "y m", "latitude", "longitude"):
        table.add_column(header, justify="right")
    for row in rows:
        unit = UNITS[row["axis"]].partition("_")[2]
        sigma = f"{row[f'sigma_max_{unit}']:.2f} {unit}"
        place = [f"{row[key]:.6f}" if key in row else DASH for key in ("lat_deg", "lon_deg")]
        where = (f"{row['x']:.0f}", f"{row['y']:.0f}")
        table.add_row(WORDS[row["axis"]], f"{row['length_m']:,.0f}", sigma, *where, *place)
    return table


def _notes(info: Mapping[str, Any]) -> Iterator[str]:
    """What the figures are of."""
    found = info["localizability"]
    if info["km_source"] == "lines":
        yield "Length of road: of the lines along it, as the map does not say."
    if not info["km"]:
        yield "MB/km is not known: neither the map nor its lines tell the length of road."
    yield "MB/km of a kind: of a file with that kind alone" + (
        "." if info["weighed"] == "whole" else ", from samples of the map."
    )
    if found is None:
        yield "Localizability is not predicted: the map has no lane line or road boundary to drive along."
        return
    yield (
        f"Localizability: of {found['poses']:,} poses over {found['route_km']:,.2f} km of {found['route']}; a lower "
        "bound on a clear day and an empty road, nothing hidden (docs/maps.md)."
    )
    yield f"Degenerate along at least one axis: {percent(found['degenerate']['any'])} % of the way."
    yield from (f"Source: {source}." for source in info["sources"])
