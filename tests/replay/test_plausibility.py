"""What must not pass for success is said, in the same words however the drive is cut."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fusion.result import Cause, FusionResult, Health, Reason, Restart, Sensor
from replay.health import Tally, health_metrics, health_note
from replay.plausibility import DIVERGED, SAMPLES, ImuWatch, Watch, imu_findings
from sensors.records import Imu, Log
from tests.replay.assembling import nothing
from tests.replay.drives import START_NS, drive, stamps, still_imu

S = 1_000_000_000


def findings(
    log: Log, result: FusionResult, cuts: tuple[float, ...] = (), *, land_vehicle: bool = True
) -> dict[str, str]:
    """Kind -> sentence; cuts: where the drive is cut, s."""
    watch = Watch(land_vehicle=land_vehicle)
    edges = [-(2**62), *(START_NS + round(cut * S) for cut in cuts), 2**62]
    for begin, end in pairwise(edges):
        watch.add(replace(log, imu=_part(log.imu, begin, end)), _result(result, begin, end))
    watch.add(Log(), nothing(result.aligned_ns))
    return {entry["kind"]: entry["text"] for entry in watch.findings(START_NS)}


def _part(imu: Imu | None, begin: int, end: int) -> Imu | None:
    assert imu is not None
    rows = imu[(imu.t_ns >= begin) & (imu.t_ns < end)]
    return rows if len(rows) else None


def _result(result: FusionResult, begin: int, end: int) -> FusionResult:
    parts = []
    for record in (result.states, result.decisions):
        rows = (record.t_ns >= begin) & (record.t_ns < end)
        parts.append(type(record)(**{name: getattr(record, name)[rows] for name in record.__dataclass_fields__}))
    restarts = tuple(restart for restart in result.restarts if begin <= restart.t_ns < end)
    return FusionResult(parts[0], parts[1], result.aligned_ns, (), restarts)


def rejecting(result: FusionResult, *stretches: tuple[float, float], sensor: Sensor | None = None) -> FusionResult:
    """The result with the positions of some stretches (s) rejected by the chi-square gate."""
    t_ns, reason = result.decisions.t_ns, result.decisions.reason.copy()
    for begin, end in stretches:
        inside = (t_ns >= START_NS + round(begin * S)) & (t_ns < START_NS + round(end * S))
        reason[inside & ((result.decisions.sensor == sensor) | (sensor is None))] = Reason.CHI_SQUARE
    return replace(result, decisions=replace(result.decisions, reason=reason))


CUTS = [(), (30.0,), (12.3, 20.05, 20.15, 31.0, 59.95)]


@pytest.mark.parametrize("cuts", CUTS)
def test_a_good_drive_has_no_findings(cuts: tuple[float, ...]) -> None:
    assert findings(*drive(60.0), cuts) == {}


def diverging(result: FusionResult, cause: Cause, *stretches: tuple[float, float]) -> FusionResult:
    """The result of a filter that says it had diverged over some stretches (s)."""
    health, causes = result.states.health.copy(), result.states.cause.copy()
    for begin, end in stretches:
        inside = slice(*np.searchsorted(result.states.t_ns, [START_NS + round(s * S) for s in (begin, end)]))
        health[inside], causes[inside] = Health.DIVERGED, cause
    return replace(result, states=replace(result.states, health=health, cause=causes))


@pytest.mark.parametrize("cuts", CUTS)
@pytest.mark.parametrize("cause", DIVERGED)
def test_a_filter_that_diverged_is_told_from_when_to_when(cause: Cause, cuts: tuple[float, ...]) -> None:
    log, result = drive(60.0)
    kind, words = DIVERGED[cause]
    once = diverging(result, cause, (15.0, 32.0))
    assert findings(log, once, cuts) == {kind: f"The filter diverged from 15.0 to 31.9 s: {words}."}
    thrice = diverging(result, cause, (5.0, 12.0), (15.0, 32.0), (40.0, 60.0))
    assert findings(log, thrice, cuts)[kind] == f"The filter diverged from 5.0 to 11.9 s, and 2 times more: {words}."


@pytest.mark.parametrize("cuts", CUTS)
def test_each_cause_is_told_apart(cuts: tuple[float, ...]) -> None:
    """One follows another without a pause, at a cut as well."""
    log, result = drive(60.0)
    result = diverging(diverging(result, Cause.REJECTED, (10.0, 50.0)), Cause.TOO_FAST, (30.0, 40.0))
    found = findings(log, result, cuts)
    assert found["too_fast"].startswith("The filter diverged from 30.0 to 39.9 s: ")
    assert found["lost"].startswith("The filter diverged from 10.0 to 29.9 s, and once more: ")


def test_every_cause_of_divergence_has_words() -> None:
    assert set(DIVERGED) == {cause for cause in Cause if Cause.NOT_FINITE <= cause <= Cause.TILTED}


@pytest.mark.parametrize(
    ("seconds", "words"), [((21.5,), "once, at 21.5 s"), ((21.5, 48.0), "2 times, first at 21.5 s")]
)
def test_new_starts_are_told(seconds: tuple[float, ...], words: str) -> None:
    log, result = drive(60.0)
    restarts = tuple(Restart(START_NS + round(s * S), Cause.REJECTED) for s in seconds)
    found = findings(log, replace(result, restarts=restarts))
    assert found == {"restarted": f"The filter was started again {words}: positions contradict it."}


def test_shares_of_time() -> None:
    """600 epochs of which the first 100 have no state; of the others 20 are lost, 30 degraded by the wheel."""
    _, result = drive(60.0, aligned_s=10.0)
    result = diverging(result, Cause.REJECTED, (20.0, 22.0))
    health, cause = result.states.health, result.states.cause
    health[300:330], cause[300:330] = Health.DEGRADED, Cause.WHEEL
    tally = Tally()
    tally.add(replace(result, restarts=(Restart(0, Cause.REJECTED),)))
    counts = tally.counts(600)
    assert counts == {
        "initializing": 100,
        "healthy": 450,
        "degraded/wheel": 30,
        "diverged/rejected": 20,
        "restarts": 1,
    }
    shares = health_metrics(counts)
    assert shares["initializing"] == 100 / 600
    assert shares["degraded"] == shares["degraded_by"]["wheel"] == 0.05
    assert shares["diverged_by"] == {"rejected": 20 / 600}
    assert shares["recovered"] == shares["dead_reckoning"] == 0.0
    assert sum(shares[state.name.lower()] for state in Health) == pytest.approx(1.0)
    assert health_note(shares) == (
        "Health, % of time: initializing 16.7, healthy 75.0, degraded 5.0 (wheel 5.0), diverged 3.3 (rejected 3.3); "
        "started again once."
    )


@pytest.mark.parametrize("cuts", CUTS)
def test_a_sensor_that_is_mostly_rejected_is_named(cuts: tuple[float, ...]) -> None:
    log, result = drive(60.0)
    found = findings(log, rejecting(result, (10.0, 45.0), sensor=Sensor.POSE_FIX), cuts)
    assert found == {"rejected": "The filter rejected most of a sensor: pose fix (350 of 600)."}


def test_a_filter_that_never_aligned_has_no_output() -> None:
    log, result = drive(60.0, aligned_s=99.0)
    assert "never aligned, there is no output" in findings(log, result, (30.0,))["never_aligned"]


@pytest.mark.parametrize(
    ("force", "words"),
    [((0.0, 0.0, 1.0), "is it in g?"), ((0.0, 0.0, -9.81), "does z point down?"), ((9.81, 0.0, 0.0), "z up.")],
)
def test_an_imu_in_other_units_or_axes(force: tuple[float, float, float], words: str) -> None:
    log, result = drive(60.0)
    imu = still_imu(60.0)
    log = replace(log, imu=replace(imu, accel=np.tile(force, (len(imu), 1))))
    for cuts in CUTS:
        assert words in findings(log, result, cuts)["specific_force"]


def test_an_imu_in_degrees() -> None:
    log, result = drive(60.0)
    gyro = np.zeros((6000, 3))
    gyro[::20, 2] = 20.0
    log = replace(log, imu=replace(still_imu(60.0), gyro=gyro))
    for cuts in CUTS:
        assert "turns faster than 20.0 rad/s" in findings(log, result, cuts)["turn_rate"]


def test_the_samples_that_are_looked_at_do_not_depend_on_the_pieces() -> None:
    """More samples than are kept: every 4th of them, whatever the pieces."""
    rng = np.random.default_rng(0)
    n = 4 * SAMPLES - 100
    t_ns = stamps(n / 100.0, 100.0)
    imu = Imu(t_ns, t_ns, rng.normal(0, 1, (n, 3)), rng.normal((0, 0, 5), 1, (n, 3)))
    whole = list(imu_findings(imu, land_vehicle=True))
    assert dict(whole)["specific_force"] == (
        "IMU: the median specific force is "
        f"({', '.join(f'{value:.2f}' for value in np.median(imu.accel[::4], axis=0))}) m/s^2, "
        "expected about (0, 0, 9.8), z up."
    )
    for cuts in ([1, 7, 20_000], sorted(rng.integers(0, n, 50).tolist())):
        watch = ImuWatch(land_vehicle=True)
        for begin, end in zip([0, *cuts], [*cuts, n], strict=True):
            watch.add(imu[begin:end])
        assert list(watch.findings()) == whole
