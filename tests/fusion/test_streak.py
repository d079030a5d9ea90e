"""Rejections in a row: a steady alias does not capture the filter, an outage is made up for, one is no doom."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion.config import FusionConfig, Gates
from fusion.result import FusionResult, Reason, Sensor
from fusion.run import run
from fusion.state import D_HELD, D_LAST, D_STREAK, Core, new_core
from fusion.streak import ALIAS_M, PAUSE_NS, TRACKING_NS, goes_on, tally, threshold_of
from fusion.timeline import parameters
from sensors.records import GnssStatus, Log
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, simulate_drive
from sensors.vehicle import Vehicle
from tests.fusion.free import Floats
from tests.fusion.rough import LIMITS, fused_errors, off
from tests.fusion.scenes import seconds, with_outage, without

PLAIN_GATE = FusionConfig(gates=Gates(streak=10**9))
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


def test_a_steady_lane_alias_does_not_capture_the_filter(drive: Drive) -> None:
    """Two minutes without GNSS, with fixes one lane off from five seconds on: P grows until a plain gate gives in."""
    log = a_lane_off(without_gnss(drive.log, 60.0, 190.0), 65.0, 185.0)
    result = run(log)
    s = seconds(log, result.states.t_ns)
    alias = (s > 66.0) & (s < 185.0)
    assert (reasons(log, result, Sensor.POSE_FIX, 65.0, 185.0) == Reason.CHI_SQUARE).all()
    assert np.abs(fused_errors(result, drive)[alias, 1]).max() < 1.75
    # right fixes are believed at once, and the drive ends within the limits
    assert (reasons(log, result, Sensor.POSE_FIX, 185.5, 190.0) == Reason.ACCEPTED).all()
    assert (np.abs(fused_errors(result, drive)[s > 186.0]) < LIMITS).all()
    captured = np.abs(fused_errors(run(log, PLAIN_GATE), drive)[alias, :2]).max()
    assert captured > 3.3


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


def drifting(log: Log, claimed_m: float, begin_s: float) -> Log:
    """GNSS alone, 0.1 m/s off to 4.4 m, which no gate can see, while it claims this sigma; then right at once."""
    assert log.gnss is not None
    gnss, s = log.gnss, seconds(log, log.gnss.t_ns)
    for step in np.arange(44.0):
        inside = (s >= begin_s + step) & (s < begin_s + step + 1.0)
        gnss = off(gnss, inside, np.array([0.1 * step, 0.0, 0.0]), GnssStatus.FLOAT, claimed_m)
    return replace(log, gnss=gnss, pose_fixes=None)


@pytest.mark.parametrize("seed", [2, 5, 9])
def test_a_state_that_float_fixes_led_astray_is_taken_back_by_fixed_ones(seed: int) -> None:
    """The fixed ones are rejected at first, all of them; P explains them within a minute."""
    drive = simulate_drive(180.0, seed, scenarios.load("clean"))
    log = drifting(drive.log, 1.0, 60.0)
    result = run(log)
    s, errors = seconds(log, result.states.t_ns), np.abs(fused_errors(result, drive)[:, :2])
    assert (reasons(log, result, Sensor.GNSS_POSITION, 104.0, 106.0) == Reason.CHI_SQUARE).any()
    assert np.hypot(*errors[s > 60.0].T).max() < 0.7
    assert (errors[s > 165.0] < 0.1).all()


@pytest.mark.parametrize("seed", [2, 5, 9])
def test_one_wrong_rejection_is_no_doom(seed: int) -> None:
    """FusionCore turned 4.4 m into 358 m. GNSS with a bias of up to 4.4 m that it claims to know to 0.3 m has led
    state, biases and heading astray; the right fixes are rejected for minutes. Alone they outvote nothing, but the
    error keeps its size; with pose fixes they take the state back within three seconds."""
    drive = simulate_drive(240.0, seed, scenarios.load("clean"))
    alone = drifting(drive.log, 0.3, 60.0)
    result = run(alone)
    s = seconds(alone, result.states.t_ns)
    horizontal = np.hypot(*fused_errors(result, drive)[:, :2].T)
    print(f"{seed}: led {horizontal[s < 104.0].max():.2f} m astray, then {horizontal[s > 104.0].max():.2f} m at most")
    assert (reasons(alone, result, Sensor.GNSS_POSITION, 104.0, 110.0) == Reason.CHI_SQUARE).all()
    assert horizontal[s < 104.0].max() > 1.5
    assert horizontal[s > 104.0].max() < 8.0
    both = replace(alone, pose_fixes=without(drive.log.pose_fixes, drive.log, 60.0, 104.0))
    result = run(both)
    s, errors = seconds(both, result.states.t_ns), fused_errors(result, drive)
    assert np.abs(errors[s < 104.0, :2]).max() > 1.0
    assert (np.abs(errors[s > 107.0]) < LIMITS).all()


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
    tally(core, par, 0, False, now)  # of GNSS nothing is counted
    assert core.doubt_clock[1, D_STREAK] == 11
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
