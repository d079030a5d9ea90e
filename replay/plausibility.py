"""What must not pass for success: a filter that never started, diverged or lost track, and IMUs in other units or axes.

Nothing here changes a result. Each finding is one sentence, with a kind that programs can tell apart.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fusion.result import FusionResult, Reason, Sensor
from sensors.clock import NS_PER_S
from sensors.records import Imu, Log

Findings = list[dict[str, str]]

STANDARD_GRAVITY = 9.80665
SAMPLES = 20_000
"""IMU samples, evenly spread, that are looked at (up to twice as many)."""
FORCE_TOLERANCE = 1.0
"""A driving vehicle's median specific force is gravity to within this, m/s^2."""
LEAST_UPRIGHT = 0.8
"""Share of it along the body's z axis: 37 deg of tilt."""
FASTEST_TURN = 2.0
"""A road vehicle turns faster than this for less than one per cent of its time, rad/s."""
FASTEST_SPEED = 150.0
"""A road vehicle's largest speed, m/s."""
LOST_NS = 10 * NS_PER_S
LOST_COUNT = 10
"""So many positions over so long, each rejected by the chi-square gate: the filter no longer knows where it is."""
INERT_SHARE = 0.5
"""A sensor with more of its measurements rejected than this says something about itself or the filter."""

_POSITIONS = (Sensor.GNSS_POSITION, Sensor.POSE_FIX)
_APPLIED = (Reason.ACCEPTED, Reason.PARTLY_ACCEPTED, Reason.USED_FOR_ALIGNMENT)


def warnings_of(result: FusionResult, log: Log) -> Findings:
    """What is wrong with the IMU and with the result, causes first; times count from the first IMU sample."""
    assert log.imu is not None
    start_ns = int(log.imu.t_ns[0])
    found = (
        *imu_findings(log.imu, land_vehicle=log.vehicle.land_vehicle),
        ("never_aligned", _never_aligned(result)),
        ("not_finite", _not_finite(result, start_ns)),
        ("too_fast", _too_fast(result, log)),
        ("lost", _lost(result, start_ns)),
        ("rejected", _rejected(result)),
    )
    return [{"kind": kind, "text": text} for kind, text in found if text]


def imu_findings(imu: Imu, *, land_vehicle: bool) -> Iterator[tuple[str, str]]:
    """(kind, sentence) for what an IMU cannot have measured in the units and axes it should be in."""
    some = slice(None, None, max(len(imu) // SAMPLES, 1))
    force, gravity = np.median(imu.accel[some], axis=0), STANDARD_GRAVITY
    size = float(np.linalg.norm(force))
    upright = force[2] >= LEAST_UPRIGHT * size
    if abs(size - gravity) > FORCE_TOLERANCE or (land_vehicle and not upright):
        guess = " (is it in g?)" if abs(size * gravity - gravity) <= FORCE_TOLERANCE else ""
        guess = guess or (" (does z point down?)" if force[2] < -LEAST_UPRIGHT * size else "")
        axes = ", ".join(f"{value:.2f}" for value in force)
        yield (
            "specific_force",
            f"IMU: the median specific force is ({axes}) m/s^2, expected about (0, 0, 9.8), z up{guess}.",
        )
    turn = float(np.percentile(np.linalg.norm(imu.gyro[some], axis=1), 99))
    if land_vehicle and turn > FASTEST_TURN:
        text = f"IMU: for 1 % of the time it turns faster than {turn:.1f} rad/s, expected below {FASTEST_TURN:g}"
        yield "turn_rate", f"{text} (is it in deg/s?)."


def _never_aligned(result: FusionResult) -> str:
    if result.aligned_ns is not None:
        return ""
    heading = "a heading (of a pose fix, two antennas or GNSS in motion)"
    return f"The filter never aligned, there is no output: it needs a second of IMU, a position and {heading}."


def _not_finite(result: FusionResult, start_ns: int) -> str:
    states = result.states
    finite = np.isfinite(np.column_stack((states.llh, states.pose_cov.reshape(len(states), 36))))
    bad = ~np.all(finite, axis=1, keepdims=True)[:, 0]
    if not bad.any():
        return ""
    first = (int(states.t_ns[np.argmax(bad)]) - start_ns) / NS_PER_S
    return f"The filter diverged: {bad.sum()} of {len(bad)} states are not finite, the first after {first:.1f} s."


def _too_fast(result: FusionResult, log: Log) -> str:
    velocity = result.states.vel_enu[np.isfinite(result.states.vel_enu).all(axis=1)]
    speed = float(np.linalg.norm(velocity, axis=1).max(initial=0.0))
    if not log.vehicle.land_vehicle or speed <= FASTEST_SPEED:
        return ""
    return f"The filter diverged: its speed reaches {speed:.4g} m/s."


def _lost(result: FusionResult, start_ns: int) -> str:
    """The longest time over which every position was rejected."""
    decisions = result.decisions
    rows = np.isin(decisions.sensor, _POSITIONS) & np.isin(decisions.reason, (*_APPLIED, Reason.CHI_SQUARE))
    order = np.argsort(decisions.t_ns[rows], kind="stable")
    t_ns, rejected = decisions.t_ns[rows][order], decisions.reason[rows][order] == Reason.CHI_SQUARE
    first, last = _longest_run(rejected)
    if last - first < LOST_COUNT or t_ns[last - 1] - t_ns[first] < LOST_NS:
        return ""
    start, end = ((int(t) - start_ns) / NS_PER_S for t in (t_ns[first], t_ns[last - 1]))
    return f"The filter lost track: from {start:.1f} to {end:.1f} s it rejected all {last - first} positions."


def _longest_run(flags: NDArray[np.bool_]) -> tuple[int, int]:
    """[first, last) of the longest run of True; (0, 0) where there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    if not len(edges):
        return 0, 0
    longest = int(np.argmax(edges[1::2] - edges[::2]))
    return int(edges[2 * longest]), int(edges[2 * longest + 1])


def _rejected(result: FusionResult) -> str:
    """Sensors of which the chi-square gate rejected most."""
    named = []
    for sensor in (*_POSITIONS, Sensor.GNSS_VELOCITY, Sensor.GNSS_YAW, Sensor.WHEEL):
        reasons = result.decisions.reason[result.decisions.sensor == sensor]
        rejected, applied = int((reasons == Reason.CHI_SQUARE).sum()), int(np.isin(reasons, _APPLIED).sum())
        if rejected >= LOST_COUNT and rejected > INERT_SHARE * (rejected + applied):
            named.append(f"{sensor.name.lower().replace('_', ' ')} ({rejected} of {rejected + applied})")
    return f"The filter rejected most of a sensor: {', '.join(named)}." if named else ""
