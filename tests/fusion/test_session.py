"""A drive in pieces: the same bits as in one, whatever the cuts, and what does not wait in memory."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.result import FusionResult, Reason, Sensor
from fusion.run import Session, joined, run
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.pieces import SENSORS
from sensors.records import Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate
from tests.fusion.scenes import later, only, with_gap, with_outage, without, without_yaw

LENGTH_S = 60.0


@pytest.fixture(scope="module")
def log() -> Log:
    """A minute with float, lost and blind stretches, all sensors."""
    return later(simulate(100.0, 2, scenarios.load("demo")), 100.0 - LENGTH_S)


def delayed(log: Log, position_s: float, velocity_s: float) -> Log:
    """The log as a receiver stamps it that is late (positive) or ahead by so much, which the vehicle says."""
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    vehicle = msgspec.structs.replace(log.vehicle, gnss_delay_s=position_s, gnss_velocity_delay_s=velocity_s)
    return replace(
        log,
        gnss=replace(log.gnss, t_ns=log.gnss.t_ns + round(position_s * 1e9)),
        gnss_velocity=replace(log.gnss_velocity, t_ns=log.gnss_velocity.t_ns + round(velocity_s * 1e9)),
        vehicle=vehicle,
    )


def late_imu(log: Log) -> Log:
    """The IMU begins after twenty seconds and ends five before the rest."""
    assert log.imu is not None
    return replace(log, imu=without(without(log.imu, log, -1e9, 20.0), log, 55.0, 1e9))


SCENES: dict[str, Callable[[Log], Log]] = {
    "all sensors": lambda log: log,
    "gnss late": lambda log: delayed(log, 0.2, 0.35),
    "gnss ahead": lambda log: delayed(log, -0.25, 0.1),
    "gap": lambda log: with_gap(log, 30.0, 4.0),
    "outage": lambda log: with_outage(log, 20.0, 20.0),
    "late start": late_imu,
    "gnss late, late start": lambda log: late_imu(delayed(log, 2.0, 0.0)),
    "course of positions": lambda log: without_yaw(only(log, "gnss")),
    "never aligned": lambda log: only(log, "wheel", "gnss_velocity"),
    "imu alone": only,
    "no overlap": lambda log: replace(only(log), gnss=log.gnss[:500], imu=without(log.imu, log, -1e9, 59.0)),  # type: ignore[index]
}


def pieces(log: Log, cuts_ns: NDArray[np.int64]) -> Iterator[Log]:
    """The log cut at these times; sensors without rows in a piece are None there."""
    edges = [-(2**62), *np.sort(cuts_ns).tolist(), 2**62]
    for begin, end in itertools.pairwise(edges):
        parts: dict[str, Any] = {}
        for name in SENSORS:
            record = getattr(log, name)
            first, last = (0, 0) if record is None else np.searchsorted(record.t_ns, (begin, end))
            parts[name] = record[first:last] if first < last else None
        yield replace(log, **parts)


def in_pieces(log: Log, given: Iterator[Log], config: FusionConfig) -> list[FusionResult]:
    session = Session(log.vehicle, log.map_frame, config)
    return [*(session.push(piece) for piece in given), session.finish()]


def cuts_of(log: Log, seed: int) -> NDArray[np.int64]:
    """Random times: pieces from milliseconds (without IMU, or with nothing else) to half a minute."""
    assert log.imu is not None
    rng = np.random.default_rng(seed)
    start, end = log.imu.t_ns[0] - 10**9, log.imu.t_ns[-1] + 10**9
    coarse = rng.integers(start, end, rng.integers(1, 8))
    fine = rng.choice(log.imu.t_ns) + rng.integers(0, 60_000_000, rng.integers(0, 30))
    exact = rng.choice(log.imu.t_ns, 3)  # an IMU sample's own stamp
    cuts: NDArray[np.int64] = np.concatenate((coarse, fine, exact))
    return cuts


def assert_same(one: FusionResult, other: FusionResult) -> None:
    for part in ("states", "decisions"):
        a, b = getattr(one, part), getattr(other, part)
        for name in a.__dataclass_fields__:
            left, right = getattr(a, name), getattr(b, name)
            assert left.dtype == right.dtype, name
            assert left.shape == right.shape, name
            assert left.tobytes() == right.tobytes(), name
    assert one.aligned_ns == other.aligned_ns
    assert one.left_out == other.left_out
    assert one.restarts == other.restarts


@pytest.mark.parametrize("scene", SCENES)
def test_any_cutting_gives_the_same_bits(log: Log, scene: str) -> None:
    drive, config = SCENES[scene](log), FusionConfig(output_hz=20.0)
    whole = run(drive, config)
    assert (whole.aligned_ns is None) == (scene in ("never aligned", "imu alone", "no overlap"))
    for seed in range(8):
        assert_same(whole, joined(in_pieces(drive, pieces(drive, cuts_of(drive, seed)), config)))


def test_cuts_around_alignment(log: Log) -> None:
    """Every IMU sample's stamp near the first state, each alone, and all of them together."""
    whole = run(log)
    assert log.imu is not None
    assert whole.aligned_ns is not None
    near = log.imu.t_ns[np.abs(log.imu.t_ns - whole.aligned_ns) < 60_000_000]
    assert len(near) > 8
    for cuts in (*near[:, None], *(near[:, None] + 1), near, log.imu.t_ns[: 3 * 100]):
        assert_same(whole, joined(in_pieces(log, pieces(log, cuts), FusionConfig())))


def test_one_sensor_a_piece(log: Log) -> None:
    """Windows of a second, each in two pieces: the other sensors first, then the IMU alone."""
    assert log.imu is not None

    def given() -> Iterator[Log]:
        for piece in pieces(log, log.imu.t_ns[::100]):  # type: ignore[union-attr]
            yield replace(piece, imu=None)
            yield replace(only(piece), imu=piece.imu)

    assert_same(run(log), joined(in_pieces(log, given(), FusionConfig())))


def test_results_follow_the_pieces(log: Log) -> None:
    """Each result holds what is new: states up to the held-back IMU, alignment from its piece on, a gap once."""
    drive = delayed(with_gap(log, 30.0, 4.0), 0.2, 0.35)
    assert drive.imu is not None
    results = in_pieces(drive, pieces(drive, drive.imu.t_ns[0] + np.arange(10, 60, 10) * 10**9), FusionConfig())
    assert [result.aligned_ns is not None for result in results] == [True] * 7
    for k, result in enumerate(results[:-1]):
        behind = (drive.imu.t_ns[0] + min((k + 1) * 10, 60) * 10**9 - result.states.t_ns[-1]) * 1e-9
        assert behind == pytest.approx(0.35, abs=0.2) or k == 2  # the gap begins with the fourth piece
    assert [len(result.left_out) for result in results] == [0, 0, 0, 1, 0, 0, 0]
    stamps = np.concatenate([result.states.t_ns for result in results])
    assert (np.diff(stamps) > 0).all()


def test_rows_count_over_the_drive(log: Log) -> None:
    assert log.imu is not None
    results = in_pieces(log, pieces(log, log.imu.t_ns[::500]), FusionConfig())
    last = results[-2].decisions
    assert log.wheel is not None
    assert last.row[last.sensor == Sensor.WHEEL][-1] > len(log.wheel) - 60
    rows = np.concatenate([r.decisions.row[r.decisions.sensor == Sensor.WHEEL] for r in results])
    assert np.array_equal(rows, np.arange(len(log.wheel)))


def test_a_measurement_after_its_time_is_late(log: Log) -> None:
    assert log.imu is not None
    assert log.gnss is not None
    first, second = pieces(log, log.imu.t_ns[3000:3001])
    assert first.gnss is not None
    session = Session(log.vehicle, log.map_frame)
    session.push(replace(first, gnss=first.gnss[:-1]))
    after = session.push(replace(second, gnss=first.gnss[-1:])).decisions
    late = np.flatnonzero(after.reason == Reason.LATE)
    assert after.t_ns[late].tolist() == [first.gnss.t_ns[-1]]
    assert after.row[late].tolist() == [len(first.gnss) - 1]


def test_what_waits_for_an_imu_is_bounded(log: Log) -> None:
    """Fixes that can no longer help an IMU that has not begun are decided as they age."""
    assert log.wheel is not None
    session = Session(log.vehicle, log.map_frame)
    decided = 0
    for minute in range(5):
        wheel = replace(log.wheel, t_ns=log.wheel.t_ns + minute * 60 * 10**9)
        early = session.push(replace(only(log), imu=None, wheel=wheel)).decisions
        assert (early.reason == Reason.BEFORE_ALIGNMENT).all()
        assert np.array_equal(early.row, np.arange(decided, decided + len(early.row)))
        decided += len(early.row)
        assert (minute + 1) * len(log.wheel) - decided <= len(log.wheel) + 1


def test_a_drive_without_imu_is_refused_at_its_end(log: Log) -> None:
    session = Session(log.vehicle, log.map_frame)
    session.push(replace(log, imu=None))
    with pytest.raises(EgolocError, match=r"no IMU samples: expected sensor_msgs/msg/Imu"):
        session.finish()


def test_pose_fixes_without_map_frame_are_refused(log: Log) -> None:
    with pytest.raises(EgolocError, match=r"pose fixes but no map frame"):
        Session(log.vehicle).push(log)


def test_the_session_knows_the_vehicle_and_the_map(log: Log) -> None:
    """Pieces may come without them."""
    bare = replace(log, vehicle=type(log.vehicle)(), map_frame=MapFrame("utm", zone=1))
    assert_same(run(log), joined(in_pieces(log, iter([bare]), FusionConfig())))


def test_imu_stamps_must_rise_from_piece_to_piece(log: Log) -> None:
    session = Session(log.vehicle, log.map_frame)
    session.push(log)
    with pytest.raises(EgolocError, match=r"Imu.t_ns: expected increasing stamps, got \d+ after \d+"):
        session.push(log)
