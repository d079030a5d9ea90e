"""`egoloc bench hidden`: how far a filter is off when GNSS has been hidden for a while, beside pyins and gtsam.

Each stretch (``hidden_plan``) is run by every filter from the same place in the drive on, with everything but GNSS.
egoloc stands twice: with positions only, and with all that the log has (velocity, wheel, zero velocity, non-holonomic
constraint). pyins stands three times: positions; with velocities; and with wheel, zero velocity and the non-holonomic
constraint as well. gtsam has positions. Where a log has no velocities the second row of pyins is left out.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fusion.config import FusionConfig
from replay.bench import hidden_egoloc
from replay.bench.hidden_egoloc import Estimates, state_at
from replay.bench.hidden_errors import Miss, misses, ratios, rms, rows_of
from replay.bench.hidden_peers import PeerLog, peer_log
from replay.bench.hidden_plan import FIXES, Plan, Window, plan
from replay.bench.measure import conditions
from sensors.errors import EgolocError
from sensors.records import Log
from sensors.rotation import wrap
from sensors.simulate.drive import simulate
from sensors.simulate.imu_presets import PresetName
from sensors.simulate.scenarios import load

Opener = Callable[[], Log]
Method = Callable[[], Estimates]
Facts = dict[str, Any]

GRADES: tuple[PresetName, ...] = ("tactical", "automotive", "consumer")
SEEDS = (101, 102, 103)
"""Of the simulated drives; other seeds are for tuning."""
SIMULATED_S, SIMULATED_HZ = 400.0, 5.0
"""Length of a simulated drive and rate of its positions: the benchmark takes minutes, most of them pyins."""
WARM_UP_S = 60.0
"""Stretches begin so long after the first position where no window is given."""
PACKAGES = {"pyins": ("python-ins", "pandas"), "gtsam": ("gtsam",)}
"""What each peer's figures depend on."""


def run(
    logs: Sequence[Path] = (),
    lengths: Sequence[float] = (15.0, 60.0),
    every: float = 10.0,
    windows: Sequence[Window] = ((WARM_UP_S, np.inf),),
    peers: Sequence[str] | None = None,
    halves: bool = False,
    seeds: Sequence[int] = SEEDS,
    seconds: float = SIMULATED_S,
) -> Facts:
    """The benchmark on each of the logs; without any on simulated drives of each IMU grade, seeds pooled.

    peers: pyins, gtsam (None: those that are installed); halves: rows also of the stretches that end before and of
    those that begin after the middle of the drive. Raises EgolocError for a peer that is not installed.
    """
    wanted = _installed(peers)
    rows, told, used = [], {}, {}
    for name, openers in _groups(logs, seeds, seconds).items():
        found: dict[str, list[Miss]] = {}
        plans, courses = [], []
        for opener in openers:
            log = opener()
            planned = plan(log, lengths, every, windows)
            drive = peer_log(log, FusionConfig())
            for method, work in _methods(log, planned, drive, wanted).items():
                found.setdefault(method, []).extend(misses(planned, work()))
            plans.append(planned)
            courses += _course_errors(planned, drive)
        rows += rows_of(name, found, lengths, halves=halves)
        told[name] = {"judge": plans[0].judge, "course_against_filter_deg": rms(courses) if courses else None}
        used[name] = _stretches(plans, lengths)
    facts: Facts = {
        "every_s": every,
        "windows_s": [[edge if np.isfinite(edge) else None for edge in window] for window in windows],
        "logs": told,
        "stretches": used,
        "missing": [peer for peer in PACKAGES if peer not in wanted],
        **({} if logs else {"seeds": list(seeds), "seconds": seconds}),
    }
    packages = ["numba", "numpy", *(package for peer in wanted for package in PACKAGES[peer])]
    return {"bench": "hidden", "rows": rows, "ratios": ratios(rows), "conditions": conditions(packages, **facts)}


def positions_only() -> FusionConfig:
    """egoloc without anything but positions."""
    config = FusionConfig()
    return msgspec.structs.replace(
        config,
        gnss=msgspec.structs.replace(config.gnss, use_velocity=False),
        motion=msgspec.structs.replace(config.motion, non_holonomic=False, zero_velocity=False, wheel=False),
    )


def grade_log(grade: PresetName, seed: int, seconds: float = SIMULATED_S) -> Log:
    """City drive with white GNSS errors, neither pose fixes nor wheel speed.

    An IMU of a grade with its flaws, which shakes and warms up as on the road test.
    """
    scenario, road = load("clean"), load("road-test")
    gnss = msgspec.structs.replace(scenario.gnss, rate_hz=SIMULATED_HZ)
    without = {name: msgspec.structs.replace(getattr(scenario, name), use=False) for name in ("pose_fix", "wheel")}
    imu = msgspec.structs.replace(road.imu, preset=grade)
    return simulate(seconds, seed, msgspec.structs.replace(scenario, imu=imu, gnss=gnss, **without))


def _installed(peers: Sequence[str] | None) -> list[str]:
    if peers is None:
        return [peer for peer in PACKAGES if find_spec(peer)]
    for peer in peers:
        if find_spec(peer) is None:
            raise EgolocError(f"--peers: {peer} is not installed: pip install 'egoloc[bench]'")
    return list(peers)


def _groups(logs: Sequence[Path], seeds: Sequence[int], seconds: float) -> Mapping[str, list[Opener]]:
    """What is opened for each name in the table."""
    if not logs:
        return {f"simulated {g}": [lambda g=g, s=s: grade_log(g, s, seconds) for s in seeds] for g in GRADES}  # type: ignore[misc]
    from sensors.mcap.io import read_log

    names = [path.stem if [p.stem for p in logs].count(path.stem) == 1 else str(path) for path in logs]
    return {name: [lambda path=path: read_log(path)] for name, path in zip(names, logs, strict=True)}  # type: ignore[misc]


def _methods(log: Log, planned: Plan, drive: PeerLog, peers: Sequence[str]) -> dict[str, Method]:
    """What is run, by the name of its row."""
    found: dict[str, Method] = {
        "egoloc, positions": lambda: hidden_egoloc.ends(log, planned, positions_only()),
        "egoloc, all": lambda: hidden_egoloc.ends(log, planned, FusionConfig()),
    }
    if "pyins" in peers:
        from replay.bench import hidden_pyins as pyins

        aids = (pyins.POSITION, pyins.VELOCITY, pyins.WHEEL, pyins.LAND)
        found["pyins, positions"] = lambda: pyins.ends(drive, planned, aids[:1])
        if len(drive.velocities.t_ns):
            found["pyins, with velocities"] = lambda: pyins.ends(drive, planned, aids[:2])
        found["pyins, with motion updates"] = lambda: pyins.ends(drive, planned, aids)
    if "gtsam" in peers:
        from replay.bench import hidden_gtsam as gtsam

        found["gtsam, positions"] = lambda: gtsam.ends(drive, planned)
    return found


def _stretches(plans: Sequence[Plan], lengths: Sequence[float]) -> Facts:
    """How many stretches of each length were used, and why others were not."""
    found = {}
    for length in lengths:
        reasons: Counter[str] = sum((p.unused[length] for p in plans), Counter())
        used = sum(length in stretch.ends for p in plans for stretch in p.stretches)
        found[f"{length:g} s"] = {"used": used, "not used": dict(reasons)}
    return found


def _course_errors(planned: Plan, drive: PeerLog) -> list[float]:
    """What yaws are judged by against the filter that has everything, deg: by this the judge itself scatters."""
    if planned.judge != FIXES:
        return []
    states = drive.states
    ends = {end.t_ns: end for stretch in planned.stretches for end in stretch.ends.values() if np.isfinite(end.yaw)}
    inside = [end for t, end in ends.items() if states.t_ns[0] <= t < states.t_ns[-1]]
    return [float(np.degrees(wrap(state_at(states, end.t_ns, planned.point).yaw - end.yaw))) for end in inside]
