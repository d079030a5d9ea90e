"""LiDAR frames in logs: what we write comes back, other tools read it, columns beside it are as fast as ever."""

import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from sensors.errors import EgolocError
from sensors.frames import Frame, Sweep
from sensors.mcap.frames import FrameReader, read_frames
from sensors.mcap.io import describe, read_log, write_log
from sensors.mcap.lidar_summary import lidar_topics
from sensors.mcap.sections import Container
from sensors.pieces import cut
from sensors.records import Log
from tests.sensors.mcap.clouds import frames, pose, sweep
from tests.sensors.mcap.messages import START_NS


def assert_same(got: list[Frame], sent: list[Frame]) -> None:
    """All of it to the bit, but for T_body_lidar, which went through a quaternion."""
    assert [(f.t_ns, f.arrival_ns, len(f.sweeps)) for f in got] == [(f.t_ns, f.arrival_ns, len(f.sweeps)) for f in sent]
    for one, other in zip(got, sent, strict=True):
        for a, b in zip(one.sweeps, other.sweeps, strict=True):
            for name in ("xyz", "offset_ns", "intensity", "ring"):
                np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)
            np.testing.assert_allclose(a.T_body_lidar, b.T_body_lidar, rtol=0, atol=1e-14)
            assert a.compensated == b.compensated


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize(("lidars", "compensated"), [(1, False), (3, True)])
def test_frames_come_back(tmp_path: Path, log: Log, compression: str, lidars: int, compensated: bool) -> None:
    sent = frames(5, lidars=lidars, compensated=compensated)
    write_log(tmp_path / "a.mcap", log, compression, sent)  # type: ignore[arg-type]
    assert_same(list(read_frames(tmp_path / "a.mcap")), sent)


def test_a_log_of_frames_alone_and_one_without(tmp_path: Path, log: Log) -> None:
    write_log(tmp_path / "only.mcap", Log(), frames=iter(frames(3)))
    assert_same(list(read_frames(tmp_path / "only.mcap")), frames(3))
    write_log(tmp_path / "none.mcap", log)
    assert list(read_frames(tmp_path / "none.mcap")) == []


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_any_sweep_comes_back(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Points at the origin, unknown rings and intensities, the largest offsets, no points at all."""
    n = data.draw(st.integers(0, 20))
    finite = st.floats(-1e6, 1e6, width=32)
    made = Sweep(
        data.draw(hnp.arrays(np.float32, (n, 3), elements=finite)),
        pose(data.draw(st.integers(0, 99))),
        data.draw(hnp.arrays(np.int32, n, elements=st.integers(-2 * 10**9, 2 * 10**9))),
        data.draw(hnp.arrays(np.float32, n, elements=finite | st.just(np.nan))),
        data.draw(hnp.arrays(np.int16, n, elements=st.integers(-1, 2**15 - 1))),
        data.draw(st.booleans()),
    )
    path = tmp_path_factory.mktemp("any") / "a.mcap"
    sent = [Frame(START_NS, START_NS + data.draw(st.integers(0, 10**9)), (made,))]
    write_log(path, Log(), frames=sent)
    assert_same(list(read_frames(path)), sent)


def test_columns_and_frames_do_not_touch_each_other(tmp_path: Path, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    """The log's messages come back as without frames, cut or whole, and its reader decompresses no chunk of points."""
    plain, beside, pieces = (tmp_path / name for name in ("plain.mcap", "beside.mcap", "pieces.mcap"))
    write_log(plain, log)
    write_log(beside, log, frames=frames(30))
    write_log(pieces, cut(log, 1.0), frames=frames(30))
    assert_same(list(read_frames(pieces)), frames(30))
    read: list[str] = []
    decompressed = Container._decompressed

    def noted(self: Container, chunk: object) -> object:
        read.append(self.path.name)
        return decompressed(self, chunk)  # type: ignore[arg-type]

    monkeypatch.setattr(Container, "_decompressed", noted)
    for path in (beside, pieces):
        found, expected = read_log(path), read_log(plain)
        for sensor in ("imu", "gnss", "pose_fixes", "reference"):
            np.testing.assert_array_equal(getattr(found, sensor).t_ns, getattr(expected, sensor).t_ns)
        np.testing.assert_array_equal(found.imu.gyro, expected.imu.gyro)  # type: ignore[union-attr]
        assert found.left_out == expected.left_out == ()
    assert read.count(beside.name) == read.count(plain.name) / 2  # which was read twice


def test_other_tools_read_the_messages_in_order(tmp_path: Path, log: Log) -> None:
    sent = frames(4, lidars=2)
    write_log(tmp_path / "a.mcap", log, frames=sent)
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages())
    times = [message.log_time for _, _, message, _ in decoded]
    assert times == sorted(times)
    clouds = [(m.log_time, value) for _, channel, m, value in decoded if channel.topic == "/lidar/1/points"]
    assert [log_time for log_time, _ in clouds] == [frame.arrival_ns for frame in sent]
    for frame, (_, cloud) in zip(sent, clouds, strict=True):
        assert cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec == frame.t_ns
        assert (cloud.header.frame_id, cloud.height, cloud.width) == ("lidar_1", 1, 101)
        kinds = [(field.name, field.offset, field.datatype, field.count) for field in cloud.fields]
        assert kinds == [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("intensity", 12, 7, 1), ("ring", 16, 4, 1),
                         ("t", 18, 5, 1)]  # fmt: skip
        assert (cloud.point_step, cloud.row_step, len(cloud.data)) == (22, 22 * 101, 22 * 101)
        points = np.frombuffer(bytes(cloud.data), [("xyz", "<f4", 3), ("i", "<f4"), ("ring", "<u2"), ("t", "<i4")])
        np.testing.assert_array_equal(points["xyz"], frame.sweeps[1].xyz)
        np.testing.assert_array_equal(points["t"], frame.sweeps[1].offset_ns)
    static = [value for _, channel, _, value in decoded if channel.topic == "/tf_static"]
    assert [(t.header.frame_id, t.child_frame_id) for t in static[0].transforms] == [
        ("base_link", "lidar"),
        ("base_link", "lidar_1"),
    ]
    assert static[0].transforms[1].transform.translation.x == sent[0].sweeps[1].T_body_lidar[0, 3]


def test_only_frames_of_a_time_and_a_topic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = frames(100, points=10, lidars=2)
    path = tmp_path / "a.mcap"
    write_log(path, Log(), frames=sent)
    whole = FrameReader(path)
    assert len(list(whole.frames())) == 100
    begin, end = sent[40].t_ns, sent[50].t_ns
    part = FrameReader(path, begin_ns=begin, end_ns=end)
    assert_same(list(part.frames()), sent[40:50])
    assert len(list(read_frames(path, end_ns=begin))) == 40
    assert len(list(read_frames(path, begin_ns=end))) == 50
    second = list(read_frames(path, "/lidar/1/points"))
    assert_same(second, [Frame(f.t_ns, f.arrival_ns, f.sweeps[1:]) for f in sent])
    swapped = list(read_frames(path, "/lidar/1/points, /lidar/points"))
    assert_same(swapped, [Frame(f.t_ns, f.arrival_ns, f.sweeps[::-1]) for f in sent])
    read = []
    decompressed = Container._decompressed
    monkeypatch.setattr(Container, "_decompressed", lambda self, c: read.append(c) or decompressed(self, c))  # type: ignore[func-returns-value]
    list(read_frames(path, "/lidar/points", begin, end))
    assert len(read) < 60  # of 201: those of one LiDAR within 2 s, and /tf_static


def test_frames_are_held_one_at_a_time(tmp_path: Path) -> None:
    alive = most = 0

    def gone() -> None:
        nonlocal alive
        alive -= 1

    def made() -> Iterator[Frame]:
        nonlocal alive, most
        for frame in frames(1):
            for k in range(50):
                one = Frame(frame.t_ns + k * 10**8, frame.arrival_ns + k * 10**8, (sweep(10, k),))
                alive, most = alive + 1, max(most, alive + 1)
                weakref.finalize(one.sweeps[0].xyz, gone)
                yield one
                del one

    write_log(tmp_path / "a.mcap", Log(), frames=made())
    assert most <= 4  # the one being written, the next one, the first with the LiDAR's pose


def test_a_truncated_file_gives_its_whole_frames(tmp_path: Path, log: Log) -> None:
    sent = frames(20, points=2000, lidars=2, compensated=True)
    path = tmp_path / "a.mcap"
    write_log(path, log, frames=sent)
    data = path.read_bytes()
    for part in (0.9, 0.6):
        cut_off = tmp_path / "cut.mcap"
        cut_off.write_bytes(data[: int(len(data) * part)])
        found = list(read_frames(cut_off))
        whole = found[:-1]  # of the last one a sweep may be missing
        assert len(whole) > 5
        assert_same(whole, sent[: len(whole)])
        assert lidar_topics(cut_off)[0].points == 2000


def test_a_damaged_chunk_costs_its_frame_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sent = frames(5, points=1000)
    path = tmp_path / "a.mcap"
    write_log(path, Log(), "none", sent)
    data = bytearray(path.read_bytes())
    at = data.find(sent[2].sweeps[0].xyz[500].tobytes())
    data[at] ^= 0xFF
    path.write_bytes(data)
    assert_same(list(read_frames(path)), sent[:2] + sent[3:])
    assert "chunk fails its checksum" in caplog.text


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (Frame(START_NS, START_NS, (sweep(3, T=pose(0)),)), "t_ns: expected increasing stamps"),
        (
            Frame(START_NS + 10**9, START_NS + 10**9, (sweep(3, T=pose(1)),)),
            "T_body_lidar and compensated of the first",
        ),
        (Frame(START_NS + 10**9, START_NS, (sweep(3, T=pose(0), compensated=True),)), "T_body_lidar and compensated"),
        (Frame(1 << 62, START_NS, (sweep(3, T=pose(0)),)), "t_ns: expected stamps of 1970 to 2038"),
    ],
)
def test_frames_that_a_log_cannot_hold(tmp_path: Path, changed: Frame, told: str) -> None:
    with pytest.raises(EgolocError, match=told):
        write_log(tmp_path / "a.mcap", Log(), frames=[*frames(1), changed])
    assert list(tmp_path.iterdir()) == []


def test_what_a_log_tells_of_its_lidars(tmp_path: Path, log: Log) -> None:
    write_log(tmp_path / "a.mcap", log, frames=frames(20, lidars=2, compensated=True))
    first, second = lidar_topics(tmp_path / "a.mcap")
    assert (first.name, first.points, first.compensated, first.problem) == ("/lidar/points", 100, True, "")
    assert first.fields == ("x", "y", "z", "intensity", "ring", "t")
    assert second.place == pytest.approx(pose(1)[:3, 3])
    told = {topic.name: topic for topic in describe(tmp_path / "a.mcap").topics}
    assert told["/lidar/1/points"].sensors == ("lidar",)
    assert told["/lidar/points"].count == 20
    assert told["/lidar/points"].median_rate_hz == pytest.approx(10.0)
    assert [topic.name for topic in lidar_topics(tmp_path / "a.mcap", "/lidar/1/points")] == ["/lidar/1/points"]
