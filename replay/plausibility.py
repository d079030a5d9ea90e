"""What must not pass for success: a filter that never started or diverged, and IMUs in other units or axes.

Nothing here changes a result; whether it diverged the filter has said itself (``fusion.health``). Each finding is one
sentence, with a kind that programs can tell apart.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fusion.result import Cause, Decisions, FusionResult, Reason, Sensor
from replay.decisions import APPLIED, FIXES
from replay.health import Tally
from sensors._kernels import STANDARD_GRAVITY
from sensors.clock import NS_PER_S
from sensors.records import Imu, Log

Floats = NDArray[np.float64]
Findings = list[dict[str, str]]

SAMPLES = 40_000
"""IMU samples, evenly spread, that are looked at (down to half as many)."""
FORCE_TOLERANCE = 1.0
"""A driving vehicle's median specific force is gravity to within this, m/s^2."""
LEAST_UPRIGHT = 0.8
"""Share of it along the body's z axis: 37 deg of tilt."""
FASTEST_TURN = 2.0
"""A road vehicle turns faster than this for less than one per cent of its time, rad/s."""
FASTEST_SPEED = 150.0
"""Distance is not counted where a road vehicle is said to be faster, m/s."""
INERT_SHARE, INERT_COUNT = 0.5, 10
"""A sensor with more of its measurements rejected than this says something about itself or the filter."""

DIVERGED = {
    Cause.NOT_FINITE: ("not_finite", "its state is not finite"),
    Cause.TOO_FAST: ("too_fast", "it is faster than any road vehicle"),
    Cause.COVARIANCE: ("unknown", "its own covariance says that position or yaw are unknown"),
    Cause.REJECTED: ("lost", "positions contradict it"),
    Cause.TILTED: ("tilted", "it lies on its side (are the IMU's axes forward, left, up?)"),
}
"""Kind and words for each cause of divergence."""
UNSETTLED = ("unsettled", "it gave way to positions that contradicted it, of one sensor alone or again and again")


class Watch:
    """Looks at a drive piece by piece, and says at its end what is wrong with the IMU and with the result."""

    def __init__(self, *, land_vehicle: bool) -> None:
        self._land_vehicle = land_vehicle
        self._imu = ImuWatch(land_vehicle=land_vehicle)
        self._aligned = False
        self.health = Tally()
        self._counts = np.zeros((len(Sensor), len(Reason)), np.int64)

    def add(self, piece: Log, result: FusionResult) -> None:
        """The next piece, and what was decided with it."""
        if piece.imu is not None:
            self._imu.add(piece.imu)
        self._aligned = result.aligned_ns is not None
        self.health.add(result)
        self._add_decisions(result.decisions)

    def findings(self, start_ns: int) -> Findings:
        """What is wrong, causes first; times count from the first IMU sample."""
        found = (
            *self._imu.findings(),
            ("never_aligned", self._never_aligned()),
            *self._told(start_ns),
            ("restarted", self._restarted(start_ns)),
            ("rejected", self._rejected()),
        )
        return [{"kind": kind, "text": text} for kind, text in found if text]

    def _add_decisions(self, decisions: Decisions) -> None:
        pairs = decisions.sensor.astype(np.int64) * len(Reason) + decisions.reason
        self._counts += np.bincount(pairs, minlength=self._counts.size).reshape(self._counts.shape)

    def _never_aligned(self) -> str:
        if self._aligned:
            return ""
        heading = "a heading (of a pose fix, two antennas or GNSS in motion)"
        return f"The filter never aligned, there is no output: it needs IMU, a position and {heading}."

    def _told(self, start_ns: int) -> Iterator[tuple[str, str]]:
        for cause, stretches in self.health.told.items():
            kind, words = UNSETTLED if cause is Cause.UNSETTLED else DIVERGED[cause]
            verb = "was not to be relied on" if cause is Cause.UNSETTLED else "diverged"
            start, end = ((t - start_ns) / NS_PER_S for t in (stretches.start_ns, stretches.end_ns))
            again = stretches.count - 1
            more = f", and {again} times more" if again > 1 else ", and once more" if again else ""
            yield kind, f"The filter {verb} from {start:.1f} to {end:.1f} s{more}: {words}."

    def _restarted(self, start_ns: int) -> str:
        restarts = self.health.restarts
        if not restarts:
            return ""
        first, times = (restarts[0].t_ns - start_ns) / NS_PER_S, len(restarts)
        words = DIVERGED[Cause(restarts[0].cause)][1]
        often = f"{times} times, first" if times > 1 else "once,"
        return f"The filter was started again {often} at {first:.1f} s: {words}."

    def _rejected(self) -> str:
        """Sensors of which the chi-square gate rejected most."""
        named = []
        for sensor in (*FIXES, Sensor.GNSS_VELOCITY, Sensor.GNSS_YAW, Sensor.WHEEL):
            rejected, applied = int(self._counts[sensor, Reason.CHI_SQUARE]), int(self._counts[sensor, APPLIED].sum())
            if rejected >= INERT_COUNT and rejected > INERT_SHARE * (rejected + applied):
                named.append(f"{sensor.name.lower().replace('_', ' ')} ({rejected} of {rejected + applied})")
        return f"The filter rejected most of a sensor: {', '.join(named)}." if named else ""


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
