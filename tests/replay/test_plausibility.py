"""What must not pass for success is said, in the same words however the drive is cut."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fusion.result import FusionResult, Reason, Sensor
from replay.plausibility import SAMPLES, ImuWatch, Watch, imu_findings
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
    return FusionResult(parts[0], parts[1], result.aligned_ns)


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


@pytest.mark.parametrize("cuts", CUTS)
def test_a_filter_that_lost_track_is_told_from_when_to_when(cuts: tuple[float, ...]) -> None:
    log, result = drive(60.0)
    found = findings(log, rejecting(result, (5.0, 12.0), (15.0, 32.0), (40.0, 51.0)), cuts)
    assert found["lost"] == "The filter lost track: from 15.0 to 31.9 s it rejected all 340 positions."


@pytest.mark.parametrize("cuts", CUTS)
def test_nine_seconds_are_not_lost(cuts: tuple[float, ...]) -> None:
    """Of one sensor; both are hardly wrong at once for longer than a second."""
    log, result = drive(60.0)
    decisions = result.decisions
    alone = decisions.sensor == Sensor.GNSS_POSITION
    columns = {name: getattr(decisions, name)[alone] for name in decisions.__dataclass_fields__}
    gnss = replace(result, decisions=replace(decisions, **columns))
    assert "lost" not in findings(log, rejecting(gnss, (15.0, 24.9), (25.0, 34.9)), cuts)
    assert "lost" not in findings(log, rejecting(result, (15.0, 15.9), (20.0, 20.9)), cuts)
    found = findings(log, rejecting(result, (15.0, 15.9), (20.0, 21.2)), cuts)
    assert found["lost"] == "The filter lost track: from 20.0 to 21.1 s it rejected all 24 positions."


@pytest.mark.parametrize("cuts", CUTS)
def test_a_sensor_that_is_mostly_rejected_is_named(cuts: tuple[float, ...]) -> None:
    log, result = drive(60.0)
    found = findings(log, rejecting(result, (10.0, 45.0), sensor=Sensor.POSE_FIX), cuts)
    assert found == {"rejected": "The filter rejected most of a sensor: pose fix (350 of 600)."}


@pytest.mark.parametrize("cuts", CUTS)
def test_states_that_are_not_finite_are_counted(cuts: tuple[float, ...]) -> None:
    log, result = drive(60.0)
    llh, cov = result.states.llh.copy(), result.states.pose_cov.copy()
    llh[200:210, 2], cov[209:230, 5, 5] = np.nan, np.inf
    found = findings(log, replace(result, states=replace(result.states, llh=llh, pose_cov=cov)), cuts)
    assert found["not_finite"] == "The filter diverged: 30 of 600 states are not finite, the first after 20.0 s."


@pytest.mark.parametrize("cuts", CUTS)
def test_a_road_vehicle_is_not_that_fast(cuts: tuple[float, ...]) -> None:
    log, result = drive(60.0)
    velocity = result.states.vel_enu.copy()
    velocity[300] = (300.0, 400.0, 0.0)
    fast = replace(result, states=replace(result.states, vel_enu=velocity))
    assert findings(log, fast, cuts)["too_fast"] == "The filter diverged: its speed reaches 500 m/s."
    assert findings(log, fast, cuts, land_vehicle=False) == {}


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
