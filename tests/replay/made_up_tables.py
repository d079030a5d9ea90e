"""Made-up batches of both tables with everything that scoring has to mind, and metrics of them worked out plainly."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.result import Reason, Sensor
from replay.config import Limits
from replay.references import Excluded
from replay.run_files import Facts
from replay.scoring import Scorer
from replay.sums import Sums
from sensors.clock import NS_PER_S

Columns = dict[str, NDArray[Any]]
START_NS = 1_700_000_000 * NS_PER_S
PERIOD_NS = NS_PER_S // 10
SCENES = ("", "city", "canyon,night", "tunnel")
MODES = ("", "open-loop", "autonomous")


def tables(seed: int, seconds: float, *, hidden: bool = False) -> tuple[Columns, Columns]:
    """States at 10 Hz with holes; GNSS and pose fixes at about 10 Hz with holes, repeats and fixes of status none."""
    rng = np.random.default_rng(seed)
    t_ns = START_NS + PERIOD_NS * np.flatnonzero(rng.random(round(10 * seconds)) > 0.02)
    states = _with_tags({"t_ns": t_ns}, rng)
    n = len(t_ns)
    states |= _errors(rng, n, missing=0.05)
    states["excluded"] = np.where(_stretches(rng, n, 0.1), Excluded.GAP, Excluded.EVALUATED).astype(np.int8)
    states["ref_speed"] = np.where(rng.random(n) < 0.01, np.nan, np.abs(rng.normal(8.0, 5.0, n)))
    states["ref_sigma_m"] = np.where(rng.random(n) < 0.5, np.nan, rng.uniform(0.0, 0.11, n))
    states["ref_sigma_yaw"] = np.radians(rng.uniform(0.0, 0.35, n))
    states["ref_yaw"] = np.where(rng.random(n) < 0.1, np.nan, 0.0)
    for name in ("x", "y", "ref_x", "ref_y"):
        states[name] = rng.normal(0.0, 1.0, n)
    for name in ("sigma_lon", "sigma_lat"):
        states[name] = np.where(rng.random(n) < 0.1, np.nan, 0.5)
    states["stretch"] = ((t_ns - START_NS) // (20 * NS_PER_S)).astype(np.int32)
    states["stretch"][(t_ns - START_NS) % (20 * NS_PER_S) > 5 * NS_PER_S] = -1
    if not hidden:
        states["stretch"][:] = -1
    return states, _decisions(rng, seconds)


def facts(period_ns: int = PERIOD_NS, hidden_s: float | None = None, seconds: float = 0.0) -> Facts:
    """What scoring is told besides."""
    step = 20 * NS_PER_S
    planned = [(START_NS + i * step, START_NS + i * step + 5 * NS_PER_S) for i in range(int(seconds // 20))]
    return {
        "order": "stamp",
        "period_ns": period_ns,
        "start_ns": START_NS,
        "alignment_s": 2.5,
        "reference": {"kind": "odometry", "source": "log", "heading": "attitude"},
        "hide_gnss": None if hidden_s is None else {"every_s": 20.0, "length_s": hidden_s},
        "stretches": None if hidden_s is None else planned,
        "health": {"initializing": 3, "healthy": 5, "degraded/pose_fix": 2, "restarts": 1},
        "warnings": [{"kind": "lost", "text": "The filter lost track."}],
        "left_out": [{"source": "/imu", "reason": "stamp repeats", "count": 3}],
    }


def batches(states: Columns, decisions: Columns, cuts: NDArray[np.int64]) -> Iterator[tuple[Columns, Columns]]:
    """Both tables cut at the same stamps."""
    edges = [-(2**62), *np.sort(cuts).tolist(), 2**62]
    for begin, end in pairwise(edges):
        yield tuple({k: c[(t["t_ns"] >= begin) & (t["t_ns"] < end)] for k, c in t.items()} for t in (states, decisions))  # type: ignore[misc]


def scored(parts: Iterator[tuple[Columns, Columns]], limits: Limits, told: Facts, log: str = "drive") -> Sums:
    """The sums of batches."""
    scorer = Scorer(limits, log=log, period_ns=told["period_ns"], start_ns=told["start_ns"])
    for states, decisions in parts:
        scorer.add(states, decisions)
    return scorer.finish(told, SCENES, MODES)


def _decisions(rng: np.random.Generator, seconds: float) -> Columns:
    parts = []
    for sensor, rate in ((Sensor.GNSS_POSITION, 10), (Sensor.POSE_FIX, 10), (Sensor.WHEEL, 20)):
        t_ns = START_NS + 30_000_000 + np.arange(0, round(seconds * NS_PER_S), NS_PER_S // rate)
        t_ns = t_ns + rng.integers(0, 20_000_000, len(t_ns))
        row = np.arange(len(t_ns))
        kept = ~_stretches(rng, len(t_ns), 0.1) & (rng.random(len(t_ns)) > 0.03)
        kept = np.repeat(np.flatnonzero(kept), np.where(rng.random(kept.sum()) < 0.02, 2, 1))
        parts.append({"t_ns": t_ns[kept], "row": row[kept], "sensor": np.full(len(kept), sensor, np.int8)})
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["t_ns"], kind="stable")
    columns = _with_tags({name: column[order] for name, column in columns.items()}, rng)
    n = len(order)
    columns |= _errors(rng, n, missing=0.04)
    gnss = columns["sensor"] == Sensor.GNSS_POSITION
    columns["err_yaw"][gnss] = np.nan
    columns["status"] = np.where(gnss, np.where(rng.random(n) < 0.1, 0, 4), -1).astype(np.int8)
    columns["reason"] = rng.choice([Reason.ACCEPTED, Reason.CHI_SQUARE, Reason.STATUS], n).astype(np.int8)
    columns["accepted"] = columns["reason"] == Reason.ACCEPTED
    repeats = np.flatnonzero((np.diff(columns["row"]) == 0) & (np.diff(columns["sensor"]) == 0)) + 1
    for name in ("err_lon", "err_lat", "err_yaw", "status"):
        columns[name][repeats] = columns[name][repeats - 1]
    return columns


def _with_tags(columns: Columns, rng: np.random.Generator) -> Columns:
    """scene and mode codes that hold for some seconds, the same at the same stamps."""
    seconds = (columns["t_ns"] - START_NS) / NS_PER_S
    scene = np.array([0, 1, 2, 1, 3, 1, 1, 2], np.int16)[(seconds // 7).astype(np.int64) % 8]
    return columns | {"scene": scene, "mode": (1 + (seconds // 45) % 2).astype(np.int16)}


def _errors(rng: np.random.Generator, n: int, missing: float) -> Columns:
    lost = rng.random(n) < missing
    size = 10.0 ** rng.uniform(-3, 0.3, n)
    spread = {"err_lon": 0.3, "err_lat": 0.2, "err_yaw": 0.01}
    return {name: np.where(lost, np.nan, size * rng.normal(0.0, s, n)) for name, s in spread.items()}


def _stretches(rng: np.random.Generator, n: int, share: float) -> NDArray[np.bool_]:
    """(n,) True in pieces of up to ten, about a share of all."""
    starts = np.flatnonzero(rng.random(n) < share / 5)
    chosen = np.zeros(n, bool)
    for start in starts:
        chosen[start : start + int(rng.integers(1, 11))] = True
    return chosen
