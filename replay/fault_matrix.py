"""What becomes of the filter when a sensor fails: one fault in the middle of a simulated drive, against its truth.

Drives are those of `clean`: white errors, so that what is seen is the fault's own. The fault begins in motion. Judged
is the time from its begin to the end of the drive, with the limits of a run.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.result import FusionResult, Health, States
from fusion.run import Session, joined
from replay.config import LIMITS, Limits
from replay.plausibility import Watch
from sensors.clock import NS_PER_S, seconds
from sensors.geodesy import enu_from_llh
from sensors.records import Log
from sensors.rotation import wrap, yaw_from_q
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, simulate_drive
from sensors.simulate.faults import FAULTS, SEVERITIES, Fault
from sensors.simulate.faults.inject import Injector
from sensors.simulate.faults.spec import Injection

Floats = NDArray[np.float64]

_DEFAULT = FusionConfig()
SENSOR_SETS: Mapping[str, tuple[str, ...]] = {
    "all sensors": ("imu", "gnss", "gnss_velocity", "pose_fixes", "wheel"),
    "without pose fixes": ("imu", "gnss", "gnss_velocity", "wheel"),
}
EARLIEST_S, LATEST_S = 60.0, 110.0
"""When faults may begin, s since the drive's."""
MOVING, MOVING_S = 5.0, 10.0
"""They begin when the vehicle will be faster than this for so long, m/s, s."""
SIGMAS = 5.0
"""Errors beyond so many of the filter's sigmas are errors that it does not know of."""
ALERT_S = 1.0
"""So long such an error may last before the state's health tells of it, s."""
NEVER_S = 1.0
"""An error that lasts until so short before the end of the drive was not recovered from, s."""


WELL = (Health.HEALTHY, Health.RECOVERED)
"""States that say nothing of an error."""


@dataclass(frozen=True)
class Subject:
    """A drive to put faults into, and the filter without them. begin_s: when faults begin, s since the IMU's first."""

    drive: Drive
    sensors: str
    begin_s: float
    seed: int
    config: FusionConfig = _DEFAULT
    limits: Limits = LIMITS["paper"]

    @cached_property
    def log(self) -> Log:
        """What of the drive the filter gets."""
        given: dict[str, Any] = {name: getattr(self.drive.log, name) for name in SENSOR_SETS[self.sensors]}
        return Log(**given, vehicle=self.drive.log.vehicle, map_frame=self.drive.log.map_frame)

    @cached_property
    def unharmed(self) -> Floats:
        """(N, 3) errors without a fault at the epochs of the drive, NaN before the first state."""
        result, _ = fused(self.log, (), self)
        return at_epochs(self, result.states)[0]

    @cached_property
    def epochs(self) -> NDArray[np.int64]:
        """(N,) ns: the output grid over the drive."""
        assert self.log.imu is not None
        period = round(NS_PER_S / self.config.output_hz)
        first, last = int(self.log.imu.t_ns[0]), int(self.log.imu.t_ns[-1])
        return np.arange(-(-first // period), last // period + 1, dtype=np.int64) * period

    @cached_property
    def truth(self) -> tuple[Floats, Floats]:
        """Place llh (N, 3) and yaw (N,) rad at the epochs."""
        motion = self.drive.truth.at(self.epochs)
        return motion.llh, yaw_from_q(motion.q_enu_body)

    @cached_property
    def largest(self) -> Floats:
        """(3,) limits: along m, left m, yaw deg."""
        return np.array([self.limits.lon_m, self.limits.lat_m, self.limits.yaw_deg])


@dataclass(frozen=True)
class Outcome:
    """What came of a fault. All from its begin on.

    ar: share of the epochs within the limits; peak_sigmas: largest error over sigma of any axis; recover_s: from the
    fault's end until the errors stay within the limits, or twice what they are without it (None: not in this drive);
    astray: in some epoch an error was beyond a limit and beyond SIGMAS; untold_s: the longest that it was while the
    state was said to be well; warned: kinds of the run's warnings; not_finite: states; crash: the exception that ended
    the run.
    """

    ar: float = 0.0
    peak_horizontal_m: float = np.inf
    peak_yaw_deg: float = np.inf
    peak_sigmas: float = np.inf
    recover_s: float | None = None
    astray: bool = True
    untold_s: float = 0.0
    warned: tuple[str, ...] = ()
    not_finite: int = 0
    left_out: int = 0
    crash: str = ""

    @property
    def silent(self) -> bool:
        """Whether it went astray and the states said that all is well for longer than ALERT_S."""
        return self.untold_s > ALERT_S

    @property
    def broken(self) -> bool:
        """Whether there was no usable result at all."""
        return bool(self.crash) or self.not_finite > 0


def subjects(count: int, first_seed: int, duration_s: float = 240.0) -> Iterator[Subject]:
    """Drives of seeds from first_seed on in which a fault can begin in motion, each with every set of sensors."""
    scenario, seed, found = scenarios.load("clean"), first_seed, 0
    while found < count:
        drive = simulate_drive(duration_s, seed, scenario)
        begin_s = begin_of_motion(drive)
        if begin_s is not None:
            found += 1
            for sensors in SENSOR_SETS:
                yield Subject(drive, sensors, begin_s, seed)
        seed += 1


def begin_of_motion(drive: Drive) -> float | None:
    """Whole seconds since the first IMU sample from which on the vehicle is fast for a while."""
    assert drive.log.imu is not None
    first = int(drive.log.imu.t_ns[0])
    s = np.arange(EARLIEST_S, LATEST_S + MOVING_S)
    speed = np.linalg.norm(drive.truth.at(first + (s * NS_PER_S).astype(np.int64)).vel_enu, axis=1)
    long = round(MOVING_S)
    fast = np.lib.stride_tricks.sliding_window_view(speed > MOVING, long).all(axis=1)
    return float(s[np.argmax(fast)]) if fast.any() else None


def acts_on(fault: Fault, sensors: str) -> bool:
    """Whether all records that a fault acts on are in a set of sensors."""
    return set(fault.acts) <= set(SENSOR_SETS[sensors])


def matrix(
    drives: Sequence[Subject], names: Sequence[str] = tuple(FAULTS), severities: Sequence[str] = SEVERITIES
) -> Iterator[tuple[str, str, str, list[Outcome]]]:
    """Fault, severity, set of sensors, and the outcome of each drive."""
    for name in names:
        for severity in severities:
            for sensors in SENSOR_SETS:
                mine = [subject for subject in drives if subject.sensors == sensors and acts_on(FAULTS[name], sensors)]
                if mine:
                    yield name, severity, sensors, [outcome(subject, name, severity) for subject in mine]


def outcome(subject: Subject, name: str, severity: str) -> Outcome:
    """Put a fault of its usual length into a drive."""
    fault = FAULTS[name]
    injection = Injection(fault, severity, subject.begin_s, fault.length_s(severity))
    try:
        result, warned = fused(subject.log, (injection,), subject)
    except Exception as error:
        return Outcome(crash=f"{type(error).__name__}: {error}")
    return judged(subject, result, warned, injection)


def fused(log: Log, injections: Sequence[Injection], subject: Subject) -> tuple[FusionResult, tuple[str, ...]]:
    """The filter's result and the kinds of its run's warnings."""
    assert log.imu is not None
    session, watch, results = Session(log.vehicle, log.map_frame, subject.config), Watch(land_vehicle=True), []
    with np.errstate(all="ignore"):
        for piece in Injector(injections, subject.seed).pieces([log]):
            results.append(session.push(piece))
            watch.add(piece, results[-1])
        results.append(session.finish())
        watch.add(Log(), results[-1])
    return joined(results), tuple(finding["kind"] for finding in watch.findings(int(log.imu.t_ns[0])))


def at_epochs(subject: Subject, states: States) -> tuple[Floats, Floats]:
    """Errors and sigmas (N, 3) at the epochs of the drive: along and left of the true heading m, yaw deg; NaN where
    there is no state."""
    rows = np.searchsorted(subject.epochs, states.t_ns)
    known = (rows < len(subject.epochs)) & (subject.epochs[np.minimum(rows, len(subject.epochs) - 1)] == states.t_ns)
    rows = rows[known]
    llh, yaw = (column[rows] for column in subject.truth)
    error, sigma = np.full((2, len(subject.epochs), 3), np.nan)
    apart = enu_from_llh(states.llh[known], llh[0]) - enu_from_llh(llh, llh[0]) if len(rows) else np.empty((0, 3))
    c, s = np.cos(yaw), np.sin(yaw)
    error[rows, 0], error[rows, 1] = c * apart[:, 0] + s * apart[:, 1], c * apart[:, 1] - s * apart[:, 0]
    error[rows, 2] = np.degrees(wrap(yaw_from_q(states.q_enu_body[known]) - yaw))
    P = states.pose_cov[known]
    ee, en, nn = P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]
    sigma[rows, 0] = np.sqrt(c * c * ee + 2 * c * s * en + s * s * nn)
    sigma[rows, 1] = np.sqrt(s * s * ee - 2 * c * s * en + c * c * nn)
    sigma[rows, 2] = np.degrees(np.sqrt(P[:, 5, 5]))
    return error, sigma


def judged(subject: Subject, result: FusionResult, warned: tuple[str, ...], injection: Injection) -> Outcome:
    """What came of a fault."""
    states = result.states
    finite = np.isfinite(states.llh).all(axis=1) & np.isfinite(states.pose_cov).all(axis=(1, 2))
    finite &= np.isfinite(states.vel_enu).all(axis=1) & np.isfinite(states.q_enu_body).all(axis=1)
    assert subject.log.imu is not None
    since = seconds(subject.epochs, int(subject.log.imu.t_ns[0])) - injection.begin_s
    error, sigma = (np.abs(rows[since >= 0.0]) for rows in at_epochs(subject, states))
    within = (error <= subject.largest).all(axis=1)
    with np.errstate(invalid="ignore"):
        beyond = error / sigma > SIGMAS
        lost = ~within & beyond.any(axis=1)
    fine = (error <= np.maximum(subject.largest, 2.0 * np.abs(subject.unharmed[since >= 0.0]))).all(axis=1)
    after = since[since >= 0.0] - injection.length_s
    return Outcome(
        ar=float(within.mean()),
        peak_horizontal_m=_largest(np.hypot(error[:, 0], error[:, 1])),
        peak_yaw_deg=_largest(error[:, 2]),
        peak_sigmas=_largest(error / sigma),
        recover_s=_recovery(after[(after > 0.0) & ~fine], float(after[-1])),
        astray=bool(lost.any()) or not finite.all(),
        untold_s=_longest(lost & well_at(subject, states)[since >= 0.0]) / subject.config.output_hz,
        warned=warned,
        not_finite=int((~finite).sum()),
        left_out=sum(entry.count for entry in result.left_out),
    )


def well_at(subject: Subject, states: States) -> NDArray[np.bool_]:
    """(N,) whether the state of each epoch of the drive is said to be healthy, or recovered."""
    well = np.zeros(len(subject.epochs), bool)
    rows = np.searchsorted(subject.epochs, states.t_ns)
    well[rows[rows < len(well)]] = np.isin(states.health, WELL)[rows < len(well)]
    return well


def _longest(bad: NDArray[np.bool_]) -> int:
    """So many in a row at most."""
    edges = np.flatnonzero(np.diff(np.r_[False, bad, False]))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _recovery(bad_s: Floats, last_s: float) -> float | None:
    """From the fault's end to the last bad epoch; None where that is the end of the drive."""
    if not len(bad_s):
        return 0.0
    return None if bad_s[-1] > last_s - NEVER_S else float(bad_s[-1])


def _largest(values: Floats) -> float:
    known = values[~np.isnan(values)]
    return float(known.max()) if known.size else float(np.inf)
