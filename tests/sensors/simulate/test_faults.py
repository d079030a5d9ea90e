"""Faults: what they do to rows, the door behind them, and the same bits however the drive is cut."""

from collections.abc import Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.geodesy import enu_from_llh
from sensors.mcap import encode
from sensors.mcap.io import read_log, write_log
from sensors.pieces import SENSORS, join, summed
from sensors.records import GnssStatus, LeftOut, Log, PoseFix
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate
from sensors.simulate.faults import FAULTS, SEVERITIES
from sensors.simulate.faults.inject import Injector
from sensors.simulate.faults.spec import parse
from tests.replay.cutting import cut_at, random_edges

BEGIN_S, LENGTH_S = 8.0, 9.0


@pytest.fixture(scope="module")
def log() -> Log:
    """Half a minute, of which the last twenty seconds in motion; every sensor."""
    return simulate(30.0, 3, scenarios.load("clean"))


def faulty(drive: Log | Iterable[Log], *specs: str, seed: int = 1) -> Log:
    pieces = [drive] if isinstance(drive, Log) else drive
    return join(Injector(parse(specs), seed).pieces(pieces))


def inside(log: Log, record: Any, begin_s: float = BEGIN_S, length_s: float = LENGTH_S) -> Any:
    assert log.imu is not None
    since = (record.t_ns - log.imu.t_ns[0]) * 1e-9 - begin_s
    return (since >= 0) & (since < length_s)


def columns(record: Any) -> dict[str, bytes]:
    return {f.name: getattr(record, f.name).tobytes() for f in fields(record)}


def test_there_are_enough_faults_each_told_by_its_magnitude() -> None:
    assert len(FAULTS) >= 25
    for fault in FAULTS.values():
        told = {fault.told(severity, fault.length_s(severity)) for severity in SEVERITIES}
        assert len(told) == 3
        assert not any("{" in line for line in told)


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_acts_in_its_time_on_its_records_alone(name: str, log: Log) -> None:
    """Before it, every bit is the log's; no other record changes, the reference least of all."""
    found = faulty(log, f"{name}:severe@{BEGIN_S}+{LENGTH_S}")
    changed = []
    for record in SENSORS:
        before, after = getattr(log, record), getattr(found, record)
        if before is None:
            assert after is None
            continue
        early = before[before.t_ns < log.imu.t_ns[0] + round((BEGIN_S - 3.0) * 1e9)]  # type: ignore[union-attr]
        assert columns(after[after.t_ns <= early.t_ns[-1]]) == columns(early)
        if columns(after) != columns(before):
            changed.append(record)
    arrivals_alone = name == "imu-duplicates" or FAULTS[name].sizes is None
    assert set(changed) <= set(FAULTS[name].acts)
    assert changed or arrivals_alone or found.left_out


@pytest.mark.parametrize("name", FAULTS)
def test_the_same_bits_however_the_drive_is_cut(name: str, log: Log) -> None:
    spec = f"{name}:severe@{BEGIN_S}+{LENGTH_S}"
    whole = faulty(log, spec)
    for seed in range(2):
        cut = faulty(cut_at(log, random_edges(log, 12, np.random.default_rng(seed))), spec)
        for record in SENSORS:
            a, b = getattr(whole, record), getattr(cut, record)
            assert (a is None) == (b is None)
            assert a is None or columns(a) == columns(b), record
        key = lambda entry: (entry.source, entry.reason)  # noqa: E731
        assert sorted(summed(cut.left_out), key=key) == sorted(summed(whole.left_out), key=key)


def test_pieces_keep_their_promise(log: Log) -> None:
    """Up to a piece's last IMU sample nothing follows in later ones, also where stamps move back and ahead."""
    specs = ("gnss-time-back:severe@8+9", "pose-time-jump:severe@8+9", "imu-time-jump:mild@10+5", "gnss-restamped@20+6")
    pieces = Injector(parse(specs), 1).pieces(cut_at(log, random_edges(log, 12, np.random.default_rng(5))))
    reached = -(2**62)
    for piece in pieces:
        rows = [record for name in SENSORS if (record := getattr(piece, name)) is not None]
        assert all(int(record.t_ns[0]) > reached for record in rows)
        reached = reached if piece.imu is None else int(piece.imu.t_ns[-1])


def test_seeds_decide_what_is_random_and_nothing_else(log: Log) -> None:
    spec = "gnss-noise@8+9"
    first, again, other = (faulty(log, spec, seed=seed).gnss for seed in (1, 1, 2))
    assert first is not None
    assert other is not None
    assert columns(first) == columns(again)
    assert columns(first) != columns(other)
    assert (first.t_ns == other.t_ns).all()


def test_magnitudes_are_what_the_lines_say(log: Log) -> None:
    assert log.gnss is not None
    assert log.pose_fixes is not None
    assert log.imu is not None
    assert log.wheel is not None
    here = inside(log, log.gnss)
    for severity, metres in (("mild", 1.0), ("medium", 5.0), ("severe", 50.0)):
        gnss = faulty(log, f"gnss-jump:{severity}@8+9").gnss
        assert gnss is not None
        apart = np.linalg.norm(
            enu_from_llh(gnss.llh, log.gnss.llh[0]) - enu_from_llh(log.gnss.llh, log.gnss.llh[0]), axis=1
        )
        np.testing.assert_allclose(apart, np.where(here, metres, 0.0), atol=1e-3)
    wrong = faulty(log, "gnss-wrong-fix:mild@8+9").gnss
    assert wrong is not None
    assert (wrong.status[here] == GnssStatus.FIXED).all()
    np.testing.assert_allclose(np.sqrt(wrong.cov_enu[here][:, 0, 0]), 0.01)
    poses = faulty(log, "pose-lane:medium@8+9").pose_fixes
    assert poses is not None
    here = inside(log, poses)
    moved, yaw = (poses.pose - log.pose_fixes.pose)[here], log.pose_fixes.pose[here, 2]
    np.testing.assert_allclose(-np.sin(yaw) * moved[:, 0] + np.cos(yaw) * moved[:, 1], 3.5, atol=1e-9)
    imu = faulty(log, "imu-gyro-bias:severe@8+9").imu
    assert imu is not None
    np.testing.assert_allclose(np.degrees(imu.gyro - log.imu.gyro)[inside(log, imu)], 2.0, rtol=1e-9)
    flipped = faulty(log, "imu-axis-flip:severe@8+9").imu
    assert flipped is not None
    np.testing.assert_array_equal(flipped.gyro[inside(log, imu), 2], -log.imu.gyro[inside(log, imu), 2])
    wheel = faulty(log, "wheel-reversed@8+9").wheel
    assert wheel is not None
    np.testing.assert_array_equal(wheel.speed[inside(log, wheel)], -log.wheel.speed[inside(log, wheel)])


@pytest.mark.parametrize("severity", SEVERITIES)
def test_dropouts_are_as_long_as_they_say(severity: str, log: Log) -> None:
    imu = faulty(log, f"imu-dropout:{severity}@5").imu
    assert imu is not None
    wanted = dict(zip(SEVERITIES, (0.1, 1.0, 10.0), strict=True))[severity]
    assert np.diff(imu.t_ns).max() * 1e-9 == pytest.approx(wanted + 0.01, abs=1e-6)


def test_a_burst_arrives_at_once(log: Log) -> None:
    gnss = faulty(log, "gnss-burst:medium@8+9").gnss
    assert gnss is not None
    assert log.gnss is not None
    np.testing.assert_array_equal(gnss.t_ns, log.gnss.t_ns)
    delays = ((gnss.arrival_ns - gnss.t_ns) * 1e-9)[inside(log, gnss)]
    assert delays.max() == pytest.approx(2.0, abs=1e-6)
    assert delays.min() == pytest.approx(0.1 + 1.9 / 100, abs=1e-6)  # the last of twenty, which came so fast
    restamped = faulty(log, "gnss-restamped:medium@8+9").gnss
    assert restamped is not None
    steps = np.diff(restamped.t_ns)[inside(log, restamped)[1:]]
    assert steps.max() > 1.8e9
    assert np.median(steps) == pytest.approx(1e6, rel=0.01)


def test_several_faults_act_one_after_the_other(log: Log) -> None:
    both = faulty(log, "wheel-slip:mild@8+9,wheel-scale:severe@8+9").wheel
    assert both is not None
    assert log.wheel is not None
    here = inside(log, both)
    np.testing.assert_allclose(both.speed[here], 1.5 * (log.wheel.speed[here] + 0.5))


def test_without_faults_pieces_pass_untouched(log: Log) -> None:
    pieces = list(cut_at(log, random_edges(log, 3, np.random.default_rng(0))))
    assert all(a is b for a, b in zip(Injector(()).pieces(pieces), pieces, strict=True))


SPOILT = {
    "gnss-nan:medium": ("/gnss/fix", "gnss", "latitude, longitude or altitude is not finite"),
    "pose-covariance-nan:medium": ("/egovm/pose", "pose_fixes", "pose.covariance of x, y, yaw is not finite"),
    "pose-covariance-indefinite:medium": (
        "/egovm/pose",
        "pose_fixes",
        "pose.covariance of x, y, yaw is not positive definite",
    ),
    "imu-nan:medium": ("/imu", "imu", "angular_velocity is not finite"),
    "imu-duplicates:medium": ("/imu", "imu", "stamp repeats"),
    "gnss-duplicates:medium": ("/gnss/fix", "gnss", "stamp repeats"),
}


@pytest.mark.parametrize("spec", SPOILT)
def test_a_log_with_such_messages_is_read_alike(
    spec: str, log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same fault in an MCAP file: the reader leaves out as many rows for the same reason, and keeps the same."""
    topic, name, reason = SPOILT[spec]
    found = faulty(log, f"{spec}@8+9")
    (left_out,) = [entry for entry in found.left_out if entry.source == name]
    path = tmp_path / "spoilt.mcap"
    with monkeypatch.context() as patch:  # records refuse such rows: they are written past them
        patch.setattr("sensors.mcap.io.messages_of", lambda given: encode.messages_of(unchecked(given, spec)))
        write_log(path, log)
    read = read_log(path)
    assert LeftOut(topic, reason, left_out.count) in read.left_out
    assert left_out.reason == reason
    kept, wanted = getattr(read, name), getattr(found, name)
    np.testing.assert_array_equal(kept.t_ns, wanted.t_ns)


def unchecked(log: Log, spec: str) -> Log:
    """The log with the fault's raw rows, which no check has seen."""
    raw: dict[str, Any] = {}

    class Open:
        def __init__(self, name: str) -> None:
            self.name = name
            self.left_out: dict[str, int] = {}

        def admit(self, rows: Any) -> None:
            record = getattr(log, self.name)
            made = object.__new__(type(record))
            for name, column in rows.columns.items():
                object.__setattr__(made, name, column)
            raw[self.name] = made

        def take(self, *_: Any) -> None:
            return None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sensors.simulate.faults.inject.Door", Open)
        list(Injector(parse([f"{spec}@8+9"]), 1).pieces([log]))
    return replace(log, **raw)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("gnss-jmp", "expected one of the faults gnss-jump, "),
        ("gnss-jump:huge", "expected one of the severities mild, medium, severe, got 'huge'"),
        ("gnss-jump@x", "BEGIN: expected seconds"),
        ("gnss-jump@-1", "BEGIN: expected seconds"),
        ("gnss-jump@nan", "BEGIN: expected seconds"),
        ("gnss-jump@60+", "LENGTH: expected seconds"),
        ("gnss-jump@60+0", "LENGTH: expected more than 0 s"),
        ("gnss-jump@60+inf", "LENGTH: expected seconds"),
        ("gnss-jump+20", "expected NAME[:SEVERITY][@BEGIN[+LENGTH]]"),
        ("gnss-jump:mild:mild", "expected NAME[:SEVERITY][@BEGIN[+LENGTH]]"),
        ("", "expected NAME[:SEVERITY][@BEGIN[+LENGTH]]"),
        ("gnss-jump,", "expected NAME[:SEVERITY][@BEGIN[+LENGTH]]"),
    ],
)
def test_what_is_no_fault_is_refused_in_a_line(spec: str, expected: str) -> None:
    with pytest.raises(EgolocError) as refused:
        parse([spec])
    assert str(refused.value).startswith("--inject: ")
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("spec", ["gnss-jump", "imu-dropout:mild@0.1", "all-out:severe@12.5+0.000000001"])
def test_specs_say_everything_and_read_back(spec: str) -> None:
    (one,) = parse([spec])
    assert parse([one.spec]) == (one,)


def test_usual_severity_begin_and_length() -> None:
    assert [one.spec for one in parse(["gnss-jump, imu-dropout@5"])] == [
        "gnss-jump:medium@60+10",
        "imu-dropout:medium@5+1",
    ]


def test_a_fault_that_meets_nothing_is_an_error(log: Log) -> None:
    with pytest.raises(EgolocError, match="gnss-jump:medium@500\\+10: expected gnss in that time of the drive"):
        faulty(log, "gnss-jump@500")
    with pytest.raises(EgolocError, match="expected pose fixes"):
        faulty(replace(log, pose_fixes=None), "pose-lane@8")


def test_the_covariance_is_none_only_where_it_should_be(log: Log) -> None:
    """Rows that pass are the log's own."""
    found = faulty(log, "pose-covariance-indefinite:medium@8+9").pose_fixes
    assert isinstance(found, PoseFix)
    assert log.pose_fixes is not None
    kept = np.isin(log.pose_fixes.t_ns, found.t_ns)
    assert columns(found) == columns(log.pose_fixes[kept])
    assert 0.4 < (~kept[inside(log, log.pose_fixes)]).mean() < 0.6
