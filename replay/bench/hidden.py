"""`egoloc bench hidden`: how far a filter is off when GNSS has been hidden for a while, beside pyins and gtsam.

Each stretch (``hidden_plan``) is run by every filter from the same place in the drive on, with everything but GNSS.
egoloc stands twice: with positions only, and with all that the log has (velocity, wheel, zero velocity, non-holonomic
constraint). pyins stands three times: positions; with velocities; and with wheel, zero velocity and the non-holonomic
constraint as well. gtsam has positions. Where a log has no velocities the second row of pyins is left out.

Error over sigma is the root mean square per horizontal axis: sqrt(mean(e' C^-1 e / 2)), C the covariance of the estimate
and of what it is compared with.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from fusion.baselines import enu_between
from fusion.config import FusionConfig
from replay.bench import hidden_egoloc
from replay.bench.hidden_egoloc import Estimates, state_at
from replay.bench.hidden_peers import PeerLog, peer_log
from replay.bench.hidden_plan import Plan, Window, plan
from replay.bench.measure import conditions
from sensors.errors import EgolocError
from sensors.records import Log
from sensors.rotation import wrap
from sensors.simulate.drive import simulate
from sensors.simulate.imu_presets import PresetName
from sensors.simulate.scenarios import load

Floats = NDArray[np.float64]
Row = dict[str, Any]
Method = Callable[[], Estimates]

GRADES: tuple[PresetName, ...] = ("tactical", "automotive", "consumer")
SEEDS = (101, 102, 103)
SIMULATED_S = 600.0
PEERS = ("pyins", "gtsam")
WARM_UP_S = 60.0
"""Stretches begin so long after the first position where no window is given."""
_PACKAGES = {"pyins": ("python-ins",), "gtsam": ("gtsam",)}
_PARTS = ("all", "first half", "second half")


@dataclass(frozen=True, slots=True, eq=False)
class Missed:
    """One end: error (2,) east, north m; its squared sum in sigmas; yaw error rad and in sigmas, NaN where not known."""

    length_s: float
    part: str
    horizontal: float
    nees: float
    yaw: float
    yaw_sigmas: float


def run(
    logs: Sequence[Path] = (),
    lengths: Sequence[float] = (15.0, 60.0),
    every: float = 10.0,
    windows: Sequence[Window] = ((WARM_UP_S, np.inf),),
    peers: Sequence[str] | None = None,
    halves: bool = False,
    seeds: Sequence[int] = SEEDS,
    seconds: float = SIMULATED_S,
) -> dict[str, Any]:
    """The benchmark on each of the logs; without any on simulated drives of each IMU grade, seeds pooled.

    peers: of PEERS (None: those that are installed); halves: also stretches that end before and that begin after the
    middle of the drive, whose first half some importers calibrate on.
    """
    wanted = [peer for peer in PEERS if find_spec(peer)] if peers is None else list(peers)
    absent = [peer for peer in wanted if find_spec(peer) is None]
    if absent:
        raise EgolocError(f"--peers: {absent[0]} is not installed: pip install 'egoloc[bench]'")
    rows, unused, facts = [], {}, {}
    groups = [(path.stem, [path]) for path in logs] or [(f"simulated {grade}", _drives(grade, seeds)) for grade in GRADES]
    for name, members in groups:
        ends, plans, courses = {}, [], []
        for member in members:
            log = _opened(member, seconds)
            planned = plan(log, lengths, every, windows)
            drive = peer_log(log, FusionConfig())
            plans.append(planned)
            courses += _course_errors(planned, drive)
            for method, work in _methods(log, planned, drive, wanted).items():
                ends.setdefault(method, []).extend(_missed(planned, work()))
        rows += _rows(name, ends, lengths, _PARTS if halves else _PARTS[:1])
        unused[name] = _unused(plans, lengths)
        facts[name] = {"judge": plans[0].judge, "course_against_filter_deg": _rms(courses) if courses else None}
    facts = {"every_s": every, "lengths_s": list(lengths), "windows_s": _finite(windows), "logs": facts, "stretches": unused}
    if not logs:
        facts |= {"seeds": list(seeds), "seconds": seconds}
    packages = ["numba", "numpy", *(package for peer in wanted for package in _PACKAGES[peer])]
    missing = [peer for peer in PEERS if peer not in wanted]
    return {
        "bench": "hidden",
        "rows": rows,
        "ratios": _ratios(rows),
        "conditions": conditions(packages, missing=missing, **facts),
    }


def positions_only() -> FusionConfig:
    """egoloc without anything but positions."""
    config = FusionConfig()
    return msgspec.structs.replace(
        config,
        gnss=msgspec.structs.replace(config.gnss, use_velocity=False),
        motion=msgspec.structs.replace(config.motion, non_holonomic=False, zero_velocity=False, wheel=False),
    )


def grade_log(grade: PresetName, seed: int, seconds: float = SIMULATED_S) -> Log:
    """City drive with white GNSS errors, neither pose fixes nor wheel speed, and an IMU of a grade with its flaws."""
    scenario = load("clean")
    without = {name: msgspec.structs.replace(getattr(scenario, name), use=False) for name in ("pose_fix", "wheel")}
    imu = msgspec.structs.replace(scenario.imu, preset=grade)
    return simulate(seconds, seed, msgspec.structs.replace(scenario, imu=imu, **without))


def _drives(grade: PresetName, seeds: Sequence[int]) -> list[tuple[PresetName, int]]:
    return [(grade, seed) for seed in seeds]


def _opened(member: Path | tuple[PresetName, int], seconds: float) -> Log:
    if isinstance(member, Path):
        from sensors.mcap.io import read_log

        return read_log(member)
    return grade_log(*member, seconds)


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


def _missed(planned: Plan, estimates: Estimates) -> Iterable[Missed]:
    """Errors of one filter on one log."""
    for stretch in planned.stretches:
        for length, end in stretch.ends.items():
            found = estimates.get((stretch.start_ns, length))
            if found is None:
                continue
            error = enu_between(end.llh, found.llh)[:2]
            nees = float(error @ np.linalg.solve(found.cov + end.cov, error))
            yaw = float(wrap(found.yaw - end.yaw))
            sigma = np.sqrt(found.yaw_var + end.yaw_sigma**2)
            early, late = end.t_ns <= planned.middle_ns, stretch.start_ns >= planned.middle_ns
            part = "first half" if early else "second half" if late else "across"
            yield Missed(length, part, float(np.hypot(*error)), nees, yaw, yaw / sigma)


def _rows(name: str, ends: dict[str, list[Missed]], lengths: Sequence[float], parts: Sequence[str]) -> list[Row]:
    """Three rows for each part, length and method: horizontal and yaw errors, and these over their sigmas."""
    found = []
    for part in parts:
        for length in lengths:
            for method, missed in ends.items():
                mine = [m for m in missed if m.length_s == length and part in ("all", m.part)]
                if mine:
                    found += _of_method({"log": name, "part": part, "length_s": length, "name": method}, mine)
    return found


def _of_method(place: Row, missed: list[Missed]) -> list[Row]:
    horizontal = np.array([m.horizontal for m in missed])
    known = [m for m in missed if np.isfinite(m.yaw)]
    rows = [
        {**place, "metric": "end_horizontal_m", **_figures(horizontal)}
        | {"over_sigma": _rms([np.sqrt(m.nees / 2.0) for m in missed])}
    ]
    if known:
        yaw = np.degrees(np.abs([m.yaw for m in known]))
        over = {"over_sigma": _rms([m.yaw_sigmas for m in known])}
        rows.append({**place, "metric": "end_yaw_deg", **_figures(yaw)} | over)
    return rows


def _figures(values: Floats) -> Row:
    low, middle, high = float(values.min()), float(np.median(values)), float(values.max())
    return {"count": len(values), "median": middle, "p95": float(np.percentile(values, 95)), "min": low, "max": high}


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _ratios(rows: list[Row]) -> dict[str, float]:
    """egoloc with all it has over the best peer, for each log, part and length: median and 95 %."""
    found = {}
    places = {(row["log"], row["part"], row["length_s"]) for row in rows}
    for log, part, length in sorted(places):
        here = [r for r in rows if (r["log"], r["part"], r["length_s"]) == (log, part, length)]
        here = [r for r in here if r["metric"] == "end_horizontal_m"]
        peers = [r for r in here if not r["name"].startswith("egoloc")]
        own = next(r for r in here if r["name"] == "egoloc, all")
        for figure in ("median", "p95") if peers else ():
            key = f"{log}, {part}, {length:g} s, {figure}: egoloc, all to the best peer"
            found[key] = own[figure] / min(r[figure] for r in peers)
    return found


def _unused(plans: Sequence[Plan], lengths: Sequence[float]) -> Row:
    """Stretches that were used, and why others were not."""
    found = {}
    for length in lengths:
        reasons: Counter[str] = sum((p.unused[length] for p in plans), Counter())
        used = sum(length in stretch.ends for p in plans for stretch in p.stretches)
        found[f"{length:g} s"] = {"used": used, **reasons}
    return found


def _course_errors(planned: Plan, drive: PeerLog) -> list[float]:
    """What yaws are judged by, against the filter that has everything, deg: the judge's own error, by scatter."""
    states = drive.states
    if planned.judge != "the withheld fixes":
        return []
    ends = {end.t_ns: end for stretch in planned.stretches for end in stretch.ends.values() if np.isfinite(end.yaw)}
    inside = [end for t, end in ends.items() if states.t_ns[0] <= t < states.t_ns[-1]]
    return [float(np.degrees(wrap(state_at(states, end.t_ns, planned.point).yaw - end.yaw))) for end in inside]


def _finite(windows: Sequence[Window]) -> list[list[float | None]]:
    return [[edge if np.isfinite(edge) else None for edge in window] for window in windows]
