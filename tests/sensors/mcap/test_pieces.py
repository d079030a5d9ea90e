"""Logs that are read window by window: the same rows as whole, in bounded memory, whatever the file is like."""

import random
import struct
import zlib
from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from sensors.errors import EgolocError
from sensors.mcap.assembly import Facts
from sensors.mcap.io import read_log, read_pieces, write_log
from sensors.mcap.schemas import schema_text
from sensors.pieces import SENSORS, cut, join
from sensors.records import Imu, LeftOut, Log
from tests.sensors.mcap.messages import (
    SMALL,
    START_NS,
    VARIANTS,
    Sent,
    encode,
    full_log,
    gps,
    imu_messages,
    mcap_bytes,
    nav_sat,
    pose,
    stamp,
    twist,
)

Save = Callable[..., Path]
SECOND = 10**9
LATE = "message comes too late, after others of its time were passed on"


def assert_same(a: Log, b: Log) -> None:
    for name in SENSORS:
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            for field in fields(one):
                column = getattr(other, field.name)
                np.testing.assert_array_equal(getattr(one, field.name), column, err_msg=f"{name}.{field.name}")
    assert (a.vehicle, a.map_frame) == (b.vehicle, b.map_frame)


def in_windows(pieces: Iterable[Log], length_s: float) -> list[Log]:
    """The pieces, once their stamps were seen to lie in windows that follow each other, those of all sensors in one."""
    found, begin, before = list(pieces), None, -1
    for piece in found:
        stamps = [record.t_ns for name in SENSORS if (record := getattr(piece, name)) is not None]
        first, last = min(int(t[0]) for t in stamps), max(int(t[-1]) for t in stamps)
        begin = first if begin is None else begin
        window = (first - begin) // round(length_s * SECOND)
        assert (last - begin) // round(length_s * SECOND) == window
        assert window > before
        before = window
    return found


@pytest.mark.parametrize("length_s", [0.7, 3.0, 20.0, 1000.0])
def test_pieces_of_a_file_are_the_log_cut(tmp_path: Path, length_s: float) -> None:
    log = full_log(6000)
    write_log(tmp_path / "a.mcap", log)
    whole = read_log(tmp_path / "a.mcap")
    pieces = in_windows(read_pieces(tmp_path / "a.mcap", length_s=length_s), length_s)
    expected = list(cut(whole, length_s))
    assert len(pieces) == len(expected)
    for piece, other in zip(pieces, expected, strict=True):
        assert_same(piece, other)
    assert_same(join(pieces), whole)
    assert all(piece.left_out == () for piece in pieces)


def imu_of(log: Log) -> Imu:
    assert log.imu is not None
    return log.imu


@pytest.mark.parametrize("options", VARIANTS.values(), ids=VARIANTS)
def test_every_kind_of_file(save: Save, options: dict[str, Any]) -> None:
    messages = [m for k in range(300) for m in (*LONG_IMU[10 * k : 10 * k + 10], nav_sat(k))]
    path = save(messages, **SMALL, **options)
    pieces = in_windows(read_pieces(path, length_s=2.0), 2.0)
    assert len(pieces) == 15
    assert [len(imu_of(piece)) for piece in pieces] == [200] * 15
    assert_same(join(pieces), read_log(path))


LONG_IMU = [m._replace(value=encode(m.schema, m.value)) for m in imu_messages(3000) if isinstance(m.value, dict)]


def stamped(message: Sent, t_ns: int) -> Sent:
    """The message with another header stamp."""
    assert isinstance(message.value, bytes)
    return message._replace(value=message.value[:4] + struct.pack("<iI", *divmod(t_ns, SECOND)) + message.value[12:])


def read(path: Path, length_s: float = 2.0, topics: dict[str, str] | None = None) -> tuple[list[Log], Log]:
    """Pieces in their windows, and the whole of them."""
    pieces = in_windows(read_pieces(path, topics, length_s), length_s)
    return pieces, join(pieces)


def reasons(log: Log) -> dict[tuple[str, str], int]:
    return {(row.source, row.reason): row.count for row in log.left_out}


class TestOrder:
    def test_a_row_that_comes_a_little_late_is_put_in_order_across_the_edge(self, save: Save) -> None:
        fixes = [nav_sat(k) for k in range(300)]
        for k in (19, 20, 40, 100):  # the windows end at rows 20, 40, 60 ...
            fixes[k] = fixes[k]._replace(log_time=stamp(k) + 900_000_000)
        by_arrival = sorted([*LONG_IMU, *fixes], key=lambda m: m.log_time)
        pieces, whole = read(save(by_arrival, **SMALL))
        assert whole.left_out == ()
        assert whole.gnss is not None
        assert whole.gnss.t_ns.tolist() == [stamp(k) for k in range(300)]
        assert [len(piece.gnss) for piece in pieces if piece.gnss is not None] == [20] * 15
        assert_same(whole, read_log(save(by_arrival, **SMALL)))

    def test_a_row_that_comes_after_its_window_was_given_out_is_counted(self, save: Save) -> None:
        """Stamps 15 s behind those of the IMU: nobody waits that long."""
        behind = [twist(k, "body")._replace(log_time=stamp(k + 150)) for k in range(150)]
        path = save(sorted([*LONG_IMU, *behind], key=lambda m: m.log_time), **SMALL)
        _, whole = read(path)
        assert len(imu_of(whole)) == 3000
        assert set(reasons(whole)) == {("/twist", LATE)}
        assert len(whole.wheel or ()) + reasons(whole)["/twist", LATE] == 150
        assert read_log(path).left_out == ()

    def test_a_row_far_behind_those_of_its_own_topic_is_counted(self, save: Save) -> None:
        wheel = [twist(k, "body") for k in range(0, 300, 10)]
        wheel[3] = wheel[3]._replace(log_time=stamp(200) + 1)
        path = save(sorted([*LONG_IMU, *wheel], key=lambda m: m.log_time), **SMALL)
        assert reasons(read(path)[1]) == {("/twist", "stamp jumps away from its arrival"): 1}
        wheel[3] = wheel[3]._replace(log_time=stamp(120) + 1)
        path = save(sorted([*LONG_IMU, *wheel], key=lambda m: m.log_time), **SMALL)
        assert reasons(read(path)[1]) == {("/twist", "stamp goes back"): 1}

    def test_what_repeats_across_an_edge_is_counted(self, save: Save) -> None:
        sent = list(LONG_IMU)
        for k in (200, 400, 401):
            sent[k] = stamped(sent[k], START_NS + (k - 1) * 10_000_000)
        sent.insert(600, sent[599]._replace(log_time=sent[599].log_time + 1))
        _, whole = read(save(sent, **SMALL))
        assert reasons(whole) == {("/imu", "stamp repeats"): 3}
        assert_same(whole, read_log(save(sent, **SMALL)))

    @pytest.mark.parametrize("at", [195, 199, 200, 201, 1000])
    @pytest.mark.parametrize("by_s", [-3, 5, 8000])
    def test_a_stamp_that_strays_at_an_edge_costs_one_row(self, save: Save, at: int, by_s: int) -> None:
        sent = list(LONG_IMU)
        sent[at] = stamped(sent[at], START_NS + at * 10_000_000 + by_s * SECOND)
        pieces, whole = read(save(sent, **SMALL))
        assert sum(row.count for row in whole.left_out) == 1
        assert len(imu_of(whole)) == 2999
        assert reasons(whole) == reasons(read_log(save(sent, **SMALL)))
        assert sum(len(piece.left_out) for piece in pieces) == 1


class TestClocks:
    def shifted(self, by_ns: int, first: int, last: int | None = None) -> list[Sent]:
        """The IMU's messages, with the stamps of some moved; they are logged when they were."""
        sent = list(LONG_IMU)
        for k in range(*slice(first, last).indices(len(sent))):
            sent[k] = stamped(sent[k], START_NS + k * 10_000_000 + by_ns)
        return sent

    def test_a_clock_that_is_set_ahead_is_followed(self, save: Save) -> None:
        _, whole = read(save(self.shifted(20 * SECOND, 1500), **SMALL))
        t_ns = imu_of(whole).t_ns
        assert t_ns[-1] == START_NS + 2999 * 10_000_000 + 20 * SECOND
        assert len(t_ns) == 3000
        assert whole.left_out == ()

    def test_a_clock_that_is_set_back_loses_the_time_it_repeats(self, save: Save) -> None:
        _, whole = read(save(self.shifted(-5 * SECOND, 1500), **SMALL))
        assert imu_of(whole).t_ns[-1] == START_NS + 2999 * 10_000_000 - 5 * SECOND
        assert sum(row.count for row in whole.left_out) == 500

    def test_a_clock_that_is_set_by_a_day_ends_the_log(self, save: Save) -> None:
        _, whole = read(save(self.shifted(86400 * SECOND, 2000), **SMALL))
        assert len(imu_of(whole)) + sum(row.count for row in whole.left_out) == 3000
        assert imu_of(whole).t_ns[-1] <= START_NS + 20 * SECOND
        assert len(imu_of(whole)) >= 1400

    def test_a_few_seconds_before_the_clock_was_set_do_not_decide(self, save: Save) -> None:
        """Stamps and log times of 1970, then the drive."""
        early = [stamped(m, k * 10_000_000)._replace(log_time=k * 10_000_000) for k, m in enumerate(LONG_IMU[:500])]
        path = save([*early, *LONG_IMU[500:]], **SMALL)
        _, whole = read(path)
        assert imu_of(whole).t_ns[0] == START_NS + 500 * 10_000_000
        assert reasons(whole) == {("/imu", "stamp lies an hour or more apart from most others"): 500}

    @pytest.mark.parametrize("log_time", [0, START_NS])
    def test_log_times_that_tell_nothing(self, save: Save, log_time: int, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("sensors.mcap.reader.MAX_ROWS", 500)
        messages = [
            m._replace(log_time=log_time) for k in range(300) for m in (*LONG_IMU[10 * k : 10 * k + 10], nav_sat(k))
        ]
        pieces, whole = read(save(messages, **SMALL))
        assert len(pieces) == 15
        assert whole.left_out == ()
        assert len(imu_of(whole)) == 3000
        assert len(whole.gnss or ()) == 300

    def test_stamps_and_log_times_on_different_clocks(self, save: Save) -> None:
        boot = [stamped(m, k * 10_000_000) for k, m in enumerate(LONG_IMU)]
        pieces, whole = read(save(boot, **SMALL))
        assert (len(pieces), len(imu_of(whole)), whole.left_out) == (15, 3000, ())


class TestTopics:
    def test_a_topic_that_starts_late_and_one_that_ends_early(self, save: Save) -> None:
        late = [pose(k) for k in range(200, 300)]
        early = [nav_sat(k) for k in range(50)]
        path = save(sorted([*LONG_IMU, *late, *early], key=lambda m: m.log_time), **SMALL)
        pieces, whole = read(path)
        assert [piece.pose_fixes is None for piece in pieces] == [True] * 10 + [False] * 5
        assert [piece.gnss is None for piece in pieces] == [False] * 3 + [True] * 12
        assert_same(whole, read_log(path))
        assert whole.left_out == ()

    def test_a_sensor_that_pauses_blocks_nothing(self, save: Save) -> None:
        imu = [m for k, m in enumerate(LONG_IMU) if not 600 <= k < 2400]
        path = save(sorted([*imu, *(nav_sat(k) for k in range(300))], key=lambda m: m.log_time), **SMALL)
        gone = []
        for piece in read_pieces(path, length_s=2.0):
            gone.append((piece.imu is None, len(piece.gnss or ())))
        assert gone == [(False, 20)] * 3 + [(True, 20)] * 9 + [(False, 20)] * 3

    @pytest.mark.parametrize("kind", ["zstd", "no summary"])
    def test_two_topics_for_a_sensor_one_of_which_comes_late(self, save: Save, kind: str) -> None:
        other = [m._replace(topic="/imu/raw") for m in LONG_IMU[2500:]]
        path = save(sorted([*LONG_IMU, *other], key=lambda m: m.log_time), **SMALL, **VARIANTS[kind])
        got = []
        with pytest.raises(
            EgolocError, match=r"imu: /imu \(sensor_msgs/msg/Imu\) and /imu/raw \(sens.* could all feed"
        ):
            got.extend(read_pieces(path, length_s=2.0))
        assert bool(got) == (kind == "no summary")
        assert len(imu_of(read(path, topics={"imu": "/imu/raw"})[1])) == 500

    def test_a_late_topic_of_another_frame_is_no_conflict(self, save: Save) -> None:
        odometry = [pose(k, frame="odom")._replace(topic="/odom_pose") for k in range(250, 300)]
        path = save(sorted([*LONG_IMU, *(pose(k) for k in range(300)), *odometry], key=lambda m: m.log_time), **SMALL)
        _, whole = read(path)
        assert len(whole.pose_fixes or ()) == 300
        reason = "frame_id 'odom' is not map or world; name it under [topics] if it is"
        assert whole.left_out == (LeftOut("/odom_pose", reason, 50),)
        _, named = read(path, topics={"pose_fixes": "/odom_pose"})
        assert len(named.pose_fixes or ()) == 50

    @pytest.mark.parametrize("kind", ["zstd", "no summary"])
    def test_a_wrong_choice_is_named(self, save: Save, kind: str) -> None:
        path = save(LONG_IMU, **SMALL, **VARIANTS[kind])
        got = []
        with pytest.raises(EgolocError, match=r"topics\.gnss: no topic /nothing; the log has /imu"):
            got.extend(read_pieces(path, {"gnss": "/nothing"}, 2.0))
        assert bool(got) == (kind == "no summary")

    def test_a_velocity_topic_that_comes_late_does_not_replace_that_of_the_fixes(self, save: Save) -> None:
        fixes = [gps(k, speed=10.0) for k in range(300)]
        velocities = [twist(k, "enu") for k in range(250, 300)]
        sent = sorted([*LONG_IMU, *fixes, *velocities], key=lambda m: m.log_time)
        _, whole = read(save(sent, **SMALL, **VARIANTS["no summary"]))
        assert len(whole.gnss_velocity or ()) == 300
        assert whole.left_out == (LeftOut("/twist", "gnss_velocity came from /gps before its first message", 50),)
        _, known = read(save(sent, **SMALL))
        assert len(known.gnss_velocity or ()) == 50

    def test_two_sensors_of_one_topic_lose_rows_of_their_own(self, save: Save) -> None:
        bad = [{} if k % 7 else {"speed": np.nan} for k in range(300)]
        fixes = [gps(k, **({"speed": 10.0} | bad[k] | ({} if k % 5 else {"latitude": np.nan}))) for k in range(300)]
        sent = sorted([*LONG_IMU, *fixes], key=lambda m: m.log_time)
        _, whole = read(save(sent, **SMALL))
        assert len(whole.gnss or ()) == 240
        assert len(whole.gnss_velocity or ()) == 257
        assert_same(whole, read_log(save(sent, **SMALL)))
        assert reasons(whole) == reasons(read_log(save(sent, **SMALL)))


@pytest.mark.parametrize("indexed", [True, False])
def test_chunks_of_one_topic_each(tmp_path: Path, indexed: bool) -> None:
    """First all of the IMU, then all of GNSS: with a summary they are read side by side."""
    full = Sent("/camera", "std_msgs/Header", bytes(5000), LONG_IMU[-1].log_time)  # the chunk is full
    options = {} if indexed else VARIANTS["unindexed"]
    sent = [*LONG_IMU, full, *(nav_sat(k) for k in range(300))]
    (tmp_path / "a.mcap").write_bytes(mcap_bytes(sent, **SMALL, **options))
    pieces, whole = read(tmp_path / "a.mcap")
    assert len(imu_of(whole)) == 3000
    if indexed:
        assert [len(piece.gnss or ()) for piece in pieces] == [20] * 15
        assert whole.left_out == ()
    else:
        assert len(whole.gnss or ()) + reasons(whole)["/fix", LATE] == 300


def test_a_log_cut_in_the_middle(tmp_path: Path) -> None:
    log = full_log(20_000)
    write_log(tmp_path / "a.mcap", log)
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(data[: len(data) // 2])
    pieces, whole = read(tmp_path / "a.mcap", 10.0)
    assert len(pieces) > 3
    assert [row.reason for piece in pieces[:-1] for row in piece.left_out] == []
    assert "the file is truncated: it has no end marker" in {row.reason for row in pieces[-1].left_out}
    assert_same(whole, read_log(tmp_path / "a.mcap"))
    assert whole.vehicle == log.vehicle
    n = len(imu_of(whole))
    np.testing.assert_array_equal(imu_of(whole).gyro, imu_of(log).gyro[:n])
    assert 8000 < n < 12_000


def test_a_damaged_chunk_is_counted_in_the_piece_it_would_belong_to(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", replace(full_log(20_000), wheel=None), "none")
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    pieces, whole = read(tmp_path / "a.mcap", 10.0)
    told = [k for k, piece in enumerate(pieces) if piece.left_out]
    assert [len(pieces[k].left_out) for k in told] == [1]
    assert 0 < told[0] < len(pieces) - 1
    assert_same(whole, read_log(tmp_path / "a.mcap"))


@pytest.mark.parametrize("indexed", [True, False])
def test_metadata_behind_the_rows(tmp_path: Path, log: Log, indexed: bool) -> None:
    """A summary names it; without one it comes too late."""
    text = msgspec.json.encode(Facts(log.vehicle, log.map_frame))
    with (tmp_path / "b.mcap").open("wb") as stream:
        options: dict[str, Any] = SMALL if indexed else SMALL | VARIANTS["no summary"]
        writer = Writer(stream, **options)
        stream_of(writer, LONG_IMU)
        writer.add_metadata("egoloc", {"json": text.decode(), "crc32": f"{zlib.crc32(text):08x}"})
        writer.finish()
    pieces = list(read_pieces(tmp_path / "b.mcap", length_s=2.0))
    assert {piece.vehicle for piece in pieces} == {log.vehicle if indexed else Log().vehicle}
    late = LeftOut("b.mcap", "metadata egoloc comes behind rows in use", 1)
    assert (late in pieces[-1].left_out) == (not indexed)
    assert read_log(tmp_path / "b.mcap").vehicle == log.vehicle


def stream_of(writer: Any, messages: list[Sent]) -> None:
    writer.start("ros2", "test")
    schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", schema_text("sensor_msgs/Imu").encode())
    channel = writer.register_channel("/imu", "cdr", schema)
    for m in messages:
        assert isinstance(m.value, bytes)
        writer.add_message(channel, m.log_time, m.value, m.log_time)


def test_a_length_must_be_positive(tmp_path: Path, log: Log) -> None:
    write_log(tmp_path / "a.mcap", log)
    for length_s in (0.0, -1.0):
        with pytest.raises(EgolocError, match=r"length of a piece: expected more than 0 s, got"):
            read_pieces(tmp_path / "a.mcap", length_s=length_s)


ORIGINALS = {
    kind: mcap_bytes(
        [m for k in range(60) for m in (*LONG_IMU[10 * k : 10 * k + 10], nav_sat(k), twist(k, "body"))],
        chunk_size=20_000,
        **VARIANTS[kind],
    )
    for kind in ("zstd", "none", "no summary", "unchunked")
}


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damage_never_crashes_nor_breaks_the_order_of_pieces(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    kind = data.draw(st.sampled_from(sorted(ORIGINALS)))
    damaged = bytearray(ORIGINALS[kind])
    rng = random.Random(data.draw(st.integers(0, 1 << 30)))
    for _ in range(data.draw(st.integers(0, 30))):
        damaged[rng.randrange(8, len(damaged))] ^= rng.randrange(1, 256)
    path = tmp_path_factory.getbasetemp() / "damaged.mcap"
    path.write_bytes(damaged[: data.draw(st.integers(len(damaged) // 2, len(damaged)))])
    last: dict[str, int] = {}
    try:
        for piece in read_pieces(path, length_s=data.draw(st.sampled_from([0.3, 1.0]))):
            for name in SENSORS:
                record = getattr(piece, name)
                if record is not None:
                    assert record.t_ns[0] > last.get(name, -(1 << 62))
                    last[name] = int(record.t_ns[-1])
    except EgolocError as error:
        if "\n" in str(error):
            raise AssertionError("expected one line") from error


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 1000),
    length_s=st.sampled_from([0.4, 1.7, 5.0]),
    kind=st.sampled_from(["lz4", "no summary", "unchunked"]),
)
def test_delays_losses_and_repeats_are_judged_as_in_the_whole_log(
    tmp_path_factory: pytest.TempPathFactory, seed: int, length_s: float, kind: str
) -> None:
    """Fixes that come up to 0.9 s late, samples that are missing, repeat or go back a little."""
    rng = np.random.default_rng(seed)
    imu = [m for m in LONG_IMU[:2400] if rng.random() < 0.97]
    for k in rng.integers(1, len(imu), 40).tolist():
        back = imu[k - 1 - int(rng.integers(0, min(k, 3)))].value
        imu[k] = imu[k]._replace(value=back)
    delay = rng.uniform(0, 0.9, 240) * (rng.random(240) < 0.2)
    fixes = [nav_sat(k)._replace(log_time=stamp(k) + int(d * SECOND)) for k, d in enumerate(delay)]
    fixes = [m for m in fixes if rng.random() < 0.9]
    path = tmp_path_factory.getbasetemp() / "jitter.mcap"
    path.write_bytes(mcap_bytes(sorted([*imu, *fixes], key=lambda m: m.log_time), chunk_size=20_000, **VARIANTS[kind]))
    _, whole = read(path, length_s)
    once = read_log(path)
    assert_same(whole, once)
    assert reasons(whole) == reasons(once)
