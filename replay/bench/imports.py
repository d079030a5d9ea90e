"""`egoloc bench imports SRC...`: maps of other formats, imported: time, size, and how exactly they come back."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from replay.bench.measure import conditions, row, times
from sensors.maps.formats import guessed, read_map
from sensors.maps.map_file import open_map
from sensors.maps.quantized import cm_from_m
from sensors.maps.store import write_map
from sensors.maps.vector_map import Elements, VectorMap


def run(sources: Sequence[Path], repeats: int = 5) -> dict[str, Any]:
    """Of each source: seconds to import (read, and write the map file), elements, km, MB/km, greatest change in cm."""
    rows: list[dict[str, Any]] = []
    formats = {}
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "map.parquet"
        for source in sources:
            formats[source.name] = guessed(source)
            rows += _rows(source, target, repeats)
    facts = {"formats": formats, "repeats": repeats}
    return {"bench": "imports", "rows": rows, "ratios": {}, "conditions": conditions(["numpy", "pyarrow"], **facts)}


def _rows(source: Path, target: Path, repeats: int) -> list[dict[str, Any]]:
    vector_map, left_out = read_map(source)
    seconds = times(lambda: write_map(read_map(source)[0], target), repeats)
    with open_map(target) as opened:
        back = opened.whole()
    km = vector_map.road_km or np.nan
    name = source.name
    return [
        row(name, "elements", [len(vector_map.elements)]),
        row(name, "left_out", [sum(entry.count for entry in left_out)]),
        row(name, "km", [km]),
        row(name, "s", seconds),
        row(name, "s_per_km", [each / km for each in seconds]),
        row(name, "mb_per_km", [target.stat().st_size / 1e6 / km]),
        row(name, "greatest_change_cm", [100.0 * _greatest_change(vector_map, back)]),
    ]


def _greatest_change(before: VectorMap, after: VectorMap) -> float:
    """Of any coordinate, m; a height that appears or vanishes is an infinite one."""
    one, other = _ordered(before.elements), _ordered(after.elements)
    if not np.array_equal(one.first, other.first):
        return np.inf
    change = np.where(np.isnan(one.xyz) & np.isnan(other.xyz), 0.0, np.abs(one.xyz - other.xyz))
    return float(np.nan_to_num(change, nan=np.inf).max(initial=0.0))


def _ordered(elements: Elements) -> Elements:
    """In an order that does not depend on tiles."""
    ends = cm_from_m(np.column_stack((elements.xyz[elements.first[:-1], :2], elements.xyz[elements.first[1:] - 1, :2])))
    keys = (*(ends + 0.0).T, np.diff(elements.first), elements.kind, elements.name)
    return elements.chosen(np.lexsort(keys))
