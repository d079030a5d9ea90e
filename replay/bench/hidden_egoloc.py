"""egoloc over hidden stretches: one pass over the drive, a copy of the session at every start goes on without GNSS."""

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.baselines import enu_between, moved
from fusion.config import FusionConfig
from fusion.result import States
from fusion.run import Session
from replay.bench.hidden_plan import AFTER_S, Plan, Stretch
from replay.hiding import delay_ns
from sensors.clock import NS_PER_S
from sensors.records import Log
from sensors.rotation import matrix_from_q, wrap, yaw_from_q

Floats = NDArray[np.float64]

_BEFORE_NS = -(2**62)
"""Before any stamp."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What a filter says of the plan's point: llh (3,); cov (2, 2) east, north m^2; yaw from east rad, its variance."""

    llh: Floats
    cov: Floats
    yaw: float
    yaw_var: float


Estimates = dict[tuple[int, float], Estimate]
"""By start_ns and length in s; one is absent where the filter had no state."""


def ends(log: Log, plan: Plan, config: FusionConfig) -> Estimates:
    """The end of each of the plan's stretches."""
    session = Session(log.vehicle, log.map_frame, config)
    found: Estimates = {}
    before = _BEFORE_NS
    for stretch in plan.stretches:
        session.push(between(log, before, stretch.start_ns))
        before = stretch.start_ns
        fork = deepcopy(session)
        hidden = between(log, before, stretch.last_ns + round(AFTER_S * NS_PER_S))
        pushed = fork.push(replace(hidden, gnss=None, gnss_velocity=None)).states
        found |= _at_ends((pushed, fork.finish().states), stretch, plan.point)
    return found


def between(log: Log, first_ns: int, end_ns: int) -> Log:
    """Rows of all sensors that were true in [first, end)."""
    delays = {"gnss": log.vehicle.gnss_delay_s, "gnss_velocity": log.vehicle.gnss_velocity_delay_s}
    parts: dict[str, Any] = {}
    for name in ("imu", "gnss", "gnss_velocity", "pose_fixes", "wheel"):
        record = getattr(log, name)
        if record is not None:
            first, end = np.searchsorted(record.t_ns - delay_ns(delays.get(name, 0.0)), (first_ns, end_ns))
            parts[name] = record[first:end] if first < end else None
    return replace(log, **parts, reference=None, scene=None, mode=None, left_out=())


def _at_ends(parts: tuple[States, ...], stretch: Stretch, point: Floats) -> Estimates:
    states = max(parts, key=len)
    return {
        (stretch.start_ns, length): state_at(states, end.t_ns, point)
        for length, end in stretch.ends.items()
        if len(states) and states.t_ns[0] <= end.t_ns < states.t_ns[-1]
    }


def state_at(states: States, t_ns: int, point: Floats) -> Estimate:
    """The state between its neighbours on the output grid: a cubic through places and velocities."""
    i = int(np.searchsorted(states.t_ns, t_ns, side="right")) - 1
    step = float(states.t_ns[i + 1] - states.t_ns[i]) / NS_PER_S
    w = float(t_ns - states.t_ns[i]) / NS_PER_S / step
    first, second = states.vel_enu[i], states.vel_enu[i + 1]
    chord = enu_between(states.llh[i], states.llh[i + 1])
    place = (3 - 2 * w) * w * w * chord + step * w * (1 - w) * ((1 - w) * first - w * second)
    yaws = yaw_from_q(states.q_enu_body[i : i + 2])
    R = matrix_from_q(states.q_enu_body[i if w < 0.5 else i + 1])
    cov = (1 - w) * states.pose_cov[i] + w * states.pose_cov[i + 1]
    lever = R @ point
    x, y, z = lever
    J = np.hstack((np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]))[:2]
    yaw = float(wrap(yaws[0] + w * wrap(yaws[1] - yaws[0])))
    return Estimate(moved(states.llh[i], place + lever), J @ cov @ J.T, yaw, float(cov[5, 5]))
