"""The Localizer in arrival order: bit for bit the replay, and what a live system may do to it."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion import filter as live
from fusion.config import FusionConfig
from fusion.filter import Localizer, Measurement
from fusion.history import EVENTS, NEW
from fusion.result import Decisions, Reason, Sensor, States
from fusion.run import run
from sensors.errors import EgolocError
from sensors.records import Imu, Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate
from tests.fusion.arrivals import LATE, MEASURED, arriving, at_once, records_by_arrival, scattered
from tests.fusion.scenes import later, with_gap, without
from tests.fusion.test_filter import assert_equal_columns

SECOND = 10**9


@pytest.fixture(scope="module")
def log() -> Log:
    """Thirty seconds of all sensors; fixes come 50 ms late, pose fixes 120 ms, wheel speeds 10 ms."""
    return later(simulate(100.0, 2, scenarios.load("demo")), 70.0)


def stream(log: Log, config: FusionConfig) -> tuple[States, Decisions, Localizer]:
    localizer = Localizer(log.vehicle, log.map_frame, config)
    for record in records_by_arrival(log):
        localizer.push(record)
    return localizer.take_states(), localizer.take_decisions(), localizer


def assert_equal_replay(log: Log, config: FusionConfig, *, rows: bool = True) -> None:
    """rows: each sensor's come in order, so that those pushed count as those of the log."""
    states, decisions, _ = stream(log, config)
    replay = run(log, config)
    assert_equal_columns(states, replay.states)
    reached = replay.decisions.reason != Reason.OUTSIDE_IMU
    assert reached[: len(decisions.t_ns)].all()
    assert reached.sum() == len(decisions.t_ns)
    same = decisions if rows else replace(decisions, row=replay.decisions.row[: len(decisions.row)])
    assert_equal_columns(same, replay.decisions, slice(len(decisions.t_ns)))


def test_live_equals_the_replay(log: Log) -> None:
    assert_equal_replay(log, msgspec.structs.replace(LATE, output_hz=20.0))


def test_live_equals_the_replay_out_of_order_and_too_late(log: Log) -> None:
    drive = scattered(log, 4, 1.3)
    assert (run(drive, LATE).decisions.reason == Reason.LATE).sum() > 50
    assert_equal_replay(drive, LATE, rows=False)


def test_live_equals_the_replay_over_a_gap(log: Log) -> None:
    assert_equal_replay(with_gap(log, 10.0, 4.0), LATE)


def test_live_equals_the_replay_where_the_imu_comes_late(log: Log) -> None:
    assert_equal_replay(arriving(log, lambda t: np.full(len(t), 30_000_000), ("imu", "pose_fixes")), LATE)


def test_live_equals_the_replay_with_spikes_in_the_imu(log: Log) -> None:
    """They are held back, in a replay and live."""
    assert log.imu is not None
    gyro = log.imu.gyro.copy()
    gyro[[30, 1000, 1700, 2400]] += 3.0
    drive = replace(log, imu=replace(log.imu, gyro=gyro))
    localizer = stream(drive, LATE)[2]
    assert localizer._navigator.spikes.held_back == 4
    assert (run(drive, LATE).left_out[-1].source, run(drive, LATE).left_out[-1].count) == ("imu", 4)
    assert_equal_replay(drive, LATE)


def test_blocks_of_rows(log: Log) -> None:
    """A second of each sensor at once, the IMU last: applied where they belong."""
    assert log.imu is not None
    drive = at_once(log)
    localizer = Localizer(log.vehicle, log.map_frame, LATE)
    for second in range(31):
        for name in (*MEASURED, "imu"):
            record = getattr(drive, name)
            s = (record.t_ns - log.imu.t_ns[0]) // SECOND
            localizer.push(record[s == second])
    assert_equal_columns(localizer.take_states(), run(drive, LATE).states)


def pushed_until(log: Log, s: float) -> tuple[Localizer, list[Imu | Measurement]]:
    """A Localizer in the middle of the drive, and what comes next."""
    assert log.imu is not None
    localizer, records = Localizer(log.vehicle, log.map_frame, LATE), records_by_arrival(log)
    until = log.imu.t_ns[0] + round(s * 1e9)
    count = next(i for i, record in enumerate(records) if record.arrival_ns[0] > until)
    for record in records[:count]:
        localizer.push(record)
    return localizer, records[count:]


def test_the_state_is_that_of_the_last_imu_sample(log: Log) -> None:
    localizer, rest = pushed_until(log, 10.0)
    for record in rest[:200]:
        localizer.push(record)
        state = localizer.state()
        assert state is not None
        assert localizer.core is not None
        if isinstance(record, Imu):
            assert state.t_ns == localizer.t_ns == record.t_ns[0]
        assert np.array_equal(state.llh, localizer.core.nav[:3])
        assert np.array_equal(np.r_[state.vel_enu, state.q_enu_body], localizer.core.nav[3:10])
        state.llh[:] = 0.0  # a copy
        assert localizer.core.nav[0] != 0.0


def test_a_late_fix_moves_the_state_at_once(log: Log) -> None:
    """Whatever the clock of its arrival says."""
    localizer, rest = pushed_until(log, 10.0)
    fix = next(record for record in rest if record is not rest[0] and type(record) is type(log.pose_fixes))
    before = localizer.state()
    assert before is not None
    assert before.t_ns > fix.t_ns[0]
    localizer.push(replace(fix, arrival_ns=np.zeros(1, np.int64)))
    after = localizer.state()
    assert after is not None
    assert after.t_ns == before.t_ns
    assert (after.llh != before.llh).any()
    decision = localizer.take_decisions()
    assert decision.sensor[-1] == Sensor.POSE_FIX
    assert decision.t_ns[-1] == fix.t_ns[0]


def test_the_covariance_is_that_of_the_state_now(log: Log) -> None:
    """It grows with every sample, and asking for it changes nothing."""
    assert log.imu is not None
    asked, rest = pushed_until(log, 10.0)
    other, _ = pushed_until(log, 10.0)
    sigmas = []
    for record in [record for record in rest if isinstance(record, Imu)][:9]:
        asked.push(record)
        other.push(record)
        P = asked.covariance()
        assert P is not None
        np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-18)
        sigmas.append(np.sqrt(P[2, 2]))
    assert (np.diff(sigmas) > 0).all()
    assert asked.core is not None
    assert other.core is not None
    assert np.array_equal(asked.core.P, other.core.P)
    assert np.array_equal(asked.core.acc, other.core.acc)


def test_before_alignment_there_is_no_state(log: Log) -> None:
    localizer = Localizer(log.vehicle, log.map_frame, LATE)
    assert log.imu is not None
    localizer.push(log.imu[:200])
    assert localizer.state() is None
    assert localizer.t_ns is None
    assert localizer.covariance() is None
    assert len(localizer.take_states()) == len(localizer.take_decisions().t_ns) == 0


def test_a_duplicate_changes_nothing(log: Log) -> None:
    """The same row again: at once, half a second later, and too late for the history."""
    localizer, rest = pushed_until(log, 10.0)
    twin, _ = pushed_until(log, 10.0)
    localizer.take_decisions()
    assert log.imu is not None
    fixes = [record for record in rest if type(record) is not Imu and type(record) is not type(log.wheel)][:40]
    for k, record in enumerate(rest[:800]):
        localizer.push(record)
        twin.push(record)
        if record is fixes[0]:
            localizer.push(record)
            first = k
        if k in (first + 100 if fixes[0] in rest[: k + 1] else -1, 500):
            localizer.push(fixes[0])
    decisions = localizer.take_decisions()
    mine = (decisions.t_ns == fixes[0].t_ns[0]) & (decisions.arrival_ns == fixes[0].arrival_ns[0])
    reasons = decisions.reason[mine & (decisions.sensor == decisions.sensor[mine][0])].tolist()
    assert reasons[1:] == [Reason.DUPLICATE, Reason.DUPLICATE, Reason.LATE]
    assert_equal_columns(localizer.take_states(), twin.take_states())
    assert localizer.core is not None
    assert twin.core is not None
    assert np.array_equal(localizer.core.nav, twin.core.nav)


def test_imu_stamps_must_rise(log: Log) -> None:
    localizer, rest = pushed_until(log, 10.0)
    samples = [record for record in rest if isinstance(record, Imu)]
    localizer.push(samples[0])
    with pytest.raises(EgolocError, match=r"Imu.t_ns: expected increasing stamps, got \d+ after \d+"):
        localizer.push(samples[0])
    localizer.push(samples[1])
    assert localizer.t_ns == samples[1].t_ns[0]


def test_more_measurements_than_the_history_holds(log: Log) -> None:
    """The IMU falls silent while wheel speeds go on: the oldest are given up, and it goes on when the IMU is back."""
    assert log.imu is not None
    assert log.wheel is not None
    localizer, _ = pushed_until(log, 10.0)
    localizer.take_decisions()
    assert localizer.t_ns is not None
    begin, count = localizer.t_ns, EVENTS + 3 * NEW
    stamps = begin + 1_000_000 * np.arange(1, count + 1)
    given_up = list[int]()
    for k in range(0, count, 700):
        t_ns = stamps[k : k + 700]
        speed = np.full(len(t_ns), log.wheel.speed[0])
        localizer.push(type(log.wheel)(t_ns, t_ns, speed, np.full(len(t_ns), 0.1)))
        decided = localizer.take_decisions()
        assert (decided.reason == Reason.OUTSIDE_IMU).all()
        given_up += decided.t_ns.tolist()
    assert given_up == stamps[: len(given_up)].tolist()
    assert count - EVENTS <= len(given_up) < count
    t_ns = np.array([stamps[-1] + 1])
    localizer.push(Imu(t_ns, t_ns, log.imu.gyro[:1], log.imu.accel[:1]))
    decided = localizer.take_decisions()
    wheel = decided.sensor == Sensor.WHEEL
    assert np.array_equal(decided.t_ns[wheel], stamps[len(given_up) :])
    assert localizer.t_ns == t_ns[0]


def test_what_is_not_taken_is_forgotten_in_the_end(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "_KEPT", 3000)
    states, decisions, _ = stream(log, msgspec.structs.replace(LATE, output_hz=1000.0))
    replay = run(log, msgspec.structs.replace(LATE, output_hz=1000.0))
    assert 3000 <= len(states) < 5000 < len(replay.states)
    assert_equal_columns(states, replay.states, slice(-len(states), None))
    assert len(decisions.t_ns) <= 5000


def test_measurements_without_an_imu_do_not_pile_up(log: Log) -> None:
    """Before the first state, whatever the IMU does."""
    assert log.wheel is not None
    for imu in (None, log.imu):
        localizer = Localizer(log.vehicle, log.map_frame, LATE)
        if imu is not None:
            localizer.push(imu[:5])
        decided = 0
        for minute in range(4):
            localizer.push(replace(log.wheel, t_ns=log.wheel.t_ns + minute * 60 * SECOND))
            decided += len(localizer.take_decisions().t_ns)
        assert decided >= 2 * len(log.wheel)


def test_rows_before_the_imu_and_alignment_by_live_pushes(log: Log) -> None:
    """Lazy stamps of arrival (zero) do not keep a Localizer from its first state."""
    assert log.imu is not None
    localizer = Localizer(log.vehicle, log.map_frame, LATE)
    known = None
    for record in records_by_arrival(replace(log, imu=without(log.imu, log, -1e9, 1.0))):
        localizer.push(replace(record, arrival_ns=np.zeros(1, np.int64)))
        if known is None and localizer.t_ns is not None:
            known = localizer.t_ns
    assert known is not None
    assert known - log.imu.t_ns[0] < 2 * SECOND
    states = localizer.take_states()
    assert states.t_ns[0] > known  # no state of a time before it was known
    assert len(states) > 270


def test_pose_fix_without_map_frame_is_refused(log: Log) -> None:
    assert log.pose_fixes is not None
    with pytest.raises(EgolocError, match="no map frame"):
        Localizer(log.vehicle, config=LATE).push(log.pose_fixes[:1])
