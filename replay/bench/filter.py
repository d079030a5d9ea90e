"""`egoloc bench filter`: IMU steps per second of the whole filter, beside filterpy, gtsam and pyins in the same run.

One simulated drive: 100 Hz IMU, 10 Hz GNSS positions, 10 Hz pose fixes. egoloc's figures are whole calls of
``fusion.run`` (covariances, sorting, alignment, gates, recording included) over all of it. The peers get less to do,
over its first minutes: arrays ready in one plane before the clock starts, a first state, fixes that share their stamps,
and no gates or records to keep; filterpy and gtsam also a flat earth. They have 15 states, egoloc one more (the wheel's
scale); tests hold all of them to the truth.
"""

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import msgspec

from fusion.config import FusionConfig, MotionModel
from fusion.run import run as fuse
from replay.bench.measure import conditions, rate, times
from replay.bench.peers import peer_drive
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
    assert log.imu is not None
    plain = msgspec.structs.replace(FusionConfig(), motion=MotionModel(zero_velocity=False, non_holonomic=False))
    steps = len(log.imu)
    rows = [
        rate("egoloc", METRIC, steps, times(lambda: fuse(log, plain), repeats)),
        rate("egoloc, all sensors and constraints", METRIC, steps, times(lambda: fuse(whole), repeats)),
    ]
    present = [peer for peer in peer_steps if find_spec(peer) is not None]
    rows += [_peer(peer, peer_steps[peer], seconds, min(repeats, 3)) for peer in present]
    median = {row["name"]: row["median"] for row in rows}
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


def _peer(peer: str, steps: int, seconds: float, repeats: int) -> dict[str, Any]:
    """The row of one peer."""
    drive = peer_drive(seconds)
    track = import_module(f"replay.bench.{peer}_peer").track
    return rate(peer, METRIC, steps, times(lambda: track(drive, steps), repeats))
