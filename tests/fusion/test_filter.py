"""The streaming Localizer: bit for bit what the batch run gives, and what live use may do wrong."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fusion.config import FusionConfig
from fusion.filter import Localizer, Measurement
from fusion.result import Decisions, Reason, Sensor, States
from fusion.run import run
from sensors.errors import EgolocError
from sensors.records import GnssFix, Imu, Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate
from tests.fusion.scenes import later, without

MEASURED = ("gnss", "gnss_velocity", "pose_fixes", "wheel")


@pytest.fixture(scope="module")
def log() -> Log:
    """Forty seconds with float, lost and blind stretches, all sensors."""
    return later(simulate(100.0, 2, scenarios.load("demo")), 60.0)


def in_stamp_order(log: Log, block: int) -> list[Imu | Measurement]:
    """Records of up to ``block`` rows, each pushed once its first row is due; at equal stamps measurements come first.

    A measurement never comes after an IMU sample that is younger than it.
    """
    pieces: list[tuple[int, int, Any]] = []
    for order, name in enumerate((*MEASURED, "imu")):
        record = getattr(log, name)
        for i in range(0, len(record), block):
            piece = record[i : i + block]
            due = int(piece.t_ns[-1] if name == "imu" else piece.t_ns[0])
            pieces.append((due, order, piece))
    return [piece for *_, piece in sorted(pieces, key=lambda p: p[:2])]


def stream(log: Log, block: int, config: FusionConfig) -> tuple[States, Decisions, Localizer]:
    localizer = Localizer(log.vehicle, log.map_frame, config)
    for record in in_stamp_order(log, block):
        localizer.push(record)
    return localizer.take_states(), localizer.take_decisions(), localizer


def assert_equal_columns(a: Any, b: Any, rows: slice = slice(None)) -> None:
    for name in a.__dataclass_fields__:
        one, other = getattr(a, name), getattr(b, name)[rows]
        assert one.dtype == other.dtype, name
        assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f"), name


@pytest.mark.parametrize("block", [1, 3, 50])
def test_states_covariances_and_decisions_equal_the_batch_run(log: Log, block: int) -> None:
    config = FusionConfig(output_hz=20.0)
    batch = run(log, config)
    states, decisions, localizer = stream(log, block, config)
    assert len(states) > 700
    assert_equal_columns(states, batch.states)
    reached = batch.decisions.reason != Reason.OUTSIDE_IMU
    assert reached[: len(decisions.t_ns)].all()  # what the IMU has not reached is still pending in the stream
    assert reached.sum() == len(decisions.t_ns)
    assert_equal_columns(decisions, batch.decisions, slice(len(decisions.t_ns)))
    assert {Reason.PARTLY_ACCEPTED, Reason.ACCEPTED} <= set(decisions.reason)
    assert log.imu is not None
    assert localizer.t_ns == log.imu.t_ns[-1]


def test_taking_states_in_between_changes_nothing(log: Log) -> None:
    localizer = Localizer(log.vehicle, log.map_frame)
    parts: list[States] = []
    for i, record in enumerate(in_stamp_order(log, 1)):
        localizer.push(record)
        if i % 997 == 0:
            parts.append(localizer.take_states())
            assert len(localizer.take_states()) == 0
    parts.append(localizer.take_states())
    batch = run(log).states
    joined = np.concatenate([part.llh for part in parts])
    assert np.array_equal(joined, batch.llh)
    assert np.array_equal(np.concatenate([part.pose_cov for part in parts]), batch.pose_cov)


def test_before_alignment_there_is_no_state(log: Log) -> None:
    localizer = Localizer(log.vehicle, log.map_frame)
    assert log.imu is not None
    localizer.push(log.imu[:200])
    assert localizer.t_ns is None
    assert localizer.covariance() is None
    assert len(localizer.take_states()) == 0
    assert len(localizer.take_decisions().t_ns) == 0


def test_late_measurement_is_recorded_and_changes_nothing(log: Log) -> None:
    assert log.gnss is not None
    assert log.imu is not None
    row = 250
    late, rest = log.gnss[row : row + 1], replace(log, gnss=log.gnss[np.arange(len(log.gnss)) != row])
    localizer = Localizer(log.vehicle, log.map_frame)
    pushed = False
    for record in in_stamp_order(rest, 1):
        localizer.push(record)
        if not pushed and isinstance(record, Imu) and record.t_ns[0] > late.t_ns[0]:
            pushed = True
            localizer.push(late)
    assert pushed
    decisions = localizer.take_decisions()
    found = np.flatnonzero(decisions.reason == Reason.LATE)
    assert len(found) == 1
    assert decisions.t_ns[found[0]] == late.t_ns[0]
    assert decisions.sensor[found[0]] == Sensor.GNSS_POSITION
    assert_equal_columns(localizer.take_states(), run(rest).states)


@pytest.mark.parametrize("aligned", [False, True])
def test_imu_stamps_must_rise(log: Log, aligned: bool) -> None:
    localizer = Localizer(log.vehicle, log.map_frame)
    assert log.imu is not None
    for record in in_stamp_order(log, 10) if aligned else [log.imu[:50]]:
        localizer.push(record)
    assert (localizer.t_ns is not None) == aligned
    with pytest.raises(EgolocError, match=r"Imu.t_ns: expected increasing stamps, got \d+ after \d+"):
        localizer.push(log.imu[49:50])


def test_an_empty_record_does_nothing(log: Log) -> None:
    localizer = Localizer(log.vehicle, log.map_frame)
    assert log.imu is not None
    assert log.gnss is not None
    for record in (log.imu[:0], log.gnss[:0], log.imu[:5], log.imu[:0], log.imu[5:9]):
        localizer.push(record)
    with pytest.raises(EgolocError):
        localizer.push(log.imu[8:9])


def test_pose_fix_without_map_frame_is_refused(log: Log) -> None:
    assert log.pose_fixes is not None
    with pytest.raises(EgolocError, match="no map frame"):
        Localizer(log.vehicle).push(log.pose_fixes[:1])


def test_covariance_is_that_of_the_last_recorded_state(log: Log) -> None:
    states, _, localizer = stream(log, 1, FusionConfig(output_hz=100.0))
    P = localizer.covariance()
    assert P is not None
    assert np.sqrt(np.diag(P))[:15] == pytest.approx(states.sigma[-1], rel=0.05)
    assert P.shape == (23, 23)
    P[:] = 0.0  # a copy
    assert localizer.covariance() is not None
    assert np.diag(localizer.covariance())[0] > 0  # type: ignore[arg-type]


def test_streaming_over_a_gap_equals_the_batch_run(log: Log) -> None:
    """Samples missing for three seconds, measurements inside the gap."""
    gappy = replace(log, imu=without(log.imu, log, 20.0, 23.0))
    states, decisions, _ = stream(gappy, 1, FusionConfig())
    batch = run(gappy, FusionConfig())
    assert_equal_columns(states, batch.states)
    assert_equal_columns(decisions, batch.decisions, slice(len(decisions.t_ns)))


def test_gnss_fix_type_is_what_rows_count(log: Log) -> None:
    """Rows count each pushed record type from zero, as the log's do."""
    assert isinstance(log.gnss, GnssFix)
    _, decisions, _ = stream(log, 7, FusionConfig())
    for sensor, name in ((Sensor.GNSS_POSITION, "gnss"), (Sensor.POSE_FIX, "pose_fixes"), (Sensor.WHEEL, "wheel")):
        rows = decisions.row[decisions.sensor == sensor]
        assert np.array_equal(rows, np.arange(len(rows)))
        assert np.array_equal(decisions.t_ns[decisions.sensor == sensor], getattr(log, name).t_ns[rows])
