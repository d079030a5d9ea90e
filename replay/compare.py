"""Two runs side by side: differences with intervals from a paired bootstrap over their common segments.

A pair is a segment (a minute of a log) that both runs evaluated. A resample draws as many pairs as there are, with
replacement, and forms every figure of both runs anew from the sums of the pairs drawn; the interval holds the middle
95 % of the differences (percentile bootstrap, Efron & Tibshirani 1993, ch. 13).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay._kernels import sum_drawn
from replay.campaign_folder import is_campaign, log_names
from replay.run_files import EXPECTED, read_json
from replay.segments import AXES, METHODS, Segments, tags
from replay.sums import Counts, read_segments
from sensors.errors import EgolocError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Slice = tuple[str, str]
"""("all", ""), or "scene" or "mode" and a tag."""

SHOWN = 3
"""Logs that a message names."""
CONFIDENCE = 0.95
SUMMED = (
    *("evaluated_ns", "covered_ns", "good_ns"),
    *(f"{axis}_{what}" for axis in AXES for what in ("count", "abs", "squared")),
)
"""What the figures are formed of."""
FIGURES = ("ar", "coverage", *(f"{axis}_{what}" for axis in AXES for what in ("mae", "rmse")))
LEAST_PAIRS = 10
"""With fewer pairs a slice has no interval: resamples of so few say too little."""
CHUNK, BLOCK = 64, 128
"""Resamples at a time (memory does not follow their number), and rows for the processor's cache."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The common segments of two runs, by scene text and mode.

    pair (R,): which of `count` pairs a row belongs to; group (R,): its scene text and mode, an index into groups, in
    increasing order; sums (2, R, methods, SUMMED) of each run, zero for a method that only one evaluated in a segment;
    alone: segments that only A, only B evaluated.
    """

    count: int
    pair: Integers
    group: Integers
    groups: list[tuple[str, str]]
    sums: Floats
    alone: tuple[int, int]

    def slices(self) -> dict[Slice, Integers]:
        """The whole and every tag -> the groups that belong to it."""
        found: dict[Slice, list[int]] = {("all", ""): list(range(len(self.groups)))}
        for kind, place in (("scene", 0), ("mode", 1)):
            for tag in sorted({tag for group in self.groups for tag in tags(group[place])}):
                found[kind, tag] = [i for i, group in enumerate(self.groups) if tag in tags(group[place])]
        return {name: np.array(members) for name, members in found.items()}


def compare(a: Path, b: Path, resamples: int = 2000, seed: int = 0) -> dict[str, Any]:
    """B minus A for every method, figure and slice that both have, over the segments that both evaluated."""
    if resamples < 1:
        raise EgolocError(f"--resamples: expected at least 1, got {resamples}")
    if seed < 0:
        raise EgolocError(f"--seed: expected 0 or more, got {seed}")
    (counts, one), (others, two) = (_run(folder) for folder in (a, b))
    _check_comparable(a, counts, b, others)
    pairs = paired(one, two, by_log=_by_log(a, b))
    if not pairs.count:
        raise EgolocError(f"{a}, {b}: no common segments: expected two runs of the same logs")
    return {
        "a": str(a),
        "b": str(b),
        "limits": {"lon_m": counts.limits.lon_m, "lat_m": counts.limits.lat_m, "yaw_deg": counts.limits.yaw_deg},
        "pairs": pairs.count,
        "only_a": pairs.alone[0],
        "only_b": pairs.alone[1],
        "resamples": resamples,
        "seed": seed,
        "confidence": CONFIDENCE,
        "rows": list(_rows(pairs, resamples, seed)),
    }


def _run(folder: Path) -> tuple[Counts, Segments]:
    if not folder.is_dir():
        raise EgolocError(f"{folder}: {EXPECTED}")
    return read_segments(folder)


def _check_comparable(a: Path, one: Counts, b: Path, two: Counts) -> None:
    """Raise unless both mean the same by their figures."""
    limits = [f"{c.limits.lon_m:g} m, {c.limits.lat_m:g} m, {c.limits.yaw_deg:g} deg" for c in (one, two)]
    if limits[0] != limits[1]:
        raise EgolocError(f"{b}: limits {limits[1]}, expected those of {a}, {limits[0]}: see egoloc score --limits")
    if (one.hidden_length_s is None) != (two.hidden_length_s is None):
        raise EgolocError(f"{a}, {b}: expected hidden GNSS in both or in neither")


def _by_log(a: Path, b: Path) -> bool:
    """Whether segments are told apart by their logs: not in two runs of the same log, whatever its file was called."""
    if is_campaign(a) or is_campaign(b):
        _check_same_logs(a, b)
        return True
    one, two = (_identity(read_json(folder / "manifest.json").get("log")) for folder in (a, b))
    if one != two:
        raise EgolocError(f"{a}, {b}: no common segments: expected two runs of the same log")
    return False


def _check_same_logs(a: Path, b: Path) -> None:
    """Raise where logs of one name are not one log, as drives of a seed on other roads."""
    one, two = _identities(a), _identities(b)
    other = [name for name, log in one.items() if name in two and log != two[name]]
    if other:
        raise EgolocError(
            f"{a}, {b}: {len(other)} logs of the same name are not the same log: {', '.join(other[:SHOWN])}"
            f"{', ...' if len(other) > SHOWN else ''}"
        )


def _identities(folder: Path) -> dict[str, Any]:
    """What the manifests of a campaign's finished logs, or of a run, say of each log by its name."""
    if is_campaign(folder):
        paths = {name: folder / name / "manifest.json" for name in log_names(folder)}
        return {name: _identity(read_json(path).get("log")) for name, path in paths.items() if path.is_file()}
    manifest = read_json(folder / "manifest.json")
    return {manifest["name"]: _identity(manifest.get("log"))} if "name" in manifest else {}


def _identity(log: Any) -> Any:
    """What a manifest says of a log, without its place."""
    return {key: value for key, value in log.items() if key != "path"} if isinstance(log, dict) else log


def paired(one: Segments, two: Segments, *, by_log: bool = True) -> Pairs:
    """The segments of A and B that belong together: of the same log (unless not by_log) and the same minute."""
    logs = {name: i for i, name in enumerate(sorted({*one.texts["log"], *two.texts["log"]}))}
    keys = [_keys(table, logs if by_log else dict.fromkeys(logs, 0)) for table in (one, two)]
    common = np.intersect1d(keys[0], keys[1])
    alone = tuple(len(np.setdiff1d(own, common)) for own in keys)
    texts = sorted({*_group_texts(one), *_group_texts(two)})
    cells = [_cells(table, own, common, texts) for table, own in zip((one, two), keys, strict=True)]
    places = np.unique(np.concatenate(cells))
    places = places[places >= 0]
    sums = np.stack([_sums(table, own, places) for table, own in zip((one, two), cells, strict=True)])
    group, pair = np.divmod(places, max(len(common), 1))
    return Pairs(len(common), pair, group, texts, _where_both(sums, pair, len(common)), (alone[0], alone[1]))


def _keys(table: Segments, logs: dict[str, int]) -> Integers:
    """(R,) log and segment of each row as one number."""
    log = np.array([logs[name] for name in table.texts["log"]], np.int64)[table.columns["log"]]
    keys: Integers = (log << 32) + table.columns["segment"]
    return keys


def _group_texts(table: Segments) -> set[tuple[str, str]]:
    used = np.unique(np.stack((table.columns["scene"], table.columns["mode"])), axis=1)
    return {(table.texts["scene"][scene], table.texts["mode"][mode]) for scene, mode in used.T}


def _cells(table: Segments, keys: Integers, common: Integers, texts: list[tuple[str, str]]) -> Integers:
    """(R,) group times the number of pairs plus pair of each row; -1 where it has no partner."""
    number = {text: i for i, text in enumerate(texts)}
    scenes, modes = table.texts["scene"], table.texts["mode"]
    lookup = np.array([[number.get((scene, mode), -1) for mode in modes] for scene in scenes], np.int64)
    group = lookup.reshape(len(scenes), len(modes))[table.columns["scene"], table.columns["mode"]]
    pair = np.searchsorted(common, keys)
    return np.where(np.isin(keys, common), group * len(common) + pair, -1)


def _sums(table: Segments, cells: Integers, places: Integers) -> Floats:
    """(P, methods, SUMMED) the table's sums at each of places, zero where it has none."""
    rows = np.flatnonzero(cells >= 0)
    method = np.array([METHODS.index(name) for name in table.texts["method"]], np.int64)[table.columns["method"][rows]]
    at = np.searchsorted(places, cells[rows]) * len(METHODS) + method
    found = np.empty((len(places) * len(METHODS), len(SUMMED)))
    for i, name in enumerate(SUMMED):
        found[:, i] = np.bincount(at, table.columns[name][rows], len(found))
    return found.reshape(len(places), len(METHODS), len(SUMMED))


def _where_both(sums: Floats, pair: Integers, count: int) -> Floats:
    """The sums of Pairs without those of a method in a segment where only one of the runs evaluated it."""
    evaluated = np.zeros((2, count, len(METHODS)))
    for run, total in enumerate(evaluated):
        np.add.at(total, pair, sums[run, :, :, SUMMED.index("evaluated_ns")])
    in_both = np.all(evaluated > 0, axis=0)[pair]
    return np.where(in_both[..., None], sums, 0.0)


def figures(sums: Floats) -> Floats:
    """(..., FIGURES) of sums (..., SUMMED): shares, m or deg; NaN where there is nothing to divide by."""
    evaluated, covered, good = (sums[..., i] for i in range(3))
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = [good / evaluated, covered / evaluated]
        for axis in range(len(AXES)):
            count, size, squared = (sums[..., 3 + 3 * axis + i] for i in range(3))
            parts += [size / count, np.sqrt(squared / count)]
    return np.stack(parts, axis=-1)


def intervals(pairs: Pairs, resamples: int, seed: int) -> dict[Slice, tuple[Floats, Floats]]:
    """Lower and upper end, (methods, FIGURES) each, of B minus A in every slice."""
    slices = pairs.slices()
    found: dict[Slice, list[Floats]] = {name: [] for name in slices}
    for drawn in _resampled(pairs, resamples, seed):
        for name, members in slices.items():
            a, b = figures(drawn[:, members].sum(axis=1))
            found[name].append(b - a)
    outside = 50 * (1 - CONFIDENCE)
    return {name: _percentiles(np.concatenate(parts), (outside, 100 - outside)) for name, parts in found.items()}


def _resampled(pairs: Pairs, resamples: int, seed: int) -> Iterator[Floats]:
    """(2, groups, C, methods, SUMMED) sums of CHUNK resamples at a time."""
    rng = np.random.default_rng(seed)
    shape = pairs.sums.shape[2:]
    a, b = pairs.sums.reshape(2, len(pairs.pair), -1)
    differ = ~(a == b).all(axis=0)  # what is equal is summed once: it stays equal to the last bit
    columns = np.hstack((a, b[:, differ]))
    edges = np.searchsorted(pairs.group, np.arange(len(pairs.groups) + 1))
    for first in range(0, resamples, CHUNK):
        size = min(CHUNK, resamples - first)
        drawn = [np.bincount(rng.integers(0, pairs.count, pairs.count), minlength=pairs.count) for _ in range(size)]
        weights = np.array(drawn, np.float64)
        totals = np.zeros((len(pairs.groups), size, columns.shape[1]))
        for group, (begin, end) in enumerate(pairwise(edges.tolist())):
            sum_drawn(weights, pairs.pair[begin:end], columns[begin:end], totals[group], BLOCK)
        both = np.stack((totals[..., : a.shape[1]], totals[..., : a.shape[1]]))
        both[1][..., differ] = totals[..., a.shape[1] :]
        yield both.reshape(2, len(pairs.groups), size, *shape)


def _percentiles(values: Floats, shares: tuple[float, float]) -> tuple[Floats, Floats]:
    """Along the first axis, of the resamples that have a value; NaN where none has."""
    known = np.isfinite(values)
    ends = np.full((2, *values.shape[1:]), np.nan)
    for place in zip(*np.nonzero(known.any(axis=0)), strict=True):
        ends[:, *place] = np.percentile(values[:, *place][known[:, *place]], shares)
    return ends[0], ends[1]


def _rows(pairs: Pairs, resamples: int, seed: int) -> Iterator[dict[str, Any]]:
    """A row for every slice, method and figure that both runs have."""
    ends = intervals(pairs, resamples, seed)
    for (kind, tag), members in pairs.slices().items():
        chosen = np.isin(pairs.group, members)
        count = len(np.unique(pairs.pair[chosen]))
        whole = figures(pairs.sums[:, chosen].sum(axis=1))
        low, high = ends[kind, tag] if count >= LEAST_PAIRS else np.full((2, *whole.shape[1:]), np.nan)
        for i, method in enumerate(METHODS):
            for j, figure in enumerate(FIGURES):
                a, b = whole[:, i, j].tolist()
                if np.isfinite((a, b)).all():
                    place = {"slice": kind, "tag": tag, "pairs": count, "method": method, "figure": figure}
                    yield place | _difference(a, b, float(low[i, j]), float(high[i, j]))


def _difference(a: float, b: float, low: float, high: float) -> dict[str, Any]:
    """One figure of both runs. low, high: NaN where there is no interval."""
    known = np.isfinite(low)
    return {
        "a": a,
        "b": b,
        "difference": b - a,
        "low": low if known else None,
        "high": high if known else None,
        "significant": bool(low > 0 or high < 0),
    }
