"""The filter's own judgement: states of health, levels of the sensors, and divergence that never looks like success."""

from collections import Counter
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.config import FusionConfig, Gates, HealthModel
from fusion.filter import Localizer
from fusion.health import SOURCES
from fusion.result import Cause, FusionResult, Health, Level, Sensor
from fusion.run import Session, joined, run
from sensors.pieces import SENSORS, join
from sensors.records import GnssStatus, Log
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, simulate_drive
from sensors.simulate.faults.inject import Injector
from sensors.simulate.faults.spec import parse
from sensors.simulate.gnss import displaced
from tests.fusion.free import Floats
from tests.fusion.rough import LIMITS, fused_errors, off
from tests.fusion.scenes import seconds, with_outage, without, without_yaw

LENGTH_S = 120.0
NOT_SUCCESS = (Health.DIVERGED, Health.DEAD_RECKONING, Health.DEGRADED)
OPEN = FusionConfig(gates=Gates(use=False))
"""Whatever comes is applied."""


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Two minutes of city, GNSS and pose fixes throughout, moving most of the time."""
    return simulate_drive(LENGTH_S, 100_007, scenarios.load("clean"))


def health(result: FusionResult, log: Log) -> tuple[Floats, NDArray[np.int8]]:
    """Seconds and states of health."""
    return seconds(log, result.states.t_ns), result.states.health


def told(result: FusionResult) -> list[tuple[Health, Cause]]:
    """States of health with their causes, one after the other."""
    pairs = np.stack((result.states.health, result.states.cause), axis=1)
    first = np.r_[True, (pairs[1:] != pairs[:-1]).any(axis=1)]
    return [(Health(int(h)), Cause(int(c))) for h, c in pairs[first]]


def level(result: FusionResult, sensor: Sensor) -> NDArray[np.int8]:
    return result.states.levels[:, SOURCES.index(sensor)]


def gnss_alone(log: Log) -> Log:
    return without_yaw(replace(log, pose_fixes=None))


def test_codes_of_sources_are_rows() -> None:
    assert tuple(int(sensor) for sensor in SOURCES) == tuple(range(len(SOURCES)))


def test_a_good_drive_is_healthy(drive: Drive) -> None:
    result = run(drive.log)
    assert told(result) == [(Health.HEALTHY, Cause.NONE)]
    for sensor in (Sensor.GNSS_POSITION, Sensor.GNSS_VELOCITY, Sensor.POSE_FIX, Sensor.WHEEL):
        assert (level(result, sensor)[1:] == Level.GOOD).all()
    assert (level(result, Sensor.GNSS_YAW) == Level.ABSENT).all()
    assert result.restarts == ()


def test_an_outage_is_dead_reckoning_and_then_recovered(drive: Drive) -> None:
    log = with_outage(drive.log, 40.0, 20.0)
    result = run(log)
    assert told(result) == [
        (Health.HEALTHY, Cause.NONE),
        (Health.DEGRADED, Cause.POSE_FIX),  # stale before GNSS is
        (Health.DEAD_RECKONING, Cause.NONE),
        (Health.DEGRADED, Cause.POSE_FIX),  # one sensor returns before the other
        (Health.RECOVERED, Cause.NONE),
        (Health.HEALTHY, Cause.NONE),
    ]
    s, states = health(result, log)
    begun, back = s[states == Health.DEAD_RECKONING][0], s[states == Health.RECOVERED][0]
    assert 42.9 < begun < 43.2
    assert 60.0 < back < 60.3
    assert s[states == Health.RECOVERED][-1] - back == pytest.approx(10.0, abs=0.15)
    inside = (s > 43.2) & (s < 60.0)
    assert (level(result, Sensor.GNSS_POSITION)[inside] == Level.STALE).all()
    assert (level(result, Sensor.WHEEL)[inside] == Level.GOOD).all()


@pytest.mark.parametrize(
    ("lost", "cause", "after_s"),
    [
        ("gnss", Cause.GNSS_POSITION, 3.0),
        ("gnss_velocity", Cause.GNSS_VELOCITY, 3.0),
        ("pose_fixes", Cause.POSE_FIX, 1.5),
        ("wheel", Cause.WHEEL, 1.0),
    ],
)
def test_a_sensor_that_falls_silent_degrades(drive: Drive, lost: str, cause: Cause, after_s: float) -> None:
    log = replace(drive.log, **{lost: without(getattr(drive.log, lost), drive.log, 50.0, 1e9)})
    result = run(log)
    assert told(result) == [(Health.HEALTHY, Cause.NONE), (Health.DEGRADED, cause)]
    s, states = health(result, log)
    assert s[states == Health.DEGRADED][0] == pytest.approx(50.0 + after_s, abs=0.25)
    assert level(result, Sensor(cause - 1))[-1] == Level.STALE


def test_a_wrong_fix_makes_gnss_suspect_and_nothing_else(drive: Drive) -> None:
    assert drive.log.gnss is not None
    s = seconds(drive.log, drive.log.gnss.t_ns)
    wrong = off(drive.log.gnss, (s > 40.0) & (s < 60.0), np.array([3.0, -2.0, 0.0]), GnssStatus.FIXED, 0.015)
    result = run(replace(drive.log, gnss=wrong))
    s, states = health(result, drive.log)
    inside = (s > 41.0) & (s < 60.0)
    assert (level(result, Sensor.GNSS_POSITION)[inside] == Level.SUSPECT).all()
    assert (level(result, Sensor.POSE_FIX)[inside] == Level.GOOD).all()
    assert (states[inside] == Health.DEGRADED).all()
    assert (states[s > 61.5] == Health.HEALTHY).all()
    assert (np.abs(fused_errors(result, drive)) < LIMITS).all()


def test_large_sigmas_degrade(drive: Drive) -> None:
    """The yaw of a course, until driving has made it known."""
    log = replace(gnss_alone(drive.log), gnss_velocity=None)
    result = run(log, FusionConfig(health=HealthModel(max_sigma_yaw_deg=1.0)))
    assert told(result) == [(Health.DEGRADED, Cause.SIGMA), (Health.HEALTHY, Cause.NONE)]
    well = result.states.health == Health.HEALTHY
    yaw = np.degrees(result.states.sigma[:, 8])
    assert yaw[well].max() <= 1.0 < yaw[~well].min()


def swapped(log: Log, order: list[int]) -> Log:
    """Axes of the IMU in another order."""
    assert log.imu is not None
    return replace(log, imu=replace(log.imu, gyro=log.imu.gyro[:, order], accel=log.imu.accel[:, order]))


def in_g(log: Log) -> Log:
    assert log.imu is not None
    return replace(log, imu=replace(log.imu, accel=log.imu.accel / 9.80665))


def in_degrees(log: Log) -> Log:
    assert log.imu is not None
    return replace(log, imu=replace(log.imu, gyro=np.degrees(log.imu.gyro)))


def far_antenna(log: Log) -> Log:
    return replace(log, vehicle=msgspec.structs.replace(log.vehicle, gnss_lever_arm=(30.0, 0.0, 0.0)))


def wandering(log: Log) -> Log:
    """Fixed solutions that walk away by two metres a fix."""
    assert log.gnss is not None
    steps = np.random.default_rng(0).normal(0.0, 2.0, (len(log.gnss), 3))
    return replace(log, gnss=replace(log.gnss, llh=displaced(log.gnss.llh, np.cumsum(steps, axis=0))))


def nine_metres_off(log: Log) -> Log:
    assert log.gnss is not None
    everywhere = np.ones(len(log.gnss))
    return replace(log, gnss=off(log.gnss, everywhere > 0, np.array([5.0, -8.0, 0.0]), GnssStatus.FIXED, 0.015))


CASES = {
    "lever arm 30 m wrong": (lambda log: far_antenna(gnss_alone(log)), FusionConfig(), 45.0),
    "x and y swapped": (lambda log: swapped(gnss_alone(log), [1, 0, 2]), FusionConfig(), 6.0),
    "x and z swapped": (lambda log: swapped(log, [2, 1, 0]), FusionConfig(), 0.5),
    "x and z swapped, gnss alone": (lambda log: swapped(gnss_alone(log), [2, 1, 0]), FusionConfig(), 0.5),
    "in g": (in_g, FusionConfig(), 20.0),
    "in g, gnss alone": (lambda log: in_g(gnss_alone(log)), FusionConfig(), 6.0),
    "in degrees": (in_degrees, FusionConfig(), 3.0),
    "gates off, gnss 9 m off": (nine_metres_off, OPEN, 2.0),
    "gates off, gnss walks": (wandering, OPEN, 2.0),
}
"""Log, config, and so long after its first state, s, no state is said to be well any more, whatever brings it back."""


@pytest.mark.parametrize("name", CASES)
def test_divergence_never_looks_like_success(drive: Drive, name: str) -> None:
    """A lever arm shows in the first turn, not before: only there may a far state be said to be well."""
    made, config, told_s = CASES[name]
    log = made(drive.log)
    result = run(log, config)
    diverged = result.states.health == Health.DIVERGED
    far = np.hypot(*fused_errors(result, drive)[:, :2].T) > 2.0
    well = np.isin(result.states.health, (Health.HEALTHY, Health.RECOVERED))
    counts = Counter(Health(int(h)).name for h in result.states.health)
    causes = Counter(Cause(int(c)).name for c in result.states.cause[diverged])
    s = seconds(log, result.states.t_ns)
    last = s[well].max(initial=s[0]) - s[0]
    print(f"{name}: {dict(counts)}, {dict(causes)}, far {far.mean():.2f}, {len(result.restarts)} restarts")
    print(f"well for the first {last:.1f} s")
    assert diverged.any()
    assert not well[s > s[0] + told_s].any()
    assert (far & well).any() == (name == "lever arm 30 m wrong")
    assert (result.states.cause[diverged] >= Cause.NOT_FINITE).all()


def test_gates_off_and_gnss_walking_alone_is_suspect_throughout(drive: Drive) -> None:
    """Nothing contradicts it but the IMU: never healthy."""
    result = run(wandering(gnss_alone(drive.log)), OPEN)
    s, states = health(result, drive.log)
    assert np.isin(states[s > s[0] + 3.0], NOT_SUCCESS).all()
    assert (level(result, Sensor.GNSS_POSITION)[s > s[0] + 3.0] == Level.SUSPECT).mean() > 0.95


def test_what_is_not_finite_is_diverged_and_begun_anew(drive: Drive) -> None:
    """A covariance spoilt from outside: the next position finds it, a second of IMU later the filter is back."""
    localizer = Localizer(drive.log.vehicle, drive.log.map_frame)
    for begin in (False, True):
        for name in ("gnss", "gnss_velocity", "pose_fixes", "wheel", "imu"):
            record = getattr(drive.log, name)
            after = seconds(drive.log, record.t_ns) >= 60.0
            localizer.push(record[after == begin])
        if not begin:
            assert localizer.core is not None
            localizer.core.P[4, 4] = np.nan
    states = localizer.take_states()
    s = seconds(drive.log, states.t_ns)
    spoilt = ~np.isfinite(states.pose_cov).all(axis=(1, 2))
    assert spoilt.sum() <= 1  # an output may come before that position
    assert (states.cause[spoilt] == Cause.NOT_FINITE).all()
    gap = np.flatnonzero(np.diff(s) > 0.5)
    assert len(gap) == 1
    assert s[gap[0] + 1] - s[gap[0]] < 1.5
    assert (states.health[(s > s[gap[0]] + 0.05) & (s < s[gap[0] + 1] + 9.9)] == Health.RECOVERED).all()
    assert states.health[-1] == Health.HEALTHY


def test_health_without_restart_is_never_well_again(drive: Drive) -> None:
    """Votes bring it back again and again."""
    log = in_g(drive.log)
    result = run(log, FusionConfig(health=HealthModel(restart=False)))
    s, states = health(result, log)
    assert result.restarts == ()
    assert np.isin(states[s > 30.0], NOT_SUCCESS).all()
    assert (states == Health.DIVERGED).any()
    assert (result.states.cause[s > 30.0] == Cause.UNSETTLED).any()


@pytest.mark.parametrize("spec", ["pose-drift:mild@50+30", "gnss-drift:mild@50+30"])
def test_two_sensors_that_drift_apart_are_told(drive: Drive, spec: str) -> None:
    """By 3 cm a second no single position is rejected for long: what lasts of their errors takes it in."""
    log = join(Injector(parse([spec]), 0).pieces([drive.log]))
    result = run(log)
    s, states = health(result, log)
    assert np.isin(states[(s > 62.0) & (s < 80.0)], NOT_SUCCESS).all()
    assert Cause.LASTING_ERROR in result.states.cause[(s > 62.0) & (s < 80.0)]
    assert not (result.states.cause[s < 50.0] == Cause.LASTING_ERROR).any()


def test_a_yaw_that_the_imu_turned_against_pose_fixes_is_told() -> None:
    """A turn rate of the wrong sign for ten seconds of a bend; with a degree of yaw the fixes pass."""
    drive = simulate_drive(180.0, 100_014, scenarios.load("clean"))
    log = join(Injector(parse(["imu-axis-flip:severe@67+10"]), 100_014).pieces([drive.log]))
    result = run(log)
    s, states = health(result, log)
    off_yaw = np.abs(fused_errors(result, drive)[:, 2]) > 1.0
    assert off_yaw.sum() > 100
    assert np.isin(states[off_yaw & (s > 75.0)], NOT_SUCCESS).all()


@pytest.mark.parametrize(
    "made", [in_g, lambda log: gnss_alone(wandering(log)), lambda log: gnss_alone(with_outage(log, 40.0, 30.0))]
)
def test_health_does_not_depend_on_the_pieces(drive: Drive, made) -> None:  # type: ignore[no-untyped-def]
    """Restarts included: random cuts give the same bits."""
    log = made(drive.log)
    whole = run(log)
    assert log.imu is not None
    for seed in range(4):
        cuts = np.sort(np.random.default_rng(seed).choice(log.imu.t_ns, 25)) + seed
        session, results = Session(log.vehicle, log.map_frame), []
        for begin, end in zip([-(2**62), *cuts.tolist()], [*cuts.tolist(), 2**62], strict=True):
            parts = {}
            for name in SENSORS:
                record = getattr(log, name)
                rows = None if record is None else record[(record.t_ns >= begin) & (record.t_ns < end)]
                parts[name] = rows if rows is not None and len(rows) else None
            results.append(session.push(replace(log, **parts)))
        cut = joined([*results, session.finish()])
        assert cut.restarts == whole.restarts
        for part in ("states", "decisions"):
            for name in getattr(whole, part).__dataclass_fields__:
                one, other = (getattr(getattr(result, part), name) for result in (whole, cut))
                assert one.tobytes() == other.tobytes(), name
    assert made is not in_g or len(whole.restarts) > 0
