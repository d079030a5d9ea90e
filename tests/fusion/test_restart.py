"""Back after long outages and from wrong states, and what must not bring it back to a wrong place."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest

from fusion.filter import Localizer
from fusion.result import Cause, FusionResult, Health, Reason, Sensor, States
from fusion.run import run
from fusion.state import E_ATTITUDE, E_POSITION, E_VELOCITY, QUATERNION, VELOCITY
from sensors.records import Log
from sensors.rotation import matrix_from_q, q_from_matrix, q_from_rpy
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, simulate_drive
from tests.fusion.free import Floats
from tests.fusion.rough import fused_errors
from tests.fusion.scenes import seconds, with_outage, without, without_yaw

BEGIN_S = 100.0
AFTER_S = 100.0
WITHIN_S = {"all": 5.0, "gnss": 62.0}
"""Back within this of the return of the sensors: with pose fixes, and with GNSS alone (near 60 s, see docs)."""


@cache
def drive_of(grade: str, length_s: float, seed: int) -> Drive:
    scene = scenarios.load("clean")
    imu = msgspec.structs.replace(scene.imu, preset=grade)
    return simulate_drive(BEGIN_S + length_s + AFTER_S, seed, msgspec.structs.replace(scene, imu=imu))


def gnss_alone(log: Log) -> Log:
    return without_yaw(replace(log, pose_fixes=None))


def back_after(log: Log, result: FusionResult, drive: Drive, since_s: float, most: tuple[float, float]) -> float:
    """Seconds from since_s to the last state that is off by more than so many metres or degrees, or is missing."""
    s, errors = seconds(log, result.states.t_ns), np.abs(fused_errors(result, drive))
    bad = (np.hypot(errors[:, 0], errors[:, 1]) > most[0]) | (errors[:, 2] > most[1])
    late = s[(s > since_s) & bad]
    gaps = np.flatnonzero(np.diff(s) > 0.15)
    ends = s[gaps + 1][s[gaps + 1] > since_s]
    return float(max([since_s, *late[-1:], *ends[-1:]]) - since_s)


@pytest.mark.parametrize("wheel", [True, False], ids=["wheel", "no wheel"])
@pytest.mark.parametrize("grade", ["tactical", "automotive", "consumer"])
@pytest.mark.parametrize("length_s", [60.0, 300.0, pytest.param(1200.0, marks=pytest.mark.slow)])
def test_back_after_a_long_outage(length_s: float, grade: str, wheel: bool) -> None:
    """No GNSS, no pose fixes; then both, or GNSS without a second antenna. Errors of kilometres included."""
    for seed in (1, 2, 3):
        drive = drive_of(grade, length_s, seed)
        log = with_outage(drive.log, BEGIN_S, length_s)
        log = log if wheel else replace(log, wheel=None)
        end_s = BEGIN_S + length_s
        for name, given, most in (("all", log, (0.6, 1.0)), ("gnss", gnss_alone(log), (1.0, 3.0))):
            result = run(given)
            took = back_after(given, result, drive, end_s, most)
            s = seconds(given, result.states.t_ns)
            before = np.hypot(*fused_errors(result, drive)[s < end_s][-1, :2])
            print(f"{grade}, {length_s:.0f} s, seed {seed}, {name}: {before:.1f} m off, back after {took:.1f} s")
            assert took < WITHIN_S[name]
            assert (result.states.health[s > end_s + WITHIN_S[name] + 11.0] == Health.HEALTHY).all()


def test_far_off_gnss_alone_is_believed_within_seconds() -> None:
    """After minutes without any and without the wheel: the state gives way, and does not pass for healthy meanwhile."""
    drive = drive_of("automotive", 300.0, 1)
    log = gnss_alone(with_outage(replace(drive.log, wheel=None), BEGIN_S, 300.0))
    result = run(log)
    back_s = BEGIN_S + 300.0
    s, off = seconds(log, result.states.t_ns), np.hypot(*fused_errors(result, drive)[:, :2].T)
    assert off[s < back_s][-1] > 5.0
    took = back_after(log, result, drive, back_s, (1.0, 3.0))
    assert 0.5 < took < 3.0
    assert result.restarts == ()
    health = result.states.health
    assert np.isin(health[(s > back_s) & (s < back_s + took)], (Health.DEAD_RECKONING, Health.DEGRADED)).all()
    assert (health[s > back_s + 45.0] == Health.HEALTHY).all()


@pytest.fixture(scope="module")
def drive() -> Drive:
    return simulate_drive(240.0, 3, scenarios.load("clean"))


def turned(drive: Drive, log: Log, at_s: float, degrees: float) -> States:
    """States after yaw and velocity were turned and the position moved by 50 m, with a covariance that knows."""
    localizer = Localizer(log.vehicle, log.map_frame)

    def push(after: bool) -> None:
        for name in ("gnss", "gnss_velocity", "pose_fixes", "wheel", "imu"):
            record = getattr(log, name)
            if record is not None:
                localizer.push(record[(seconds(log, record.t_ns) >= at_s) == after])

    push(False)
    core = localizer.core
    assert core is not None
    angle = np.radians(degrees)
    turn = matrix_from_q(q_from_rpy(0.0, 0.0, angle)[0])
    core.nav[QUATERNION] = q_from_matrix((turn @ matrix_from_q(core.nav[QUATERNION]))[None])[0]
    core.nav[VELOCITY] = turn @ core.nav[VELOCITY]
    core.nav[0] += 50.0 / 6.37e6
    lever = np.array([-core.nav[4], core.nav[3], 0.0])  # velocity per rad of yaw
    core.P[E_POSITION, E_POSITION] += np.diag([100.0**2, 100.0**2, 0.0])
    core.P[E_VELOCITY, E_VELOCITY] += np.outer(lever, lever) * angle**2 + np.diag([1.0, 1.0, 0.0])
    core.P[E_VELOCITY, 8] += lever * angle**2
    core.P[8, E_VELOCITY] += lever * angle**2
    core.P[E_ATTITUDE, E_ATTITUDE] += np.diag([0.0, 0.0, angle**2])
    localizer.take_states()
    push(True)
    return localizer.take_states()


@pytest.mark.parametrize("degrees", [10.0, 20.0, 40.0, 90.0])
@pytest.mark.parametrize(("sensors", "within_s"), [("all", 1.6), ("gnss and velocity", 1.6), ("gnss positions", 13.0)])
def test_a_yaw_far_from_linear_does_not_wreck_the_velocity(
    drive: Drive, sensors: str, within_s: float, degrees: float
) -> None:
    """At 8 m/s. Positions alone lead the linear update astray from 20 deg on, until the filter starts again."""
    log = drive.log if sensors == "all" else gnss_alone(drive.log)
    log = replace(log, gnss_velocity=None) if sensors == "gnss positions" else log
    states = turned(drive, log, 102.0, degrees)
    s = seconds(log, states.t_ns) - 102.0
    off = np.linalg.norm(states.vel_enu - drive.truth.at(states.t_ns).vel_enu, axis=1)
    wrong = s[off > 0.3]
    print(
        f"{sensors}, {degrees:g} deg: velocity wrong for {wrong[-1] if len(wrong) else 0:.1f} s, by {off.max():.1f} m/s"
    )
    assert not (off[s > within_s] > 0.3).any()
    assert (np.diff(s) < 3.0).all()


def lane_off(log: Log, since_s: float, metres: float) -> Log:
    """Pose fixes to the left of where they are, from then on."""
    assert log.pose_fixes is not None
    fixes = log.pose_fixes
    left = np.column_stack((-np.sin(fixes.pose[:, 2]), np.cos(fixes.pose[:, 2]), np.zeros(len(fixes))))
    inside = seconds(log, fixes.t_ns) >= since_s
    return replace(log, pose_fixes=replace(fixes, pose=fixes.pose + metres * inside[:, None] * left))


@pytest.mark.parametrize("gnss", [True, False], ids=["with gnss", "without gnss"])
@pytest.mark.parametrize("metres", [3.5, -7.0])
def test_a_steady_alias_does_not_capture(drive: Drive, metres: float, gnss: bool) -> None:
    """One lane or two, for more than two minutes."""
    log = lane_off(drive.log, 100.0, metres)
    if not gnss:
        log = replace(log, **{n: without(getattr(log, n), log, 100.0, 1e9) for n in ("gnss", "gnss_velocity")})
    result = run(log)
    s, errors = seconds(log, result.states.t_ns), fused_errors(result, drive)
    assert result.restarts == ()
    assert np.abs(errors[s > 100.0, 1]).max() < (0.1 if gnss else 2.0)  # dead reckoning with the wheel
    after = result.states.health[s > 105.0]
    if gnss:
        assert (after == Health.DEGRADED).all()
        assert (result.states.cause[s > 105.0] == Cause.POSE_FIX).all()
    else:
        assert np.isin(after, (Health.DEAD_RECKONING, Health.DIVERGED)).all()


def started_wrong(log: Log, metres: float) -> Log:
    """A first half minute of pose fixes that are off in x and y, and no GNSS."""
    assert log.pose_fixes is not None
    s = seconds(log, log.pose_fixes.t_ns)
    pose = log.pose_fixes.pose + np.where(s[:, None] < 30.0, [metres, metres, 0.0], 0.0)
    log = replace(log, pose_fixes=replace(log.pose_fixes, pose=pose))
    return replace(log, **{n: without(getattr(log, n), log, -1.0, 30.0) for n in ("gnss", "gnss_velocity")})


def datum(log: Log) -> Log:
    """GNSS half a metre off the map throughout, as datums are."""
    assert log.gnss is not None
    return replace(log, gnss=replace(log.gnss, llh=log.gnss.llh + np.array([0.5 / 6.37e6, 0.0, 0.0])))


@pytest.mark.parametrize("spoilt", [lambda log: log, datum], ids=["agreeing", "a datum apart"])
def test_two_sensors_bring_a_far_state_back(drive: Drive, spoilt: Callable[[Log], Log]) -> None:
    """A hundred metres: also sensors that agree only roughly outvote the state, at once and without a gap."""
    log = spoilt(started_wrong(drive.log, 70.0))
    result = run(log)
    s, errors = seconds(log, result.states.t_ns), np.abs(fused_errors(result, drive))
    assert errors[s < 30.0, :2].max() > 50.0
    assert (errors[s > 33.0] < [1.0, 1.0, 1.0]).all()
    assert (np.diff(s) < 0.15).all()
    assert result.restarts == ()


def test_starts_in_the_middle_of_a_drive(drive: Drive) -> None:
    """GNSS alone, every ten seconds, turns and stops included: yaw and position within their sigmas."""
    ratios: list[Floats] = []
    for begin in range(10, 220, 10):
        log = gnss_alone(replace(drive.log, wheel=None))
        log = replace(log, **{n: without(getattr(log, n), log, -1.0, begin) for n in ("imu", "gnss", "gnss_velocity")})
        result = run(log)
        if result.aligned_ns is None:
            continue
        errors, sigma = fused_errors(result, drive)[0], result.states.sigma[0]
        ratios.append(np.array([errors[2] / np.degrees(sigma[8]), np.hypot(*errors[:2]) / np.hypot(*sigma[:2])]))
    rms = np.sqrt(np.mean(np.square(ratios), axis=0))
    print(f"{len(ratios)} starts: yaw {rms[0]:.2f}, position {rms[1]:.2f} sigmas rms")
    assert len(ratios) >= 19
    assert np.abs(ratios).max() < 4.0
    assert rms.max() < 1.5


def test_a_height_that_drifted_does_not_keep_gnss_out(drive: Drive) -> None:
    """GNSS returns 30 m above a state that pose fixes hold in the plane: nothing else sees the height."""
    log = drive.log
    assert log.gnss is not None
    s = seconds(log, log.gnss.t_ns)
    higher = log.gnss.llh + np.where(s[:, None] > 100.0, [0.0, 0.0, 30.0], 0.0)
    result = run(replace(log, gnss=replace(log.gnss, llh=higher)))
    rows = result.decisions.sensor == Sensor.GNSS_POSITION
    s, reason = seconds(log, result.decisions.t_ns[rows]), result.decisions.reason[rows]
    assert (reason[(s > 100.05) & (s < 101.9)] == Reason.CHI_SQUARE).all()
    assert (reason[s > 104.0] == Reason.ACCEPTED).mean() > 0.98
    s = seconds(log, result.states.t_ns)
    above = result.states.llh[:, 2] - drive.truth.at(result.states.t_ns).llh[:, 2]
    assert np.abs(above[s > 110.0] - 30.0).max() < 0.5
    assert np.abs(fused_errors(result, drive)[:, :2]).max() < 0.3
    assert result.restarts == ()
