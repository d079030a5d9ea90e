"""`egoloc bench maps`: map files by size (by kind and by column), opening, and queries, on made-up cities.

Sizes are those of a small city. The large map is opened in a fresh process (first opening), and asked for what lies
within 100 m of places on its streets: each with nothing of it decoded before, and again at once.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from replay.bench.map_opening import first_opening
from replay.bench.measure import conditions, row, times
from sensors.maps.columns import SURFEL
from sensors.maps.map_file import MapFile, open_map
from sensors.maps.store import bytes_by_kind, write_map
from sensors.maps.vector_map import NO_SURFELS, VectorMap
from sensors.simulate.city_map import city_map

RADIUS_M = 100.0
PLACES = 200
_SMALL_KM = 20.0
_SEED = 1
_OPENINGS = 5


def run(repeats: int = 3, km: float = 1000.0) -> dict[str, Any]:
    """Sizes, and of a map with so many km of streets the time to open and to ask; times: least over the repeats."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.parquet"
        sizes = _sizes(path, city_map(min(km, _SMALL_KM), _SEED))
        large = city_map(km, _SEED)
        start = time.perf_counter()
        write_map(large, path)
        rows = [
            *sizes,
            row("write", "s", [time.perf_counter() - start]),
            *_opening(path),
            *_queries(path, large, repeats),
        ]
        with open_map(path) as opened:
            facts = {
                "km": large.road_km,
                "tiles": len(opened.boxes),
                "bytes": path.stat().st_size,
                "rows": opened.facts.counts,
                "queries": f"{PLACES} places, radius {RADIUS_M:.0f} m; the file is in the system's cache",
                "repeats": repeats,
            }
    return {"bench": "maps", "rows": rows, "ratios": {}, "conditions": conditions(["numpy", "pyarrow"], **facts)}


def _sizes(path: Path, city: VectorMap) -> list[dict[str, Any]]:
    """MB a kilometre of files with one kind alone, with all elements, with the surfels too, and of its columns."""
    assert city.road_km is not None
    found = bytes_by_kind(city)
    elements = VectorMap(city.frame, city.elements, NO_SURFELS, city.sources, city.road_km)
    for name, part in (("elements", elements), ("all", city)):
        write_map(part, path)
        found[name] = path.stat().st_size
    with open_map(path) as opened:
        columns = opened.column_bytes()
    scale = 1e6 * city.road_km
    return [
        *(row(name, "mb_per_km", [size / scale]) for name, size in found.items()),
        *(row(f"all, {name}", "mb_per_km", [size / scale]) for name, size in columns.items()),
        row(SURFEL, "per_km", [len(city.surfels) / city.road_km]),
    ]


def _opening(path: Path) -> list[dict[str, Any]]:
    first = [first_opening(path) for _ in range(_OPENINGS)]
    return [
        row("first opening", "s", [seconds for seconds, _ in first]),
        row("first opening", "memory_mb", [grown for _, grown in first]),
        row("opening", "s", times(lambda: open_map(path).close(), _OPENINGS)),
    ]


def _queries(path: Path, large: VectorMap, repeats: int) -> list[dict[str, Any]]:
    """Milliseconds of queries with nothing of their place decoded, by the clock and of CPU, and of the same once more.

    The first ones go from place to place in a file that keeps no tile but the last.
    """
    rng = np.random.default_rng(_SEED)
    places = large.surfels.p[rng.integers(len(large.surfels), size=PLACES)]
    spent = np.full((3, PLACES), np.inf)
    with open_map(path, cache_mb=0.0) as forgetful, open_map(path) as opened:
        for _ in range(repeats):
            for place, (x, y) in enumerate(places):
                begin = time.thread_time()
                wall = _seconds(forgetful, x, y)
                worked = time.thread_time() - begin
                opened.around(x, y, RADIUS_M)
                spent[:, place] = np.minimum(spent[:, place], (wall, worked, _seconds(opened, x, y)))
    first, worked_ms, cached = (1e3 * spent).tolist()
    return [
        row("query, first", "ms", first),
        row("query, first", "cpu_ms", worked_ms),
        row("query, cached", "ms", cached),
    ]


def _seconds(opened: MapFile, x: float, y: float) -> float:
    """How long a query takes."""
    start = time.perf_counter()
    opened.around(x, y, RADIUS_M)
    return time.perf_counter() - start
