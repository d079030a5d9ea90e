"""Rejections in a row: a steady alias does not capture the filter, an outage is made up for, one is no doom."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion.config import FusionConfig, Gates, HealthModel
from fusion.result import FusionResult, Reason, Sensor
from fusion.run import run
from fusion.state import D_HELD, D_LAST, D_STREAK, Core, new_core
from fusion.streak import ALIAS_M, INSISTING_NS, PAUSE_NS, TRACKING_NS, goes_on, may_renew, tally, threshold_of
from fusion.timeline import parameters
from sensors.records import GnssStatus, Log
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, simulate_drive
from sensors.vehicle import Vehicle
from tests.fusion.free import Floats
from tests.fusion.rough import LIMITS, fused_errors, off
from tests.fusion.scenes import seconds, with_outage, without

NO_STREAK = Gates(streak=10**9)
"""Whatever P explains passes, however the streak began."""
ALL = ("gnss", "gnss_velocity", "pose_fixes")


@pytest.fixture(scope="module")
def drive() -> Drive:
    return simulate_drive(300.0, 2, scenarios.load("clean"))


def without_gnss(log: Log, begin_s: float, end_s: float) -> Log:
    """The log without GNSS for a while."""
    gone = {name: without(getattr(log, name), log, begin_s, end_s) for name in ("gnss", "gnss_velocity")}
    return replace(log, **gone)  # type: ignore[arg-type]


def a_lane_off(log: Log, begin_s: float, end_s: float) -> Log:
    """Pose fixes one lane to the left for a while."""
    fixes = log.pose_fixes
    assert fixes is not None
    s, yaw = seconds(log, fixes.t_ns), fixes.pose[:, 2]
    left = np.stack((-np.sin(yaw), np.cos(yaw), 0.0 * yaw), axis=-1)
    inside = (s >= begin_s) & (s < end_s)
    return replace(log, pose_fixes=replace(fixes, pose=fixes.pose + np.where(inside[:, None], 3.5 * left, 0.0)))


def reasons(log: Log, result: FusionResult, sensor: Sensor, begin_s: float, end_s: float) -> Floats:
    """What became of a sensor's measurements over a while."""
    s = seconds(log, result.decisions.t_ns)
    found: Floats = result.decisions.reason[(result.decisions.sensor == sensor) & (s >= begin_s) & (s < end_s)]
    return found


def with_gross_frames(log: Log, begin_s: float, end_s: float) -> Log:
    """Bursts of three pose fixes twenty metres off, every four seconds."""
    fixes = log.pose_fixes
    assert fixes is not None
    s = seconds(log, fixes.t_ns)
    inside = (s >= begin_s) & (s < end_s) & (s % 4.0 < 0.3)
    return replace(log, pose_fixes=replace(fixes, pose=fixes.pose + np.where(inside[:, None], [20.0, 0.0, 0.0], 0.0)))


def with_a_frame_far_off(log: Log, begin_s: float, end_s: float) -> Log:
    """One pose fix sixty metres off."""
    fixes = log.pose_fixes
    assert fixes is not None
    far = np.zeros_like(fixes.pose)
    far[np.searchsorted(seconds(log, fixes.t_ns), 0.3 * begin_s + 0.7 * end_s), 0] = 60.0
    return replace(log, pose_fixes=replace(fixes, pose=fixes.pose + far))


def as_it_is(log: Log, begin_s: float, end_s: float) -> Log:
    return log


@pytest.mark.parametrize("rough", [as_it_is, with_gross_frames, with_a_frame_far_off])
def test_a_steady_lane_alias_does_not_capture_the_filter(drive: Drive, rough) -> None:  # type: ignore[no-untyped-def]
    """Two minutes without GNSS, with fixes one lane off from five seconds on: P grows until a plain gate gives in.

    Among gross frames the filter does not start again: after a minute one of them would do, and the next is the alias.
    """
    log = rough(a_lane_off(without_gnss(drive.log, 60.0, 190.0), 65.0, 185.0), 70.0, 184.0)
    result = run(log)
    assert result.restarts == ()
    s = seconds(log, result.states.t_ns)
    alias = (s > 66.0) & (s < 185.0)
    assert (reasons(log, result, Sensor.POSE_FIX, 65.0, 185.0) == Reason.CHI_SQUARE).all()
    assert np.abs(fused_errors(result, drive)[alias, 1]).max() < 1.75
    # right fixes are believed at once, and the drive ends within the limits
    assert (reasons(log, result, Sensor.POSE_FIX, 185.5, 190.0) == Reason.ACCEPTED).all()
    assert (np.abs(fused_errors(result, drive)[s > 186.0]) < LIMITS).all()
    open_to_all = FusionConfig(gates=NO_STREAK, health=HealthModel(restart=False))
    assert np.abs(fused_errors(run(log, open_to_all), drive)[alias, :2]).max() > 3.3


def test_an_alias_beside_gnss_does_no_harm_for_as_long_as_it_lasts(drive: Drive) -> None:
    log = a_lane_off(drive.log, 60.0, 240.0)
    result = run(log)
    assert (reasons(log, result, Sensor.POSE_FIX, 60.0, 240.0) == Reason.CHI_SQUARE).all()
    assert (np.abs(fused_errors(result, drive)) < LIMITS).all()
    assert (reasons(log, result, Sensor.POSE_FIX, 240.0, 300.0) == Reason.ACCEPTED).mean() > 0.99


@pytest.mark.parametrize("alone", ["gnss", "pose_fixes"])
@pytest.mark.parametrize("seed", [2, 5, 9])
def test_after_an_outage_the_covariance_explains_the_jump(seed: int, alone: str) -> None:
    """A minute without any position; then one sensor alone takes the state back within a second."""
    drive = simulate_drive(150.0, seed, scenarios.load("clean"))
    log = with_outage(drive.log, 60.0, 60.0)
    others = [name for name in ALL if not name.startswith(alone)]
    log = replace(log, **{name: without(getattr(log, name), log, 60.0, 200.0) for name in others})  # type: ignore[arg-type]
    result = run(log)
    s = seconds(log, result.states.t_ns)
    errors = fused_errors(result, drive)
    sensor = Sensor.GNSS_POSITION if alone == "gnss" else Sensor.POSE_FIX
    print(f"{seed}, {alone}: {np.abs(errors[(s > 119.0) & (s < 120.0)]).max(axis=0).round(2)} at the end of the outage")
    assert (reasons(log, result, sensor, 120.0, 150.0) == Reason.ACCEPTED).mean() > 0.99
    assert (np.abs(errors[s > 121.0, :2]) < LIMITS[:2]).all()


def test_a_streak_that_begins_after_an_outage_ends_when_the_covariance_explains_it(drive: Drive) -> None:
    """The wheel has led the state astray meanwhile by more than P knows: right fixes are rejected, until it does."""
    log = with_outage(drive.log, 60.0, 30.0)
    log = replace(without_gnss(log, 60.0, 300.0), pose_fixes=log.pose_fixes)
    assert log.wheel is not None
    s = seconds(log, log.wheel.t_ns)
    log = replace(log, wheel=replace(log.wheel, speed=log.wheel.speed + 0.06 * ((s > 60.0) & (s < 90.0))))
    result = run(log)
    assert (reasons(log, result, Sensor.POSE_FIX, 90.0, 91.0) == Reason.CHI_SQUARE).all()
    back = seconds(log, result.states.t_ns)
    errors = fused_errors(result, drive)
    assert np.abs(errors[(back > 89.0) & (back < 90.0), 0]).max() > 1.0
    assert (np.abs(errors[back > 200.0]) < LIMITS).all()


def drifting(log: Log, claimed_m: float, status: GnssStatus = GnssStatus.FLOAT) -> Log:
    """GNSS alone, from 60 s on 0.1 m/s off to 4.3 m, of which it claims this sigma; then right at once."""
    assert log.gnss is not None
    gnss, s = log.gnss, seconds(log, log.gnss.t_ns)
    for step in np.arange(44.0):
        inside = (s >= 60.0 + step) & (s < 61.0 + step)
        gnss = off(gnss, inside, np.array([0.1 * step, 0.0, 0.0]), status, claimed_m)
    return replace(log, gnss=gnss, pose_fixes=None)


def led(drive: Drive, log: Log) -> tuple[float, float, float]:
    """How far the state was off before GNSS was right again and after, m, and when it was within the limits for good,
    s after that."""
    result = run(log)
    s, errors = seconds(log, result.states.t_ns), np.abs(fused_errors(result, drive))
    far = np.hypot(errors[:, 0], errors[:, 1])
    wrong = s[(errors > LIMITS).any(axis=1)]
    back = max(float(wrong[-1]) - 104.0, 0.0) if len(wrong) else 0.0
    found = float(far[s < 104.0].max()), float(far[s > 104.0].max()), back
    print(f"led {found[0]:.2f} m astray, {found[1]:.2f} m at most afterwards, back after {found[2]:.1f} s")
    return found


@pytest.mark.parametrize(("claimed_m", "most_m"), [(1.0, 0.25), (0.3, 0.4)])
@pytest.mark.parametrize("seed", [2, 5, 9])
def test_a_drift_of_a_few_sigmas_is_known_for_one(seed: int, claimed_m: float, most_m: float) -> None:
    """4.3 m, fourteen times the sigma that GNSS claims: an error that lasts explains it, velocity and wheel hold the
    place. What comes after it is believed within two seconds."""
    drive = simulate_drive(180.0, seed, scenarios.load("clean"))
    log = drifting(drive.log, claimed_m)
    before, after, _ = led(drive, log)
    assert before < most_m
    assert after < most_m
    assert (reasons(log, run(log), Sensor.GNSS_POSITION, 106.0, 180.0) == Reason.ACCEPTED).all()


@pytest.mark.parametrize(("claimed_m", "status"), [(0.1, GnssStatus.FLOAT), (0.02, GnssStatus.FIXED)])
@pytest.mark.parametrize("seed", [2, 5, 9])
def test_one_wrong_rejection_is_no_doom(seed: int, claimed_m: float, status: GnssStatus) -> None:
    """FusionCore turned 4.4 m into 358 m. A drift of fifty and of two hundred sigmas leads the state astray, with its
    biases and its heading; the right fixes after it are rejected for seconds. They take the state back, GNSS alone
    within half a minute (once by a new start), pose fixes beside it within two seconds."""
    drive = simulate_drive(240.0, seed, scenarios.load("clean"))
    alone = drifting(drive.log, claimed_m, status)
    before, after, back = led(drive, alone)
    assert before > 1.0
    assert (reasons(alone, run(alone), Sensor.GNSS_POSITION, 104.0, 105.0) == Reason.CHI_SQUARE).all()
    assert after < (2.0 if status == GnssStatus.FLOAT else 50.0)
    assert back < 30.0
    both = replace(alone, pose_fixes=without(drive.log.pose_fixes, drive.log, 60.0, 104.0))
    before, after, back = led(drive, both)
    assert before > 1.0
    assert after < before + 2.0
    assert back < 2.0


NS = 100_000_000


def core_at(east: float, now: int = 0) -> Core:
    """A core that judges a position so far east."""
    core = new_core()
    core.doubt_clock[:, D_HELD] = now
    core.fresh[:] = [east, 0.0, 0.01, 0.0, 0.01]
    return core


def test_a_streak_is_counted_and_ended() -> None:
    par, core = parameters(Vehicle(), FusionConfig()), core_at(3.5)
    for k in range(1, 12):
        assert threshold_of(core, par, 3, k * NS) == (par.reentry[2] if k > 10 else par.gate[2])
        tally(core, par, 1, False, k * NS)
        assert core.doubt_clock[1, D_STREAK] == k
    now = 12 * NS
    assert threshold_of(core, par, 3, now + PAUSE_NS) == par.gate[2]
    core.fresh[0] = 3.5 - 1.01 * ALIAS_M  # eleven sigmas from the streak, and another place on the road
    assert not goes_on(core, now)
    assert threshold_of(core, par, 3, now) == par.gate[2]
    core.fresh[0] = 3.0  # four sigmas: noise has such tails
    assert threshold_of(core, par, 2, now) == par.reentry[1]
    tally(core, par, 0, False, now)  # GNSS has a count of its own
    assert core.doubt_clock[:, D_STREAK].tolist() == [1, 11]
    tally(core, par, 1, True, now)
    assert (core.doubt_clock[1, D_STREAK], core.doubt_clock[1, D_HELD]) == (0, now)


def test_a_streak_outlasts_a_gross_frame_and_not_another_story() -> None:
    par, core = parameters(Vehicle(), FusionConfig()), core_at(3.5)
    for k in range(100):
        tally(core, par, 1, False, k * NS)
    assert core.doubt_clock[1, D_STREAK] == 2 * par.streak
    for k in range(100, 105):  # half a second somewhere else
        core.fresh[0] = -9.0
        assert threshold_of(core, par, 3, k * NS) == par.gate[2]
        tally(core, par, 1, False, k * NS)
    core.fresh[0] = 3.5
    assert threshold_of(core, par, 3, 105 * NS) == par.reentry[2]
    core.fresh[0] = -9.0
    for k in range(105, 120):  # and for good
        tally(core, par, 1, False, k * NS)
    assert core.doubt_clock[1, D_STREAK] == par.streak + 1
    assert threshold_of(core, par, 3, 120 * NS) == par.reentry[2]  # nothing has held the state since it was tracking
    core.fresh[0] = 3.5
    assert threshold_of(core, par, 3, 120 * NS) == par.gate[2]


def test_gnss_that_insists_may_have_a_new_error_that_lasts() -> None:
    par, core = parameters(Vehicle(), FusionConfig()), core_at(0.0)
    for k in range(2):
        assert not may_renew(core, 0, k * NS)
        tally(core, par, 0, False, k * NS)
    assert may_renew(core, 0, 2 * NS)
    tally(core, par, 0, True, 2 * NS)
    assert not may_renew(core, 0, 3 * NS)
    assert may_renew(core, 1, 3 * NS)


def test_insisting_is_a_matter_of_time() -> None:
    """The second position of 1 Hz may, the fifth copy of one message may not."""
    par, core = parameters(Vehicle(), FusionConfig()), core_at(0.0)
    for _ in range(5):
        assert not may_renew(core, 0, NS)
        tally(core, par, 0, False, NS)
    assert not may_renew(core, 0, NS + INSISTING_NS - 1)
    assert may_renew(core, 0, 11 * NS)


@pytest.mark.parametrize(("period_ns", "lost"), [(NS, 2), (10 * NS, 1)])
def test_what_comes_after_a_jump_within_the_budget_is_believed_soon(drive: Drive, period_ns: int, lost: int) -> None:
    """GNSS alone, a sigma of 0.2 m: 1 m east from 90 s on. A reflection of one epoch is never believed."""
    gnss = drive.log.gnss
    assert gnss is not None
    log = replace(drive.log, gnss=gnss[(gnss.t_ns - gnss.t_ns[0]) % period_ns < NS // 2], pose_fixes=None)
    assert log.gnss is not None
    s = seconds(log, log.gnss.t_ns)
    one = int(np.searchsorted(s, 80.0))
    gnss = off(log.gnss, np.ones(len(s), bool), np.zeros(3), GnssStatus.SINGLE, 0.2)
    shifted = (s >= 90.0) | (np.arange(len(s)) == one)
    log = replace(log, gnss=off(gnss, shifted, np.array([1.0, 0.0, 0.0]), GnssStatus.SINGLE, 0.2))
    result = run(log)
    period_s = 1e-9 * period_ns
    alone = reasons(log, result, Sensor.GNSS_POSITION, s[one] - 0.01, s[one] + 0.9 * period_s)
    assert alone.tolist() == [Reason.CHI_SQUARE]
    after = reasons(log, result, Sensor.GNSS_POSITION, 89.99, 110.0)
    assert (after[:lost] == Reason.CHI_SQUARE).all()
    assert (after[lost:] == Reason.ACCEPTED).all()


@pytest.mark.parametrize(("east", "late"), [(3.5, TRACKING_NS + NS), (0.9 * ALIAS_M, 0)])
def test_what_is_no_alias_is_no_streak(east: float, late: int) -> None:
    """It began without a position to hold on to, or is too near for one."""
    par, core = parameters(Vehicle(), FusionConfig()), core_at(east)
    for k in range(30):
        tally(core, par, 1, False, late + k * NS)
    assert core.doubt_clock[1, D_LAST] == late + 29 * NS
    assert threshold_of(core, par, 3, late + 30 * NS) == par.gate[2]


def test_gates_switched_off_have_no_streaks() -> None:
    par = parameters(Vehicle(), FusionConfig(gates=Gates(use=False)))
    assert par.reentry == par.gate == (np.inf, np.inf, np.inf)
    tight = parameters(Vehicle(), msgspec.structs.replace(FusionConfig(), gates=Gates(probability=0.5, reentry=0.9)))
    assert tight.reentry == tight.gate
