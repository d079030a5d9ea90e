"""A new start in arrival order: where nothing is late that of stamp order, however it is fed; late fixes around it."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.config import FusionConfig, HealthModel
from fusion.filter import Localizer
from fusion.result import Cause, FusionResult, Reason, Sensor
from fusion.rewinding import RewindingNavigator
from fusion.run import joined, run
from sensors.records import Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate
from tests.fusion.arrivals import (
    LATE,
    MEASURED,
    arriving,
    assert_same_state,
    at_once,
    core_after,
    in_stamp_order,
    records_by_arrival,
    scattered,
)
from tests.fusion.scenes import later, only, seconds, with_outage, without, without_yaw
from tests.fusion.test_live import assert_equal_replay
from tests.fusion.test_session import assert_same, cuts_of, in_pieces, pieces

CONFIG = msgspec.structs.replace(LATE, health=HealthModel(blown_sigma_m=0.12))
"""A state that is not known to twelve centimetres counts as diverged: the fix that shows it begins a new alignment."""
SECOND = 10**9
FIXES = ("gnss", "gnss_velocity", "pose_fixes")
OUTAGES = (32.0, 56.0)
"""Ends, s."""


@pytest.fixture(scope="module")
def log() -> Log:
    """Seventy seconds, twice without positions for so long that the filter starts again after it."""
    drive = later(simulate(110.0, 2, scenarios.load("demo")), 40.0)
    drive = only(drive, *FIXES)
    for end_s in OUTAGES:
        drive = with_outage(drive, end_s - 14.0, 14.0)
    return drive


def jumped(log: Log) -> Log:
    """GNSS alone, which is 300 m off from one second to the next, and stays there."""
    drive = without_yaw(replace(later(log, 40.0), pose_fixes=None, wheel=None))
    assert drive.gnss is not None
    away = np.where(seconds(drive, drive.gnss.t_ns) > 30.0, 300.0 / 6.37e6, 0.0)
    return replace(drive, gnss=replace(drive.gnss, llh=drive.gnss.llh + away[:, None] * [1.0, 0.0, 0.0]))


def decided_once(log: Log, result: FusionResult) -> bool:
    made = result.decisions
    measured = made.sensor < Sensor.ZERO_VELOCITY
    rows = np.column_stack((made.sensor, made.row))[measured]
    count = sum(len(record) for name in MEASURED if (record := getattr(log, name)) is not None)
    ticks = made.t_ns[~measured]
    return len(np.unique(rows, axis=0)) == len(rows) == count and len(np.unique(ticks)) == len(ticks)


def test_where_nothing_is_late_a_new_start_is_that_of_stamp_order(log: Log) -> None:
    drive = at_once(log)
    result = run(drive, CONFIG)
    assert_same(result, run(drive, in_stamp_order(CONFIG)))
    assert [restart.cause for restart in result.restarts] == [Cause.COVARIANCE] * 2
    found = seconds(log, np.array([restart.t_ns for restart in result.restarts]))
    assert found == pytest.approx(OUTAGES, abs=0.2)
    assert (result.decisions.reason == Reason.USED_FOR_ALIGNMENT).sum() == 3


def test_a_state_that_gnss_contradicts_starts_again_as_in_stamp_order() -> None:
    health = HealthModel(lost_s=1.0, alone_s=1.5)
    drive, config = (
        at_once(jumped(simulate(110.0, 2, scenarios.load("demo")))),
        msgspec.structs.replace(LATE, health=health),
    )
    result = run(drive, config)
    assert_same(result, run(drive, in_stamp_order(config)))
    assert [restart.cause for restart in result.restarts] == [Cause.REJECTED]
    assert_equal_replay(drive, config)


@pytest.mark.parametrize("late", [False, True], ids=["in time", "late"])
def test_any_cutting_gives_the_same_bits(log: Log, late: bool) -> None:
    drive = scattered(log, 5) if late else at_once(log)
    whole = run(drive, CONFIG)
    assert len(whole.restarts) == 2
    for seed in range(6):
        cuts = cuts_of(drive, seed)
        assert_same(whole, joined(in_pieces(drive, pieces(drive, cuts), CONFIG)))
    near = [restart.t_ns + k * 10_000_000 for restart in whole.restarts for k in range(-3, 140)]
    assert_same(whole, joined(in_pieces(drive, pieces(drive, np.array(near)), CONFIG)))


def test_live_equals_the_replay(log: Log) -> None:
    """Row by row; also where each fix is as late as a network makes it."""
    for drive in (at_once(log), arriving(log, lambda t: np.full(len(t), 120_000_000), FIXES)):
        assert len(run(drive, CONFIG).restarts) == 2
        assert_equal_replay(drive, CONFIG)


def test_live_tells_of_it(log: Log) -> None:
    """While there is no state none is given; what the Localizer holds does not grow without positions."""
    end_s = OUTAGES[0] + 0.2
    drive = at_once(replace(log, **{name: without(getattr(log, name), log, end_s, 1e9) for name in FIXES}))
    localizer = Localizer(drive.vehicle, drive.map_frame, CONFIG)
    for record in records_by_arrival(drive):
        localizer.push(record)
    assert localizer.state() is None
    assert localizer.t_ns is None
    (restart,) = localizer.take_restarts()
    assert seconds(log, np.array(restart.t_ns)) == pytest.approx(OUTAGES[0], abs=0.2)
    assert localizer.take_restarts() == ()
    navigator = localizer._navigator
    assert isinstance(navigator, RewindingNavigator)
    waiting = sum(len(imu) for imu in navigator._imu)
    assert 100 < waiting < 300  # two seconds of more than thirty


def test_late_fixes_start_it_again_where_they_were_true(log: Log) -> None:
    """The fix that shows the divergence arrives after states behind it: these stay, none comes twice."""
    delay = 300_000_000
    drive = arriving(log, lambda t: np.full(len(t), delay), FIXES)
    result, in_time = run(drive, CONFIG), run(at_once(log), CONFIG)
    assert result.restarts == in_time.restarts
    assert (np.diff(result.states.t_ns) > 0).all()
    assert decided_once(drive, result)
    for restart in result.restarts:
        behind = (result.states.t_ns > restart.t_ns) & (result.states.t_ns < restart.t_ns + delay)
        assert behind.sum() >= 2  # as they were known
        quiet = (result.states.t_ns > restart.t_ns + delay) & (result.states.t_ns < restart.t_ns + 2 * delay)
        assert not quiet.any()
    end = result.states.t_ns[-1]
    assert in_time.states.t_ns[-1] == end
    assert_same_state(core_after(drive, CONFIG), core_after(at_once(log), CONFIG))


def test_fixes_that_are_later_than_a_new_start_takes(log: Log) -> None:
    """Three seconds late: the new state begins before states and ticks that the old one has given."""
    config = msgspec.structs.replace(CONFIG, history_s=5.0)
    drive = arriving(log, lambda t: np.full(len(t), 3 * SECOND), FIXES)
    result = run(drive, config)
    assert len(result.restarts) == 2
    assert decided_once(drive, result)
    assert (np.diff(result.states.t_ns) > 0).all()
    assert_same_state(core_after(drive, config), core_after(at_once(log), config))


@pytest.mark.parametrize("seed", range(3))
def test_what_was_applied_before_is_decided_once(log: Log, seed: int) -> None:
    """Latencies drawn for each row: a rewind finds the filter hopeless at a fix before rows that were applied."""
    drive = scattered(log, seed)
    result = run(drive, CONFIG)
    assert len(result.restarts) == 2
    assert decided_once(drive, result)
    assert (np.diff(result.states.t_ns) > 0).all()
    assert_equal_replay(drive, CONFIG, rows=False)


def test_a_fix_from_before_the_new_start_changes_nothing(log: Log) -> None:
    """It arrives after the new first state, less than the history late."""
    assert log.gnss_velocity is not None
    config = msgspec.structs.replace(CONFIG, history_s=4.0)
    base = at_once(replace(log, gnss_velocity=None))
    (first, _), velocity = run(base, config).restarts, log.gnss_velocity
    again = run(base, config).states.t_ns
    begun = int(again[np.searchsorted(again, first.t_ns, side="right")])
    assert begun - first.t_ns < 2 * SECOND
    rows = np.flatnonzero((velocity.t_ns > first.t_ns) & (velocity.t_ns < begun - 10**8))
    late = replace(velocity[rows], arrival_ns=np.full(len(rows), begun + SECOND))
    result = run(replace(base, gnss_velocity=late), config)
    mine = result.decisions.sensor == Sensor.GNSS_VELOCITY
    assert mine.sum() == len(rows) >= 5
    assert (result.decisions.reason[mine] == Reason.BEFORE_ALIGNMENT).all()
    assert_unmoved(result, run(base, config))


def assert_unmoved(one: FusionResult, other: FusionResult) -> None:
    """The same states, but for what they say of a sensor that one of them does not have."""
    for name in ("t_ns", "llh", "vel_enu", "q_enu_body", "sigma"):
        left: NDArray[np.float64] = getattr(one.states, name)
        assert left.tobytes() == getattr(other.states, name).tobytes(), name


def test_without_restart_it_goes_on(log: Log) -> None:
    config: FusionConfig = msgspec.structs.replace(CONFIG, health=HealthModel(blown_sigma_m=0.12, restart=False))
    drive = at_once(log)
    result = run(drive, config)
    assert result.restarts == ()
    assert_same(result, run(drive, in_stamp_order(config)))
