"""What is in a map file, how large it is, and how well a vehicle would be localized along it."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from replay.config import Limits
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame, llh_from_map
from sensors.maps.columns import KINDS, SURFEL
from sensors.maps.evidence import Model
from sensors.maps.joining import joined_elements, joined_surfels
from sensors.maps.localizability import AXES, Localizability, along
from sensors.maps.map_file import MapFile
from sensors.maps.placing import LOCAL
from sensors.maps.route import Route, route_of_map, route_of_trajectory
from sensors.maps.store import bytes_by_kind
from sensors.maps.vector_map import VectorMap
from sensors.pieces import joined
from sensors.records import Trajectory

Info = dict[str, Any]

WORST = 5
"""Degenerate stretches that are listed, the longest of each axis."""
WHOLE_ROWS = 400_000
"""A map with more elements and surfels is weighed by samples: all of it would not fit into memory."""
SAMPLES = 8
"""Places at which a large map is weighed, each with what lies within SAMPLE_M of it."""
SAMPLE_M = 400.0
UNITS = {"lon": "lon_m", "lat": "lat_m", "yaw": "yaw_deg"}
SCALE = np.array([1.0, 1.0, 180.0 / np.pi])


def route_of(opened: MapFile, source: Path | None) -> Route:
    """Where a map is judged: along its own lines, a trajectory file, a run's smoothed states or a log's reference.

    Raises EgolocError where that cannot be read, has no reference, or is in another frame or place than the map.
    """
    if source is None:
        return route_of_map(opened)
    from sensors.datasets.run_trajectory import is_parquet, read_run_trajectory
    from sensors.datasets.trajectory_file import read_trajectory

    if source.suffix.lower() == ".mcap":
        trajectory, frame = _log_reference(source)
    elif is_parquet(source):
        trajectory, frame = read_run_trajectory(source, None, np.zeros(3))
    else:
        trajectory, frame = read_trajectory(source, opened.frame)
    return route_of_trajectory(trajectory, str(source), opened, frame)


def _log_reference(path: Path) -> tuple[Trajectory, MapFrame | None]:
    """The reference of a log and the frame that it is in; what else the log holds is let go of."""
    from sensors.mcap.io import read_pieces

    pieces = [(piece.reference, piece.map_frame) for piece in read_pieces(path)]
    parts = [part for part, _ in pieces if part is not None and len(part)]
    if not parts:
        raise EgolocError(f"{path}: expected a log with a reference, as a route along the map")
    return joined(parts), pieces[0][1]


def map_info(
    opened: MapFile,
    route: Route,
    found: Localizability,
    route_file: Path | None = None,
    limits: Limits | None = None,
    model: Model | None = None,
) -> Info:
    """All that ``egoloc map info`` says; found: of the poses of the route. km is the map's own, else that of the lines
    which the route follows (km_source "lines"), else null and so are the ratios.
    """
    facts, size = opened.facts, opened.path.stat().st_size
    km, km_source = facts.road_km or None, "map"
    if km is None and route_file is None and len(route):
        km, km_source = route.km, "lines"
    weights, weighed = kind_bytes(opened)
    return {
        "map": str(opened.path),
        "km": km,
        "km_source": km_source if km else None,
        "elements": dict(facts.counts),
        "bytes": size,
        "mb_per_km": size / 1e6 / km if km else None,
        "mb_per_km_by_type": {kind: count / 1e6 / km if km else None for kind, count in weights.items()},
        "weighed": weighed,
        "frame": msgspec.to_builtins(opened.frame),
        "sources": list(facts.sources),
        "localizability": _summary(opened, route, found, route_file, limits or Limits(), model or Model()),
    }


def kind_bytes(opened: MapFile) -> tuple[dict[str, int], str]:
    """Bytes of a file with one kind alone, by kind, and how they were found: "whole" or "samples".

    Of a large map what lies about some of its places is weighed, and counted up by the number of each kind.
    """
    counts = opened.facts.counts
    if sum(counts.values()) <= WHOLE_ROWS:
        return bytes_by_kind(opened.whole(), opened.facts.tile_m), "whole"
    parts = [opened.around(x, y, SAMPLE_M) for x, y in _apart((opened.boxes[:, :2] + opened.boxes[:, 2:]) / 2.0)]
    elements, surfels = joined_elements([part[0] for part in parts]), joined_surfels([part[1] for part in parts])
    sample = VectorMap(opened.frame, elements, surfels, opened.facts.sources)
    seen = dict(zip(KINDS, np.bincount(elements.kind, minlength=len(KINDS)).tolist(), strict=True))
    seen[SURFEL] = len(surfels)
    sizes = bytes_by_kind(sample, opened.facts.tile_m)
    return {kind: round(size * counts[kind] / max(seen[kind], 1)) for kind, size in sizes.items()}, "samples"


def _apart(middles: NDArray[np.float64]) -> list[tuple[float, float]]:
    """SAMPLES of (T, 2) places at most, spread; what lies about them does not overlap (twice weighs nothing)."""
    chosen: list[tuple[float, float]] = []
    spread = np.argsort(np.arange(len(middles)) * 0.618034 % 1.0)  # the golden section: any first few are well spread
    for x, y in middles[spread].tolist():
        if len(chosen) < SAMPLES and all(math.hypot(x - a, y - b) > 2.0 * SAMPLE_M for a, b in chosen):
            chosen.append((x, y))
    return chosen


def _summary(
    opened: MapFile, route: Route, found: Localizability, route_file: Path | None, limits: Limits, model: Model
) -> Info | None:
    """Of the poses; None: there are none."""
    if not len(route):
        return None
    wrong = degenerate(found, limits, model)
    sigma = found.sigma * SCALE
    percentiles = np.percentile(sigma, [50, 95, 100], axis=0).T.tolist()
    return {
        "route": "lines of the map" if route_file is None else str(route_file),
        "route_km": route.km,
        "poses": len(route),
        "sigma": {
            UNITS[axis]: dict(zip(("p50", "p95", "max"), row, strict=True))
            for axis, row in zip(AXES, percentiles, strict=True)
        },
        "degenerate": {
            **dict(zip(AXES, wrong.mean(axis=0).tolist(), strict=True)),
            "any": float(wrong.any(axis=1).mean()),
        },
        "degenerate_beyond": {UNITS[axis]: model.share * float(getattr(limits, UNITS[axis])) for axis in AXES},
        "stretches": stretches(opened, route, found, wrong),
        "model": msgspec.to_builtins(model),
    }


def degenerate(found: Localizability, limits: Limits, model: Model) -> NDArray[np.bool_]:
    """(N, 3) axes along which a pose would not be known well enough."""
    return found.degenerate((limits.lon_m, limits.lat_m, math.radians(limits.yaw_deg)), model.share)


def stretches(
    opened: MapFile, route: Route, found: Localizability, wrong: NDArray[np.bool_]
) -> list[Mapping[str, Any]]:
    """The longest stretches without a break that are degenerate along an axis, WORST of each: where and how badly."""
    result: list[Mapping[str, Any]] = []
    for column, axis in enumerate(AXES):
        edges = np.diff(np.concatenate(([0], wrong[:, column].astype(np.int8), [0])))
        begin, end = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
        breaks = np.flatnonzero(np.diff(route.way)) + 1
        inner = breaks[wrong[breaks, column] & wrong[breaks - 1, column]]
        begin, end = np.sort(np.concatenate((begin, inner))), np.sort(np.concatenate((end, inner)))
        worst = np.argsort(begin - end, kind="stable")[:WORST]
        result += [_stretch(opened, route, found, axis, int(begin[i]), int(end[i])) for i in worst]
    return result


def _stretch(opened: MapFile, route: Route, found: Localizability, axis: str, begin: int, end: int) -> Info:
    """One, by the place in its middle."""
    middle = (begin + end) // 2
    x, y = route.xy[middle].tolist()
    column = AXES.index(axis)
    stretch: Info = {
        "axis": axis,
        "length_m": (end - begin) * route.spacing_m,
        "x": x,
        "y": y,
        f"sigma_max_{UNITS[axis].partition('_')[2]}": float(found.sigma[begin:end, column].max() * SCALE[column]),
        "weakest_deg": math.degrees(float(found.weakest[middle])),
    }
    if opened.frame != LOCAL:
        lat, lon, _ = np.degrees(llh_from_map(opened.frame, [[x, y, 0.0]])[0]).tolist()
        stretch |= {"lat_deg": lat, "lon_deg": lon}
    return stretch


def judged_map(
    opened: MapFile, route_file: Path | None = None, model: Model | None = None
) -> tuple[Route, Localizability]:
    """The route of a map and what is predicted along it."""
    route = route_of(opened, route_file)
    return route, along(opened, route.xy, route.heading, model)
