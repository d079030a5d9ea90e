"""Arrival order: the state that stamp order gives for all that has come, recorded as it was known at its time."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion.config import FusionConfig
from fusion.result import FusionResult, Reason, Sensor
from fusion.run import joined, run
from sensors.errors import EgolocError
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
    scattered,
)
from tests.fusion.scenes import later, with_gap, without
from tests.fusion.test_session import SCENES, assert_same, cuts_of, in_pieces, pieces

SECOND = 10**9


@pytest.fixture(scope="module")
def log() -> Log:
    """A minute with float, lost and blind stretches; fixes come 50 ms late, pose fixes 120 ms, wheel speeds 10 ms."""
    return later(simulate(100.0, 2, scenarios.load("demo")), 40.0)


def decided(result: FusionResult, reason: Reason) -> int:
    return int((result.decisions.reason == reason).sum())


@pytest.mark.parametrize("scene", SCENES)
def test_what_arrives_when_it_is_true_gives_the_states_of_stamp_order(log: Log, scene: str) -> None:
    """And the decisions, to the last bit."""
    drive = at_once(SCENES[scene](log))
    assert_same(run(drive, LATE), run(drive, in_stamp_order(LATE)))


@pytest.mark.parametrize("seed", range(4))
def test_the_state_after_all_has_arrived_is_that_of_stamp_order(log: Log, seed: int) -> None:
    drive = scattered(log, seed)
    assert drive.pose_fixes is not None
    assert (np.diff(drive.pose_fixes.arrival_ns) < 0).mean() > 0.3  # out of order within the sensor
    assert_same_state(core_after(drive, LATE), core_after(drive, in_stamp_order(LATE)))
    assert decided(run(drive, LATE), Reason.LATE) == 0


def test_gaps_in_the_imu_and_late_fixes(log: Log) -> None:
    """A bridged and a coasted gap; measurements inside come after the IMU has returned, within the history."""
    for length_s in (0.8, 2.0, 5.0):
        drive = scattered(with_gap(log, 20.0, length_s), 7, 0.3)
        assert_same_state(
            core_after(drive, msgspec.structs.replace(LATE, history_s=10.0)), core_after(drive, FusionConfig())
        )


def test_equal_stamps(log: Log) -> None:
    """Positions, velocities and wheel speeds of one stamp, that of an IMU sample, in several orders of arrival."""
    assert log.imu is not None
    assert log.gnss is not None
    assert log.wheel is not None
    assert np.isin(log.gnss.t_ns, log.imu.t_ns).all()
    assert np.isin(log.gnss.t_ns, log.wheel.t_ns).all()
    begin, end = log.imu.t_ns[0] + 3 * SECOND, log.imu.t_ns[-1] - SECOND
    for late_ns in (1, 10_000_000, 100_000_000):
        for names in (("gnss",), ("wheel",), ("gnss", "wheel"), ("gnss_velocity",)):
            drive = arriving(log, lambda t, late=late_ns: np.where((t < begin) | (t > end), 0, late), names)  # type: ignore[misc]
            assert_same_state(core_after(drive, LATE), core_after(drive, FusionConfig()))


def test_states_are_as_they_were_known(log: Log) -> None:
    """Each recorded state is that of stamp order over just those rows that had come when the IMU reached its time."""
    drive = scattered(log, 11)
    whole = run(drive, LATE).states
    assert drive.imu is not None
    differing = 0
    for k in np.random.default_rng(0).choice(np.arange(50, len(whole)), 12, replace=False):
        t = whole.t_ns[k]
        reached = drive.imu.t_ns[np.searchsorted(drive.imu.t_ns, t)]
        came = {name: getattr(drive, name)[getattr(drive, name).arrival_ns <= reached] for name in MEASURED}
        known = run(replace(drive, **came), FusionConfig()).states
        i = int(np.searchsorted(known.t_ns, t))
        for name in ("llh", "vel_enu", "q_enu_body", "gyro_bias", "accel_bias", "pose_cov", "sigma"):
            assert np.array_equal(getattr(whole, name)[k], getattr(known, name)[i]), name
        everything = run(drive, FusionConfig()).states
        differing += int((everything.llh[np.searchsorted(everything.t_ns, t)] != whole.llh[k]).any())
    assert differing == 12  # what came later is not in them


@pytest.mark.parametrize("scene", SCENES)
def test_any_cutting_gives_the_same_bits(log: Log, scene: str) -> None:
    config = msgspec.structs.replace(LATE, output_hz=20.0)
    drive = SCENES[scene](log)
    whole = run(drive, config)
    for seed in range(5):
        assert_same(whole, joined(in_pieces(drive, pieces(drive, cuts_of(drive, seed)), config)))


def test_any_cutting_of_scattered_arrivals_gives_the_same_bits(log: Log) -> None:
    for seed in range(3):
        drive = scattered(log, seed, 1.5)
        whole = run(drive, LATE)
        assert decided(whole, Reason.LATE) > 100
        for cut in range(3):
            assert_same(whole, joined(in_pieces(drive, pieces(drive, cuts_of(drive, 10 * seed + cut)), LATE)))


def test_every_measurement_is_decided_once(log: Log) -> None:
    decisions = run(scattered(log, 5, 1.5), LATE).decisions
    for sensor, name in ((Sensor.GNSS_POSITION, "gnss"), (Sensor.POSE_FIX, "pose_fixes"), (Sensor.WHEEL, "wheel")):
        here = decisions.sensor == sensor
        assert np.array_equal(np.sort(decisions.row[here]), np.arange(len(getattr(log, name))))
        assert np.array_equal(decisions.t_ns[here], getattr(log, name).t_ns[decisions.row[here]])
    ticks = decisions.t_ns[decisions.sensor >= Sensor.ZERO_VELOCITY]
    assert (np.diff(ticks) > 0).all()


def test_older_than_the_history_is_late_and_changes_nothing(log: Log) -> None:
    assert log.pose_fixes is not None
    assert log.imu is not None
    on_time = at_once(log)
    assert on_time.pose_fixes is not None
    for late_s, applied in ((0.99, True), (1.02, False)):
        arrival = on_time.pose_fixes.t_ns.copy()
        arrival[300] += round(late_s * 1e9)
        result = run(replace(on_time, pose_fixes=replace(on_time.pose_fixes, arrival_ns=arrival)), LATE)
        mine = (result.decisions.sensor == Sensor.POSE_FIX) & (result.decisions.row == 300)
        assert (result.decisions.reason[mine].tolist() == [Reason.LATE]) != applied
        assert decided(result, Reason.LATE) == int(not applied)
        rest = np.arange(len(arrival)) != 300
        without_it = run(replace(on_time, pose_fixes=on_time.pose_fixes[rest]), LATE)
        assert (result.states.llh.tobytes() == without_it.states.llh.tobytes()) != applied


def test_a_short_history_drops_what_needs_more(log: Log) -> None:
    """Pose fixes 120 ms late, history 80 ms: each is late, the others are applied as without them."""
    result = run(log, msgspec.structs.replace(LATE, history_s=0.08))
    decisions = result.decisions
    assert result.aligned_ns is not None
    assert log.imu is not None
    after = (decisions.t_ns > result.aligned_ns) & (decisions.t_ns < log.imu.t_ns[-1] - 200_000_000)
    assert (decisions.reason[after & (decisions.sensor == Sensor.POSE_FIX)] == Reason.LATE).all()
    assert not (decisions.reason[after & (decisions.sensor == Sensor.GNSS_POSITION)] == Reason.LATE).any()


def test_a_burst_after_silence(log: Log) -> None:
    """Nothing comes for 0.8 s, then all of it at one instant: applied in stamp order, and nothing is lost."""
    assert log.imu is not None
    begin, end = log.imu.t_ns[0] + 20 * SECOND, log.imu.t_ns[0] + 20 * SECOND + 800_000_000
    drive = arriving(log, lambda t: np.where((t > begin) & (t <= end), end + 5_000_000 - t, 0))
    result, prompt = run(drive, LATE), run(at_once(log), LATE)
    assert decided(result, Reason.LATE) == 0
    assert_same_state(core_after(drive, LATE), core_after(at_once(log), LATE))
    burst = result.decisions.arrival_ns == end + 5_000_000
    assert burst.sum() > 60
    assert (np.diff(result.decisions.t_ns[burst]) >= 0).all()
    s = (result.states.t_ns - begin) * 1e-9
    same = (result.states.llh == prompt.states.llh).all(axis=1)
    assert same[(s < 0) | (s > 0.81)].all()
    assert not same[(s > 0.05) & (s < 0.79)].any()


def test_what_comes_before_the_imu_waits_for_it(log: Log) -> None:
    """IMU samples that arrive 30 ms late: measurements are there before the samples that reach them."""
    drive = arriving(log, lambda t: np.full(len(t), 30_000_000), ("imu",))
    assert_same(run(drive, LATE), run(at_once(log), LATE))


def test_what_arrives_after_the_last_imu_sample_is_applied(log: Log) -> None:
    assert log.imu is not None
    aligned = log.imu.t_ns[0] + SECOND
    drive = arriving(log, lambda t: np.where(t < aligned, 0, 120_000_000), ("pose_fixes",))
    assert_same_state(core_after(drive, LATE), core_after(at_once(log), LATE))
    decisions = run(drive, LATE).decisions
    assert (decisions.reason[decisions.sensor == Sensor.POSE_FIX] != Reason.OUTSIDE_IMU).all()


def test_clocks_that_differ(log: Log) -> None:
    """A recorder whose clock is 37 s ahead of the stamps, or behind them, tells the same delays."""
    assert log.imu is not None
    base = arriving(log, lambda t: np.full(len(t), 50_000_000), MEASURED)
    whole = run(base, LATE)
    for ahead_ns in (37 * SECOND, -37 * SECOND, -3 * SECOND):
        moved = {name: getattr(base, name) for name in (*MEASURED, "imu")}
        moved = {name: replace(record, arrival_ns=record.arrival_ns + ahead_ns) for name, record in moved.items()}
        other = run(replace(base, **moved), LATE)
        assert other.states.llh.tobytes() == whole.states.llh.tobytes()
        assert np.array_equal(other.decisions.reason, whole.decisions.reason)


def test_late_fixes_while_aligning(log: Log) -> None:
    """Fixes are 0.3 s late: the first state comes when the fix does, and is that of the fix's time."""
    drive = arriving(log, lambda t: np.full(len(t), 300_000_000), ("gnss", "gnss_velocity", "pose_fixes"))
    result = run(drive, LATE)
    assert result.aligned_ns is not None
    used = np.flatnonzero(result.decisions.reason == Reason.USED_FOR_ALIGNMENT)
    assert len(used) == 1
    known = result.decisions.arrival_ns[used[0]]
    assert known == result.aligned_ns + 300_000_000
    assert 0 < result.states.t_ns[0] - known <= 100_000_000  # not before it was known
    early = result.decisions.t_ns < result.aligned_ns
    assert (result.decisions.reason[early] == Reason.BEFORE_ALIGNMENT).all()
    wheel = (result.decisions.sensor == Sensor.WHEEL) & (result.decisions.t_ns > result.aligned_ns)
    applied = wheel & (result.decisions.t_ns < known)
    assert applied.sum() > 10  # came before the first state, of which they are younger
    assert np.isin(result.decisions.reason[applied], (Reason.ACCEPTED, Reason.CHI_SQUARE)).all()


def test_a_restart_of_the_recording_with_late_fixes(log: Log) -> None:
    """The log begins in the middle of a drive: fixes from before its IMU come first."""
    assert log.imu is not None
    drive = replace(log, imu=without(log.imu, log, -1e9, 10.0))
    result = run(drive, LATE)
    assert result.aligned_ns is not None
    assert result.aligned_ns - drive.imu.t_ns[0] < SECOND  # type: ignore[union-attr]
    before = result.decisions.t_ns < drive.imu.t_ns[0]  # type: ignore[union-attr]
    assert before.sum() > 500
    assert (result.decisions.reason[before] == Reason.BEFORE_ALIGNMENT).all()
    assert decided(result, Reason.LATE) == 0


def test_a_gap_with_more_outputs_than_the_history_holds(log: Log) -> None:
    """Half a minute without IMU, states at 500 Hz."""
    drive, config = at_once(with_gap(log, 20.0, 30.0)), msgspec.structs.replace(LATE, output_hz=500.0)
    assert_same(run(drive, config), run(drive, in_stamp_order(config)))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (FusionConfig(order="arival"), r'config: fusion.order: expected "stamp" or "arrival", got \'arival\''),  # type: ignore[arg-type]
        (FusionConfig(history_s=0.0), r"config: fusion.history_s: expected a number above 0 and up to 10, got 0.0"),
        (FusionConfig(history_s=11.0), r"config: fusion.history_s: expected .* got 11.0"),
        (FusionConfig(history_s=float("nan")), r"config: fusion.history_s: expected .* got nan"),
    ],
)
def test_config_that_cannot_run(log: Log, config: FusionConfig, message: str) -> None:
    with pytest.raises(EgolocError, match=message):
        run(log, config)
