"""`egoloc bench replay`: from an MCAP log to metrics.json, against the clock, over logs of growing length.

The log: simulated, 100 Hz IMU and reference, 10 Hz GNSS (position and velocity) and pose fixes, zstd. Timed: the whole
of ``replay_source`` (hashing, reading, fusing, scoring, writing the run folder) after one call that warms up; imports
are not counted. Peak memory is that of a fresh process that replays the log once. The sums and metrics alone are timed
over a million epochs.
"""

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from replay.bench.measure import conditions, row, times
from replay.bench.memory import peak_mb
from replay.config import LIMITS, RunConfig
from replay.harness import replay_source
from replay.metrics import metrics_of
from replay.run_files import Facts
from replay.scoring import DECISIONS, STATES, Scorer
from replay.sources import log_path
from sensors.mcap.io import write_log
from sensors.simulate.drive import simulate_pieces
from sensors.simulate.scenarios import load

Columns = dict[str, NDArray[Any]]

PERIOD_NS = 100_000_000
"""Of the million epochs."""


def run(repeats: int = 5, hours: Sequence[float] = (1.0,)) -> dict[str, Any]:
    """Medians over repeats for each length; the ratios compare seconds per hour of log with the first length."""
    scenario = load("clean")
    scenario = msgspec.structs.replace(scenario, wheel=msgspec.structs.replace(scenario.wheel, use=False))
    rows, per_hour = [], {}
    with tempfile.TemporaryDirectory() as folder:
        for length in hours:
            path, out = Path(folder) / f"{length:g}h.mcap", Path(folder) / "run"
            write_log(path, simulate_pieces(length * 3600.0, scenario.seed, scenario))
            found = times(lambda: _replay(path, out), repeats)  # noqa: B023
            name = f"egoloc, {length:g} h"
            rows += [row(name, "seconds", found), row(name, "times_real_time", [length * 3600.0 / s for s in found])]
            per_hour[length] = rows[-2]["median"] / length
            rows.append(row(name, "peak_memory_mb", [_peak_memory_mb(path, out)]))
            path.unlink()
    tables = _million_epochs()
    rows.append(row("sums and metrics, 1 M epochs", "seconds", times(lambda: _score(*tables), repeats)))
    first = per_hour[hours[0]]
    ratios = {f"seconds per hour, {length:g} h to {hours[0]:g} h": per_hour[length] / first for length in hours[1:]}
    facts = {"imu_hz": 100, "reference_hz": 100, "gnss_hz": 10, "pose_hz": 10, "log": "zstd", "repeats": repeats}
    return {"bench": "replay", "rows": rows, "ratios": ratios, "conditions": conditions(["numba", "numpy"], **facts)}


def _replay(path: Path, out: Path) -> object:
    return replay_source(log_path(path), out, RunConfig(), overwrite=True)


def _million_epochs() -> tuple[Columns, Columns]:
    """States with errors along three axes, and no decisions."""
    count = 1_000_000
    rng = np.random.default_rng(0)
    states: Columns = {name: np.zeros(count) for name in STATES}
    states |= dict(
        zip(("err_lon", "err_lat", "err_yaw"), rng.normal(0.0, (0.2, 0.2, 0.004), (count, 3)).T, strict=True)
    )
    states |= {
        "t_ns": np.arange(count) * PERIOD_NS,
        "excluded": (rng.random(count) < 0.01).astype(np.int8),
        "ref_speed": np.full(count, 10.0),
        "stretch": np.full(count, -1, np.int32),
        "scene": np.zeros(count, np.int16),
        "mode": np.zeros(count, np.int16),
    }
    kinds: dict[str, type] = dict.fromkeys(("t_ns", "row"), np.int64) | dict.fromkeys(("scene", "mode"), np.int16)
    kinds |= dict.fromkeys(("sensor", "reason", "status"), np.int8) | {"accepted": np.bool_}
    return states, {name: np.empty(0, kinds.get(name, np.float64)) for name in DECISIONS}


def _score(states: Columns, decisions: Columns) -> object:
    """Sums and metrics of these rows."""
    facts: Facts = {
        "order": "stamp",
        "period_ns": PERIOD_NS,
        "start_ns": 0,
        "alignment_s": 0.0,
        "reference": {"kind": "odometry", "source": "log", "heading": "attitude"},
        "hide_gnss": None,
        "stretches": None,
        "health": {},
        "warnings": [],
        "left_out": [],
    }
    scorer = Scorer(LIMITS["paper"], log="bench", period_ns=PERIOD_NS, start_ns=0)
    scorer.add(states, decisions)
    return metrics_of(scorer.finish(facts))


def _peak_memory_mb(path: Path, out: Path) -> float:
    """Largest resident size of a fresh process that replays the log, MB."""
    arguments = [sys.executable, "-m", __name__, str(path), str(out)]
    done = subprocess.run(arguments, check=True, capture_output=True, text=True)
    return float(done.stdout)


if __name__ == "__main__":
    _replay(Path(sys.argv[1]), Path(sys.argv[2]))
    print(peak_mb())
