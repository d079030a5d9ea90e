"""A run folder's tables as arrays, ready to be drawn: thinned, cut into spans, split by sensor."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fusion.result import Health
from replay.run_files import EXPECTED, SeenManifest, SeenMetrics, checked, read_json, read_table
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]
Columns = Mapping[str, NDArray[Any]]

AXES = ("lon", "lat", "yaw")
STATES = (
    *("t_ns", "health", "x", "y", "z", "yaw", "ve", "vn", "stretch", "ref_x", "ref_y", "ref_yaw", "ref_speed"),
    *(f"{kind}_bias_{axis}" for kind in ("gyro", "accel") for axis in "xyz"),
    *(f"{kind}_{axis}" for kind in ("err", "sigma") for axis in AXES),
)
SMOOTHED = ("t_ns", "x", "y", *(f"err_{axis}" for axis in AXES))
DECISIONS = (
    *("t_ns", "sensor", "reason", "accepted", "nis", "threshold", "x", "y", "status"),
    *(f"innovation_{i}" for i in range(3)),
    *(f"innovation_sigma_{i}" for i in range(3)),
    *(f"err_{axis}" for axis in AXES),
)


@dataclass(frozen=True, slots=True, eq=False)
class RunColumns:
    """One run.

    states: STATES, each (N,), "health" as codes of Health; sensors: name -> DECISIONS without "sensor", each (M,),
    "reason" as codes into `reasons`; metrics, manifest, config: the files as they stand; smoothed: SMOOTHED, None where
    the run was not.
    """

    name: str
    states: Columns
    sensors: Mapping[str, Columns]
    reasons: Sequence[str]
    metrics: Mapping[str, Any]
    manifest: Mapping[str, Any]
    config: Mapping[str, Any]
    smoothed: Columns | None = None

    def code(self, reason: str) -> int:
        """The code of a reason; -1 where no row of the run has it."""
        return self.reasons.index(reason) if reason in self.reasons else -1

    def span_ns(self) -> tuple[int, int] | None:
        """First and last stamp of anything in the run; None where it holds nothing."""
        stamps = [rows["t_ns"] for rows in (self.states, *self.sensors.values()) if len(rows["t_ns"])]
        return (min(int(t.min()) for t in stamps), max(int(t.max()) for t in stamps)) if stamps else None


def load_columns(run: Path) -> RunColumns:
    """The tables and facts of a run folder; EgolocError names the file and column that is missing."""
    if not run.is_dir():
        raise EgolocError(f"{run}: {EXPECTED}")
    states = read_table(run / "states.parquet", STATES)
    has_smoothed = (run / "smoothed.parquet").is_file()
    smoothed = read_table(run / "smoothed.parquet", SMOOTHED) if has_smoothed else None
    decisions = read_table(run / "decisions.parquet", DECISIONS)
    sensor, sensor_names = _codes(decisions["sensor"])
    reason, reasons = _codes(decisions["reason"])
    columns = {name: _array(decisions[name]) for name in DECISIONS if name not in {"sensor", "reason"}}
    columns["reason"] = reason
    order = np.argsort(columns["t_ns"], kind="stable")
    by_sensor = {}
    for code, name in enumerate(sensor_names):
        rows = order[sensor[order] == code]
        if len(rows):
            by_sensor[name] = {key: column[rows] for key, column in columns.items()}
    return RunColumns(
        name=run.resolve().name,
        states={name: _codes_of(states[name], Health) if name == "health" else _array(states[name]) for name in STATES},
        sensors=by_sensor,
        reasons=reasons,
        metrics=_read_checked(run / "metrics.json", SeenMetrics),
        manifest=_read_checked(run / "manifest.json", SeenManifest),
        config=_read_toml(run / "config.toml"),
        smoothed=None if smoothed is None else {name: _array(smoothed[name]) for name in SMOOTHED},
    )


def thin(t_ns: Nanoseconds, hz: float = 20.0, marks: NDArray[Any] | None = None) -> NDArray[np.intp]:
    """Rows to draw, at most `hz` a second: the first of each period, and every change of mark."""
    if not len(t_ns):
        return np.empty(0, np.intp)
    period = t_ns // round(NS_PER_S / hz)
    new = np.r_[True, period[1:] != period[:-1]]
    if marks is not None:
        new[1:] |= marks[1:] != marks[:-1]
    return np.flatnonzero(new)


def gaps(t_ns: Nanoseconds, periods: float = 3.0, least_ns: int = NS_PER_S) -> NDArray[np.intp]:
    """Rows that follow a pause longer than `periods` median periods and `least_ns`."""
    if len(t_ns) < 2:
        return np.empty(0, np.intp)
    steps = np.diff(t_ns)
    return np.flatnonzero(steps > max(periods * float(np.median(steps)), least_ns)) + 1


def spans(t_ns: Nanoseconds, codes: NDArray[Any]) -> tuple[Nanoseconds, NDArray[np.int64]]:
    """Where a lane changes: (K,) stamps and codes, -1 over pauses and from the end on.

    A pause starts one median period after its last row.
    """
    if not len(t_ns):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    hold = int(np.median(np.diff(t_ns))) if len(t_ns) > 1 else NS_PER_S
    after = gaps(t_ns)
    stamps = np.r_[t_ns, t_ns[after - 1] + hold, t_ns[-1] + hold]
    values = np.r_[codes.astype(np.int64), np.full(len(after) + 1, -1)]
    order = np.argsort(stamps, kind="stable")
    stamps, values = stamps[order], values[order]
    changes = np.r_[True, values[1:] != values[:-1]]
    return stamps[changes], values[changes]


def strips(t_ns: Nanoseconds, points: Floats) -> list[Floats]:
    """Lines through (N, D) points, cut at pauses and at rows that are not finite."""
    finite = np.isfinite(points).all(axis=1)
    t, kept = t_ns[finite], points[finite]
    return [part for part in np.split(kept, gaps(t)) if len(part) > 1]


def _read_checked(path: Path, kind: type[SeenMetrics] | type[SeenManifest]) -> dict[str, Any]:
    """A JSON object, whole, whose part of a kind is as it should be."""
    content = read_json(path)
    checked(content, kind, path)
    return content


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text())
    except FileNotFoundError:
        raise EgolocError(f"{path}: missing: {EXPECTED}") from None
    except ValueError as error:
        raise EgolocError(f"{path}: expected TOML: {error}") from None


def _codes(column: pa.ChunkedArray) -> tuple[NDArray[np.int64], list[str]]:
    """(N,) codes and the names they stand for."""
    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    array = column.unify_dictionaries().combine_chunks()
    return array.indices.to_numpy(zero_copy_only=False).astype(np.int64), array.dictionary.to_pylist()


def _codes_of(column: pa.ChunkedArray, known: type[IntEnum]) -> NDArray[np.int64]:
    """(N,) members of an enumeration."""
    codes, names = _codes(column)
    return np.array([known[name.upper()] for name in names], np.int64)[codes]


def _array(column: pa.ChunkedArray) -> NDArray[Any]:
    """(N,) numbers; a null is NaN, or -1 among integers."""
    if pa.types.is_integer(column.type) and column.null_count:
        column = column.fill_null(-1)
    result: NDArray[Any] = column.to_numpy()
    return result
