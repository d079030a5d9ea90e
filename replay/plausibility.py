"""What must not pass for success: a filter that never started, diverged or lost track, and IMUs in other units or axes.

Nothing here changes a result. Each finding is one sentence, with a kind that programs can tell apart.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.result import Decisions, FusionResult, Reason, Sensor, States
from replay.decisions import APPLIED, FIXES
from sensors.clock import NS_PER_S
from sensors.records import Imu, Log

Floats = NDArray[np.float64]
Findings = list[dict[str, str]]

STANDARD_GRAVITY = 9.80665
SAMPLES = 40_000
"""IMU samples, evenly spread, that are looked at (down to half as many)."""
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
BOTH_LOST_NS = NS_PER_S
"""Positions of two sensors need not be rejected for longer than this: hardly both are wrong at once."""
INERT_SHARE = 0.5
"""A sensor with more of its measurements rejected than this says something about itself or the filter."""

_IS_POSITION = np.isin(np.arange(len(Sensor)), FIXES)
_IS_JUDGED = np.isin(np.arange(len(Reason)), (*APPLIED, Reason.CHI_SQUARE))


class Watch:
    """Looks at a drive piece by piece, and says at its end what is wrong with the IMU and with the result."""

    def __init__(self, *, land_vehicle: bool) -> None:
        self._land_vehicle = land_vehicle
        self._imu = ImuWatch(land_vehicle=land_vehicle)
        self._aligned = False
        self._states = self._not_finite = 0
        self._first_not_finite_ns = 0
        self._speed = 0.0
        self._run = self._longest = _Run()
        self._counts = np.zeros((len(Sensor), len(Reason)), np.int64)

    def add(self, piece: Log, result: FusionResult) -> None:
        """The next piece, and what was decided with it."""
        if piece.imu is not None:
            self._imu.add(piece.imu)
        self._aligned = result.aligned_ns is not None
        self._add_states(result.states)
        self._add_decisions(result.decisions)

    def findings(self, start_ns: int) -> Findings:
        """What is wrong, causes first; times count from the first IMU sample."""
        found = (
            *self._imu.findings(),
            ("never_aligned", self._never_aligned()),
            ("not_finite", self._diverged(start_ns)),
            ("too_fast", self._too_fast()),
            ("lost", self._lost(start_ns)),
            ("rejected", self._rejected()),
        )
        return [{"kind": kind, "text": text} for kind, text in found if text]

    def _add_states(self, states: States) -> None:
        if not len(states):
            return
        bad = ~(np.isfinite(states.llh).all(axis=1) & np.isfinite(states.pose_cov).all(axis=(1, 2)))
        if bad.any() and not self._not_finite:
            self._first_not_finite_ns = int(states.t_ns[np.argmax(bad)])
        self._not_finite += int(bad.sum())
        self._states += len(states)
        velocity = states.vel_enu[np.isfinite(states.vel_enu).all(axis=1)]
        self._speed = max(self._speed, float(np.linalg.norm(velocity, axis=1).max(initial=0.0)))

    def _add_decisions(self, decisions: Decisions) -> None:
        pairs = decisions.sensor.astype(np.int64) * len(Reason) + decisions.reason
        self._counts += np.bincount(pairs, minlength=self._counts.size).reshape(self._counts.shape)
        rows = np.flatnonzero(_IS_POSITION[decisions.sensor] & _IS_JUDGED[decisions.reason])
        rows = rows[np.argsort(decisions.t_ns[rows], kind="stable")]
        pose_fixes = np.cumsum(np.append(0, decisions.sensor[rows] == Sensor.POSE_FIX))
        t_ns, rejected = decisions.t_ns[rows], decisions.reason[rows] == Reason.CHI_SQUARE
        edges = np.flatnonzero(np.diff(rejected.astype(np.int8), prepend=0, append=0))
        for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            before = self._run if first == 0 and self._run.count else _Run(start_ns=int(t_ns[first]))
            of_pose = before.pose_fixes + int(pose_fixes[end] - pose_fixes[first])
            self._run = _Run(before.count + end - first, before.start_ns, int(t_ns[end - 1]), of_pose)
            self._longest = max(self._longest, self._run, key=lambda run: (run.is_lost, run.count))
        if len(rejected) and not rejected[-1]:
            self._run = _Run()

    def _never_aligned(self) -> str:
        if self._aligned:
            return ""
        heading = "a heading (of a pose fix, two antennas or GNSS in motion)"
        return f"The filter never aligned, there is no output: it needs IMU, a position and {heading}."

    def _diverged(self, start_ns: int) -> str:
        if not self._not_finite:
            return ""
        first = (self._first_not_finite_ns - start_ns) / NS_PER_S
        share = f"{self._not_finite} of {self._states} states"
        return f"The filter diverged: {share} are not finite, the first after {first:.1f} s."

    def _too_fast(self) -> str:
        if not self._land_vehicle or self._speed <= FASTEST_SPEED:
            return ""
        return f"The filter diverged: its speed reaches {self._speed:.4g} m/s."

    def _lost(self, start_ns: int) -> str:
        """The longest time over which every position was rejected."""
        run = self._longest
        if not run.is_lost:
            return ""
        start, end = ((t - start_ns) / NS_PER_S for t in (run.start_ns, run.end_ns))
        return f"The filter lost track: from {start:.1f} to {end:.1f} s it rejected all {run.count} positions."

    def _rejected(self) -> str:
        """Sensors of which the chi-square gate rejected most."""
        named = []
        for sensor in (*FIXES, Sensor.GNSS_VELOCITY, Sensor.GNSS_YAW, Sensor.WHEEL):
            rejected, applied = int(self._counts[sensor, Reason.CHI_SQUARE]), int(self._counts[sensor, APPLIED].sum())
            if rejected >= LOST_COUNT and rejected > INERT_SHARE * (rejected + applied):
                named.append(f"{sensor.name.lower().replace('_', ' ')} ({rejected} of {rejected + applied})")
        return f"The filter rejected most of a sensor: {', '.join(named)}." if named else ""


@dataclass(frozen=True, slots=True)
class _Run:
    """Positions rejected one after the other, the times of the first and the last, and how many were pose fixes."""

    count: int = 0
    start_ns: int = 0
    end_ns: int = 0
    pose_fixes: int = 0

    @property
    def is_lost(self) -> bool:
        """Whether it is too long to be the sensors' fault."""
        both = 0 < self.pose_fixes < self.count
        return self.count >= LOST_COUNT and self.end_ns - self.start_ns >= (BOTH_LOST_NS if both else LOST_NS)


class ImuWatch:
    """Looks at the samples of an IMU, evenly spread over the drive, piece by piece."""

    def __init__(self, *, land_vehicle: bool) -> None:
        self._land_vehicle = land_vehicle
        self._every, self._count = 1, 0
        self._accel, self._gyro = np.empty((0, 3)), np.empty((0, 3))

    def add(self, imu: Imu) -> None:
        """The next samples; of all so far every 1st, 2nd, 4th ... is kept."""
        rows = slice(-self._count % self._every, None, self._every)
        self._count += len(imu)
        self._accel = np.concatenate((self._accel, imu.accel[rows]))
        self._gyro = np.concatenate((self._gyro, imu.gyro[rows]))
        while len(self._accel) > SAMPLES:
            self._every *= 2
            self._accel, self._gyro = self._accel[::2].copy(), self._gyro[::2].copy()

    def findings(self) -> Iterator[tuple[str, str]]:
        """(kind, sentence) for what an IMU cannot have measured in the units and axes it should be in."""
        if not len(self._accel):
            return
        force, gravity = np.median(self._accel, axis=0), STANDARD_GRAVITY
        size = float(np.linalg.norm(force))
        upright = force[2] >= LEAST_UPRIGHT * size
        if abs(size - gravity) > FORCE_TOLERANCE or (self._land_vehicle and not upright):
            guess = " (is it in g?)" if abs(size * gravity - gravity) <= FORCE_TOLERANCE else ""
            guess = guess or (" (does z point down?)" if force[2] < -LEAST_UPRIGHT * size else "")
            axes = ", ".join(f"{value:.2f}" for value in force)
            yield (
                "specific_force",
                f"IMU: the median specific force is ({axes}) m/s^2, expected about (0, 0, 9.8), z up{guess}.",
            )
        turn = float(np.percentile(np.linalg.norm(self._gyro, axis=1), 99))
        if self._land_vehicle and turn > FASTEST_TURN:
            text = f"IMU: for 1 % of the time it turns faster than {turn:.1f} rad/s, expected below {FASTEST_TURN:g}"
            yield "turn_rate", f"{text} (is it in deg/s?)."


def imu_findings(imu: Imu, *, land_vehicle: bool) -> Iterator[tuple[str, str]]:
    """What ``ImuWatch`` finds in a whole record."""
    watch = ImuWatch(land_vehicle=land_vehicle)
    watch.add(imu)
    return watch.findings()
