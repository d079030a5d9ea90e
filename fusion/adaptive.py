"""Which noise of GNSS and pose fixes makes a drive's innovations most likely: found by running the filter itself.

The likelihood of a drive is that of its innovations, each given all before it (Schweppe 1965,
doi:10.1109/TIT.1965.1053737), so a filter that follows an error which lasts does not hide it: under the model whose
states carry that error the innovations are smaller *and* as large as stated. It is climbed by scoring (Gupta and Mehra
1974, doi:10.1109/TAC.1974.1100714): one run of the filter for each number that is sought gives gradient and Fisher's
information, whose inverse bounds what the drive can tell. Components of an innovation count as independent (a composite
likelihood, Varin 2011): their correlation within one measurement is not recorded.

What it cannot see: an error that lasts as long as the drive, or that nothing else contradicts. GNSS alone on a moving
vehicle hides its lasting errors in the motion; rests, pose fixes or wheels show them. The intervals say so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from fusion.config import FusionConfig, Gates
from fusion.innovations import AxisInnovations, consistency, joint
from fusion.result import Decisions, Reason, Sensor
from fusion.run import run
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.records import Log

Floats = NDArray[np.float64]

SENSORS = (Sensor.GNSS_POSITION, Sensor.GNSS_VELOCITY, Sensor.GNSS_YAW, Sensor.POSE_FIX, Sensor.WHEEL)
"""Whose innovations count. Motion constraints belong to the model: they do not measure."""
SETTLED_S = 10.0
"""Innovations count from so long after the first state on, s."""
LEAST_SHARE, LARGEST_SHARE = 0.01, 0.95
ROUNDS = 25
STEP = 0.02
"""Difference from which derivatives are taken, in logarithms."""
REACH = 1.0
"""Largest step of a round, in logarithms."""
CLOSE = 0.1
"""A gain in log-likelihood below this ends the search."""
OBSERVED = 1.0
"""A logarithm with a larger standard deviation is not observed by the drive."""


@dataclass(frozen=True)
class Sought:
    """A number of the configuration: section and field, where the search starts, and its bounds.

    share: it is sought as the logarithm of its odds, else as its logarithm.
    """

    section: str
    field: str
    start: float
    low: float
    high: float
    share: bool = False

    @property
    def name(self) -> str:
        return f"{self.section}.{self.field}"

    def inward(self, value: float) -> float:
        """To the scale on which it is sought."""
        value = min(max(value, self.low), self.high)
        return float(np.log(value / (LARGEST_SHARE * 1.001 - value)) if self.share else np.log(value))

    def outward(self, x: float) -> float:
        """Back from it, within the bounds."""
        value = LARGEST_SHARE * 1.001 / (1.0 + np.exp(-x)) if self.share else np.exp(x)
        return float(min(max(value, self.low), self.high))


IMU = (Sought("imu", "noise_scale", 1.0, 0.1, 50.0),)
GNSS = (
    Sought("gnss", "inflation", 1.0, 1e-3, 1e3),
    Sought("gnss", "lasting_share", 0.5, LEAST_SHARE, LARGEST_SHARE, share=True),
    Sought("gnss", "lasting_s", 20.0, 0.5, 3600.0),
)
VELOCITY = (Sought("gnss", "velocity_inflation", 1.0, 1e-3, 1e3),)
POSE = (
    Sought("pose", "inflation", 1.0, 1e-3, 1e3),
    Sought("pose", "lasting_share", 0.5, LEAST_SHARE, LARGEST_SHARE, share=True),
    Sought("pose", "lasting_m", 150.0, 1.0, 1e4),
)


@dataclass(frozen=True, slots=True)
class Found:
    """A number of the configuration with its 95 % interval; observed: whether the drive tells it at all; at_bound: the
    search ended at the least or largest value that it allows."""

    name: str
    value: float
    low: float
    high: float
    observed: bool
    at_bound: bool


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """found: by name; config: with it; gain: in log-likelihood over that of white noise as large as stated;
    before, after: innovations under the given and the found configuration; runs of the filter."""

    found: Mapping[str, Found]
    config: FusionConfig
    gain: float
    before: tuple[AxisInnovations, ...]
    after: tuple[AxisInnovations, ...]
    runs: int


def estimate(log: Log, config: FusionConfig | None = None, tell: Callable[[str], None] | None = None) -> NoiseEstimate:
    """The most likely noise of GNSS positions, velocities and pose fixes of a drive.

    The measurements are those that the given configuration applies; gates and floors are off while others are tried.
    Raises EgolocError where the filter does not align or there is nothing to judge.
    """
    given = config or FusionConfig()
    first = run(log, given)
    if first.aligned_ns is None:
        raise EgolocError("noise: expected a drive on which the filter aligns")
    kept = applied_only(log, first.decisions)
    sought = _sought(first.decisions)
    if not sought:
        raise EgolocError("noise: expected GNSS positions or pose fixes that were applied, got none")
    search = _Search(kept, open_to_all(given), sought, first.aligned_ns + round(SETTLED_S * NS_PER_S), tell)
    x, information, likelihood = search.climb()
    spread = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
    found = {s.name: _found(s, x[i], spread[i]) for i, s in enumerate(sought)}
    after = run(kept, search.config(x))
    best = with_values(given, split_of({name: each.value for name, each in found.items()}))
    gain = likelihood - search.likelihood(_white(search.config(x)))
    return NoiseEstimate(found, best, gain, consistency(first.decisions), consistency(after.decisions), search.runs)


def with_values(config: FusionConfig, values: Mapping[str, float | bool]) -> FusionConfig:
    """A configuration with some of its numbers replaced, named as in ``gnss.inflation``."""
    for name, value in values.items():
        section, field = name.split(".")
        part = msgspec.structs.replace(getattr(config, section), **{field: value})
        config = msgspec.structs.replace(config, **{section: part})
    return config


def split_of(values: Mapping[str, float]) -> dict[str, float]:
    """The values with what is white beside what lasts: here they share the variance, so that its size has one name."""
    shares = {name: value for name, value in values.items() if name.endswith(".lasting_share")}
    white = {f"{name.partition('.')[0]}.white_share": 1.0 - value for name, value in shares.items()}
    return {**values, **white}


def open_to_all(config: FusionConfig) -> FusionConfig:
    """Without gates and floors: what counts must not depend on the noise that is tried. A lever arm that the vehicle
    calls uncertain is estimated: taken as white noise of every fix it would hide theirs."""
    wide = {"pose.max_sigma_longitudinal_m": 1e3, "pose.max_sigma_lateral_m": 1e3, "pose.max_sigma_yaw_deg": 1e3}
    floors = {"gnss.sigma_floor_horizontal_m", "gnss.sigma_floor_vertical_m", "gnss.sigma_floor_velocity"}
    floors |= {"pose.sigma_floor_m", "pose.sigma_floor_yaw_deg"}
    if not config.estimate.lever_arm:
        floors.add("estimate.lever_arm_sigma_m")
    opened = with_values(config, wide | dict.fromkeys(sorted(floors), 0.0) | {"estimate.lever_arm": True})
    return msgspec.structs.replace(opened, gates=Gates(use=False), output_hz=1.0)


def applied_only(log: Log, decisions: Decisions) -> Log:
    """The log without the measurements that were rejected or partly accepted."""
    names = {Sensor.GNSS_POSITION: "gnss", Sensor.GNSS_VELOCITY: "gnss_velocity", Sensor.POSE_FIX: "pose_fixes"}
    kept = {}
    for sensor, name in {**names, Sensor.WHEEL: "wheel"}.items():
        record = getattr(log, name)
        if record is not None:
            keep = np.ones(len(record), bool)
            keep[_refused(decisions, sensor)] = False
            kept[name] = record[keep]
            if sensor is Sensor.GNSS_POSITION:
                wrong = np.zeros(len(record), bool)
                wrong[_refused(decisions, Sensor.GNSS_YAW)] = True
                kept[name] = replace(kept[name], yaw=np.where(wrong[keep], np.nan, record.yaw[keep]))
    return replace(log, **kept)


def _refused(decisions: Decisions, sensor: Sensor) -> NDArray[np.int64]:
    """Rows of a sensor's record that took no part, but for those before the first state."""
    fine = (Reason.ACCEPTED, Reason.BEFORE_ALIGNMENT, Reason.USED_FOR_ALIGNMENT)
    refused = (decisions.sensor == sensor) & ~np.isin(decisions.reason, fine)
    rows: NDArray[np.int64] = decisions.row[refused]
    return rows


def _sought(decisions: Decisions) -> tuple[Sought, ...]:
    """What the applied measurements can tell of."""
    groups = {Sensor.GNSS_POSITION: GNSS, Sensor.GNSS_VELOCITY: VELOCITY, Sensor.POSE_FIX: POSE}
    here = {each.sensor for each in consistency(decisions)}
    found = tuple(s for sensor, group in groups.items() if sensor in here for s in group)
    return (*IMU, *found) if found else ()


def _white(config: FusionConfig) -> FusionConfig:
    """All noise white and as large as stated."""
    ones = dict.fromkeys(("gnss.inflation", "gnss.velocity_inflation", "pose.inflation"), 1.0)
    return with_values(config, ones | split_of({"gnss.lasting_share": 0.0, "pose.lasting_share": 0.0}))


def _found(sought: Sought, x: float, spread: float) -> Found:
    """Value and interval, out of the scale on which it was sought."""
    low, high = (sought.outward(x + 1.96 * side * min(spread, 20.0)) for side in (-1.0, 1.0))
    value = sought.outward(x)
    at_bound = not 1.001 * sought.low < value < 0.999 * sought.high
    return Found(sought.name, value, low, high, bool(spread < OBSERVED), at_bound)


class _Search:
    """Scoring over runs of one log; x: what is sought, on the scales of Sought."""

    def __init__(
        self,
        log: Log,
        config: FusionConfig,
        sought: Sequence[Sought],
        after_ns: int,
        tell: Callable[[str], None] | None,
    ) -> None:
        self._log, self.open, self._sought, self._after_ns = log, config, sought, after_ns
        self._tell = tell or (lambda _: None)
        self.runs = 0

    def config(self, x: Floats) -> FusionConfig:
        """The configuration at x."""
        return with_values(self.open, split_of({s.name: s.outward(x[i]) for i, s in enumerate(self._sought)}))

    def likelihood(self, config: FusionConfig) -> float:
        """Logarithm, but for a constant."""
        return _log_likelihood(*self._innovations(config))

    def climb(self) -> tuple[Floats, Floats, float]:
        """The top, Fisher's information there and the log-likelihood."""
        x = np.array([s.inward(s.start) for s in self._sought])
        value, variance = self._innovations(self.config(x))
        now, damping = _log_likelihood(value, variance), 1e-3
        information = np.eye(len(x))
        for turn in range(ROUNDS):
            self._tell(f"round {turn + 1}, {self.runs} runs")
            gradient, information = self._slope(x, value, variance)
            gain = 0.0
            while damping < 1e4:
                uphill = np.linalg.solve(information + damping * np.diag(np.diag(information) + 1e-9), gradient)
                there = self._within(x + np.clip(uphill, -REACH, REACH))
                value_there, variance_there = self._innovations(self.config(there))
                gain = _log_likelihood(value_there, variance_there) - now
                if gain > 0:
                    x, value, variance, now = there, value_there, variance_there, now + gain
                    damping = max(damping / 10.0, 1e-6)
                    break
                damping *= 10.0
            if gain < CLOSE:
                break
        return x, information, now

    def _within(self, x: Floats) -> Floats:
        """Back to the bounds."""
        return np.array([s.inward(s.outward(x[i])) for i, s in enumerate(self._sought)])

    def _slope(self, x: Floats, value: Floats, variance: Floats) -> tuple[Floats, Floats]:
        """Gradient of the log-likelihood and Fisher's information, from one run for each number."""
        values, logs = [], []
        for i, s in enumerate(self._sought):
            moved = x.copy()
            moved[i] += STEP if s.inward(s.outward(x[i] + STEP)) > x[i] else -STEP
            value_there, variance_there = self._innovations(self.config(moved))
            values.append((value_there - value) / (moved[i] - x[i]))
            logs.append(np.log(variance_there / variance) / (moved[i] - x[i]))
        v, s_ = (np.array(part).reshape(len(x), -1) for part in (values, logs))
        score, weight = value.ravel() ** 2 / variance.ravel(), 1.0 / variance.ravel()
        gradient = -0.5 * s_ @ (1.0 - score) - v @ (value.ravel() * weight)
        return gradient, 0.5 * s_ @ s_.T + (v * weight) @ v.T

    def _innovations(self, config: FusionConfig) -> tuple[Floats, Floats]:
        self.runs += 1
        return joint(run(self._log, config).decisions, SENSORS, self._after_ns)


def _log_likelihood(value: Floats, variance: Floats) -> float:
    return float(-0.5 * (value**2 / variance + np.log(variance)).sum())
