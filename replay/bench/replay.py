"""`egoloc bench replay`: from an MCAP log to metrics.json, against the clock, over logs of growing length.

The log: simulated, 100 Hz IMU and reference, 10 Hz GNSS (position and velocity) and pose fixes, zstd. Timed: the whole
of ``replay_file`` (hashing, reading, fusing, scoring, writing the run folder) after one call that warms up; imports are
not counted. Peak memory is that of a fresh process that replays the first length once. The metrics alone are timed over
a million epochs.
"""

import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from replay.bench.measure import conditions, row, times
from replay.config import LIMITS, RunConfig
from replay.harness import replay_file
from replay.metrics import cover_ns, evaluated_span, method_metrics
from sensors.mcap.io import write_log
from sensors.simulate.drive import simulate
from sensors.simulate.scenarios import load


def run(repeats: int = 5, hours: Sequence[float] = (1.0,)) -> dict[str, Any]:
    """Medians over repeats for each length; the ratios compare seconds per hour of log with the first length."""
    scenario = load("clean")
    rows, per_hour = [], {}
    with tempfile.TemporaryDirectory() as folder:
        for length in hours:
            path, out = Path(folder) / f"{length:g}h.mcap", Path(folder) / "run"
            write_log(path, replace(simulate(length * 3600.0, scenario.seed, scenario), wheel=None))
            found = times(lambda: replay_file(path, out, RunConfig(), overwrite=True), repeats)  # noqa: B023
            name = f"egoloc, {length:g} h"
            rows += [row(name, "seconds", found), row(name, "times_real_time", [length * 3600.0 / s for s in found])]
            per_hour[length] = rows[-2]["median"] / length
            if length == hours[0]:
                rows.append(row(name, "peak_memory_mb", [_peak_memory_mb(path, out)]))
    rows.append(row("metrics, 1 M epochs", "seconds", times(_million_epochs, repeats)))
    first = per_hour[hours[0]]
    ratios = {f"seconds per hour, {length:g} h to {hours[0]:g} h": per_hour[length] / first for length in hours[1:]}
    facts = {"imu_hz": 100, "reference_hz": 100, "gnss_hz": 10, "pose_hz": 10, "log": "zstd", "repeats": repeats}
    return {"bench": "replay", "rows": rows, "ratios": ratios, "conditions": conditions(["numba", "numpy"], **facts)}


def _million_epochs() -> object:
    """Metrics of one method over a million epochs, three axes, from errors alone."""
    count, period_ns = 1_000_000, 100_000_000
    rng = np.random.default_rng(0)
    t_ns = np.arange(count) * period_ns
    errors = rng.normal(0.0, 0.2, (count, 3)) * (1.0, 1.0, 0.02)
    span = evaluated_span(t_ns, rng.random(count) > 0.01, np.full(count, 10.0), period_ns)
    weights, distances = span.weights(t_ns, cover_ns(t_ns, period_ns))
    return method_metrics(errors, weights, distances, span.total_ns, span.total_m, LIMITS["paper"])


def _peak_memory_mb(path: Path, out: Path) -> float:
    """Largest resident size of a fresh process that replays the log, MB."""
    arguments = [sys.executable, "-m", __name__, str(path), str(out)]
    done = subprocess.run(arguments, check=True, capture_output=True, text=True)
    return float(done.stdout)


if __name__ == "__main__":
    replay_file(Path(sys.argv[1]), Path(sys.argv[2]), RunConfig(), overwrite=True)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
