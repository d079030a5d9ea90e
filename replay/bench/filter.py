"""`egoloc bench filter`: IMU steps per second of the whole filter, beside filterpy, gtsam and pyins in the same run.

In stamp order and, by turns with it, in arrival order: positions come 50 ms late, pose fixes 120, wheel speeds 10 ms.

One simulated drive: 100 Hz IMU, 10 Hz GNSS positions, 10 Hz pose fixes. egoloc's figures are whole calls of
``fusion.run`` (covariances, sorting, alignment, gates, recording included) over all of it. The peers get less to do,
over its first minutes: arrays ready in one plane before the clock starts, a first state, fixes that share their stamps,
and no gates or records to keep; filterpy and gtsam also a flat earth. They have 15 states, egoloc one more (the wheel's
scale); tests hold all of them to the truth.
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import msgspec
import numpy as np

from fusion.config import FusionConfig
from fusion.run import run as fuse
from fusion.sensor_models import MotionModel
from replay.bench.measure import conditions, rate, row, times
from replay.bench.peers import peer_drive
from sensors.records import Log
from sensors.simulate.drive import simulate_drive
from sensors.simulate.scenarios import load

METRIC = "imu_steps_per_s"
PEER_STEPS = {"filterpy": 10_000, "gtsam": 20_000, "pyins": 3_000}
"""pyins slows down with the length of its trajectory, which it copies at every fix."""
_PACKAGES = {"pyins": ("python-ins", "pandas")}
"""What a peer's speed depends on, where that is not the package of its name."""


def run(repeats: int = 5, seconds: float = 1800.0, peer_steps: Mapping[str, int] = PEER_STEPS) -> dict[str, Any]:
    """Medians over repeats of a drive of so many seconds; peer_steps: IMU steps of each peer, multiples of ten.

    A peer that is not installed is named in the conditions as missing.
    """
    scenario = load("clean")
    whole = simulate_drive(seconds, scenario.seed, scenario).log
    log = replace(whole, gnss_velocity=None, wheel=None, reference=None)
    plain = msgspec.structs.replace(FusionConfig(), motion=MotionModel(zero_velocity=False, non_holonomic=False))
    rows = [
        *_both_orders("egoloc", log, plain, repeats),
        *_both_orders("egoloc, all sensors and constraints", whole, FusionConfig(), repeats),
    ]
    present = [peer for peer in peer_steps if find_spec(peer) is not None]
    rows += [_peer(peer, peer_steps[peer], seconds, min(repeats, 3)) for peer in present]
    median = {line["name"]: line["median"] for line in rows if line["metric"] == METRIC}
    facts = {
        "seconds": seconds,
        "imu_hz": 100,
        "gnss_hz": 10,
        "pose_hz": 10,
        "states": 16,
        "repeats": repeats,
        "peer_steps": {peer: peer_steps[peer] for peer in present},
        "missing": [peer for peer in peer_steps if peer not in present],
    }
    packages = ["numba", "numpy", *(name for peer in present for name in _PACKAGES.get(peer, (peer,)))]
    ratios = {peer: median["egoloc"] / median[peer] for peer in present}
    return {"bench": "filter", "rows": rows, "ratios": ratios, "conditions": conditions(packages, **facts)}


def _both_orders(name: str, log: Log, config: FusionConfig, repeats: int) -> list[dict[str, Any]]:
    """Rows of stamp order and of arrival order, called by turns, and what the second costs over its share of work."""
    assert log.imu is not None
    orders = {order: msgspec.structs.replace(config, order=order) for order in ("stamp", "arrival")}
    spent: dict[str, list[float]] = {order: [] for order in orders}
    for counted in range(repeats + 1):  # the first call warms up
        for order, chosen in orders.items():
            start = time.perf_counter()
            fuse(log, chosen)
            if counted:
                spent[order].append(time.perf_counter() - start)
    cost = np.divide(spent["arrival"], spent["stamp"])
    return [
        rate(name, METRIC, len(log.imu), spent["stamp"]),
        rate(f"{name}, arrival order", METRIC, len(log.imu), spent["arrival"]),
        row(f"{name}, arrival order", "cost_over_stamp_order", cost.tolist()),
        row(f"{name}, arrival order", "cost_over_work", (cost / work_by_arrival(log)).tolist()),
    ]


def work_by_arrival(log: Log) -> float:
    """IMU steps per IMU sample where each late arrival repeats those since its stamp: 1 + sum of rate x latency.

    GNSS positions and velocities arrive together and share a rewind.
    """
    assert log.imu is not None
    seconds = (log.imu.t_ns[-1] - log.imu.t_ns[0]) * 1e-9
    late = [record for record in (log.gnss, log.pose_fixes, log.wheel) if record is not None]
    waited = sum(float((record.arrival_ns - record.t_ns).sum()) * 1e-9 for record in late)
    return 1.0 + waited / float(seconds)


def _peer(peer: str, steps: int, seconds: float, repeats: int) -> dict[str, Any]:
    """The row of one peer."""
    drive = peer_drive(seconds)
    track = import_module(f"replay.bench.{peer}_peer").track
    return rate(peer, METRIC, steps, times(lambda: track(drive, steps), repeats))
