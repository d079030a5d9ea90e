"""`egoloc bench live`: how long one call of ``Localizer.push`` takes in arrival order, over a simulated drive.

100 Hz IMU, 10 Hz GNSS positions and velocities that come 50 ms late, 10 Hz pose fixes that come 120 ms late, 50 Hz
wheel speeds, all with jitter, pushed one by one in the order of their arrival. A call is timed alone and with the
making of its record from arrays. The passes are the same calls: the least time of each shows what it takes by itself,
on a machine that has other work as well. States and decisions are taken once a second, outside the clock.
"""

import gc
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.filter import Localizer
from replay.bench.measure import conditions, row
from replay.bench.memory import resident_mb
from sensors.records import Log
from sensors.simulate.drive import simulate_drive
from sensors.simulate.scenarios import load

SENSORS = ("gnss", "gnss_velocity", "pose_fixes", "wheel", "imu")
QUANTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}
ALONE, WHOLE = range(2)
"""The call, and the call with the making of its record."""


def run(repeats: int = 3, hours: tuple[float, ...] = (1.0,)) -> dict[str, Any]:
    """Quantiles of the calls over a drive of the first of these lengths, as median, least and most of the repeats."""
    scenario = load("clean")
    log = simulate_drive(hours[0] * 3600.0, scenario.seed, scenario).log
    _push_all(log, 1000)  # compiles
    passes = [_push_all(log) for _ in range(repeats)]
    timed = [calls for calls, _, _ in passes]
    figures = {
        "push": [calls[ALONE] for calls in timed],
        "push and the making of its record": [calls[WHOLE] for calls in timed],
        "the same, least of the passes": [np.min([calls[WHOLE] for calls in timed], axis=0)],
    }
    rows = [
        row(name, f"us_{quantile}", [float(np.percentile(times, share)) for times in found])
        for name, found in figures.items()
        for quantile, share in QUANTILES.items()
    ]
    for k, name in enumerate(SENSORS):
        medians = [float(np.median(calls[ALONE][kinds == k])) for calls, kinds, _ in passes]
        rows.append(row(f"push, {name}", "us_p50", medians))
    rows.append(row("memory, from a tenth of the drive on", "growth_mb", [grown for _, _, grown in passes]))
    facts = {"hours": hours[0], "calls": len(passes[0][1]), "repeats": len(passes)}
    return {"bench": "live", "rows": rows, "ratios": {}, "conditions": conditions(["numba", "numpy"], **facts)}


def in_arrival_order(log: Log) -> list[tuple[int, int]]:
    """(sensor, row) of every row of a log, by arrival; of what arrives together measurements come first, by stamp."""
    parts = []
    for k, name in enumerate(SENSORS):
        record = getattr(log, name)
        rows = np.arange(len(record))
        is_imu = np.full(len(rows), int(name == "imu"))
        parts.append(np.stack((record.arrival_ns, is_imu, record.t_ns, np.full(len(rows), k), rows)))
    arrival, is_imu, t_ns, sensor, rows = np.concatenate(parts, axis=1)
    order = np.lexsort((sensor, t_ns, is_imu, arrival))
    return list(zip(sensor[order].tolist(), rows[order].tolist(), strict=True))


def _push_all(log: Log, most: int | None = None) -> tuple[NDArray[np.float64], NDArray[np.int64], float]:
    """Microseconds of each call, (2, N) alone and whole, its sensor, and MB by which the process grew."""
    localizer = Localizer(log.vehicle, log.map_frame, FusionConfig(order="arrival"))
    calls = in_arrival_order(log)[:most]
    records = [getattr(log, name) for name in SENSORS]
    spent = np.full((2, len(calls)), np.nan)  # its pages are there from now on, and no growth later
    before = 0.0
    gc.collect()
    for i, (sensor, k) in enumerate(calls):
        columns, begin = records[sensor], time.perf_counter_ns()
        record = columns[k : k + 1]
        made = time.perf_counter_ns()
        localizer.push(record)
        done = time.perf_counter_ns()
        spent[:, i] = done - made, done - begin
        if i % 200 == 0:
            localizer.take_states()
            localizer.take_decisions()
        if i == len(calls) // 10:
            before = resident_mb()
    return spent / 1e3, np.array([sensor for sensor, _ in calls]), resident_mb() - before
