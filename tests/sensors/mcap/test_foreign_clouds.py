"""PointCloud2 topics of other recorders: field layouts, time conventions, transforms, several LiDARs, mistakes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.mcap.frames import FrameReader, read_frames
from sensors.mcap.lidar_summary import lidar_topics
from sensors.mcap.point_time import offsets
from tests.sensors.mcap.clouds import cloud_value, points_of, pose, transform_value
from tests.sensors.mcap.messages import START_NS, Sent, imu_messages

XYZ = [[1.0, 2.0, 3.0], [-4.0, 5.5, 0.25], [7.0, 8.0, -9.0]]
OFFSETS = np.array([0, 12_345_678, 99_000_000])
Save = Callable[..., Path]


def cloud(points: Any, t_ns: int = START_NS, topic: str = "/points", log_time: int | None = None, **other: Any) -> Sent:
    value = cloud_value(points, t_ns, **other)
    return Sent(topic, "sensor_msgs/PointCloud2", value, t_ns + 50_000_000 if log_time is None else log_time)


def static(*transforms: dict[str, Any], log_time: int = START_NS, topic: str = "/tf_static") -> Sent:
    return Sent(topic, "tf2_msgs/TFMessage", {"transforms": list(transforms)}, log_time)


def only(path: Path, **options: Any) -> Frame:
    (frame,) = read_frames(path, **options)
    return frame


@pytest.mark.parametrize(
    ("name", "kind", "values", "within_ns"),
    [
        ("t", "u4", OFFSETS, 0),  # Ouster
        ("time", "f4", OFFSETS * 1e-9, 4),  # Velodyne
        ("time", "f4", OFFSETS * 1e-9 - 0.1, 8),  # Velodyne, stamped at the end
        ("timestamp", "f8", (START_NS + OFFSETS) * 1e-9, 250),  # Hesai, Robosense
        ("timestamp", "f8", (START_NS + OFFSETS).astype(np.float64), 150),  # livox_ros_driver2
        ("offset_time", "u4", OFFSETS, 0),  # Livox's own points
        ("time_stamp", "u4", OFFSETS, 0),  # Autoware
        ("time_offset", "f8", OFFSETS * 1e-9, 1),
    ],
)
def test_times_of_every_driver(save: Save, name: str, kind: str, values: Any, within_ns: int) -> None:
    sweep = only(save([cloud(points_of(XYZ, **{name: (kind, values)}))])).sweeps[0]
    expected = OFFSETS - (100_000_000 if values[0] == -0.1 else 0)
    assert np.abs(sweep.offset_ns - expected).max() <= within_ns
    np.testing.assert_array_equal(sweep.xyz, np.float32(XYZ))


def test_unsigned_64_bit_times_are_exact() -> None:
    stamps = np.array([START_NS + 1, START_NS - 3], np.uint64)
    assert offsets("timestamp", stamps, START_NS).tolist() == [1, -3]


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (("f4", [0.0, 50_000.0, 99_000.0]), "field t: expected times within 2 s of the stamp"),  # microseconds
        (("f8", (START_NS + OFFSETS) * 1e-9 + 3600.0), "expected times within 2 s of the stamp"),
        (("u4", [0, 1, 2_100_000_000]), "expected times within 2 s"),
        (("f4", [0.0, np.nan, 0.1]), "field t: expected finite times"),
    ],
)
def test_times_that_cannot_be(save: Save, values: Any, told: str) -> None:
    path = save([cloud(points_of(XYZ, t=values))])
    with pytest.raises(EgolocError, match=told) as raised:
        list(read_frames(path))
    assert str(raised.value).startswith(f"{path}: /points: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["ring", "channel", "line"])
@pytest.mark.parametrize("kind", ["u1", "u2", "i2", "i4"])
def test_rings_and_any_layout(save: Save, name: str, kind: str) -> None:
    """Fields in any order with gaps between them, float64 coordinates, arrays of numbers, rows with padding."""
    layout = {
        "names": ["z", name, "rgb", "x", "intensity", "y"],
        "formats": ["<f8", f"<{kind}", ("<f4", 3), "<f8", "u1", "<f8"],
    }
    points = np.zeros(6, np.dtype(layout | {"offsets": [40, 3, 6, 24, 18, 32], "itemsize": 50}))
    xyz = np.arange(18.0).reshape(6, 3) + 1.0
    for k, axis in enumerate("xyz"):
        points[axis] = xyz[:, k]
    points[name], points["intensity"] = range(6), range(250, 256)
    sweep = only(save([cloud(points, rows=2, pad=7)])).sweeps[0]
    np.testing.assert_array_equal(sweep.xyz, xyz.astype(np.float32))
    assert sweep.ring.tolist() == [0, 1, 2, 3, 4, 5]
    assert sweep.intensity.tolist() == [250, 251, 252, 253, 254, 255]
    assert not sweep.offset_ns.any()


def test_points_that_are_none_are_counted(save: Save) -> None:
    xyz = [[1, 2, 3], [np.nan, 0, 0], [0, 0, 0], [np.inf, 1, 1], [4, 5, 6]]
    times = [0.0, np.nan, np.nan, 0.0, 0.05]  # of points that are none they may be anything
    reader = FrameReader(save([cloud(points_of(xyz, time=("f4", times), ring=("u2", [5, 9, 9, 9, 65535])))]))
    (frame,) = reader.frames()
    assert frame.sweeps[0].xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert frame.sweeps[0].ring.tolist() == [5, -1]
    assert np.isnan(frame.sweeps[0].intensity).all()
    assert {(entry.source, entry.count) for entry in reader.left_out} == {("/points", 2), ("/points", 1)}


def test_a_chain_of_transforms_wherever_it_is_recorded(save: Save) -> None:
    """base_link -> mount -> lidar, in messages of two publishers, one of them behind the clouds."""
    mount, lidar = pose(1), pose(2)
    other = np.eye(4)
    path = save(
        [
            static(transform_value("mount", "lidar", lidar)),
            cloud(points_of(XYZ), frame="/lidar"),
            static(transform_value("base_link", "mount", mount), transform_value("odom", "base_link", other)),
            *imu_messages(20),
        ]
    )
    np.testing.assert_allclose(only(path).sweeps[0].T_body_lidar, mount @ lidar, atol=1e-12)
    assert lidar_topics(path)[0].place == pytest.approx((mount @ lidar)[:3, 3])


@pytest.mark.parametrize("frame", ["lidar", "nowhere"])
def test_without_a_chain_the_lidar_is_the_body(save: Save, frame: str, caplog: pytest.LogCaptureFixture) -> None:
    path = save([static(transform_value("mount", "lidar", pose(2))), cloud(points_of(XYZ), frame=frame)])
    np.testing.assert_array_equal(only(path).sweeps[0].T_body_lidar, np.eye(4))
    assert f"no /tf_static leads from base_link to '{frame}'" in caplog.text
    assert lidar_topics(path)[0].place is None


def test_a_cloud_in_body_axes_needs_no_transform(save: Save, caplog: pytest.LogCaptureFixture) -> None:
    assert (only(save([cloud(points_of(XYZ), frame="base_link")])).sweeps[0].T_body_lidar == np.eye(4)).all()
    assert caplog.text == ""


def test_lidars_that_turn_together_make_one_frame(save: Save) -> None:
    """The right one is stamped 40 ms later and comes first; offsets are from the left one's stamp."""
    sent = []
    for k in range(4):
        t = START_NS + k * 100_000_000
        right = cloud(points_of(XYZ, t=("u4", OFFSETS)), t + 40_000_000, "/right", t + 60_000_000)
        left = cloud(points_of(XYZ[:2], t=("u4", OFFSETS[:2])), t, "/left", t + 70_000_000)
        sent += [right, left]
    path = save(sent)
    found = list(read_frames(path))
    assert [(f.t_ns - START_NS, f.arrival_ns - START_NS) for f in found] == [
        (k * 100_000_000, k * 100_000_000 + 70_000_000) for k in range(4)
    ]
    for frame in found:
        right, left = frame.sweeps
        assert (len(right), len(left)) == (3, 2)
        np.testing.assert_array_equal(right.offset_ns, OFFSETS + 40_000_000)
        np.testing.assert_array_equal(left.offset_ns, OFFSETS[:2])
    assert [len(f.sweeps) for f in read_frames(path, ["/left"])] == [1, 1, 1, 1]


def test_lidars_that_turn_apart_make_frames_of_their_own(save: Save) -> None:
    sent = [cloud(points_of(XYZ), START_NS + k * 60_000_000, ("/a", "/b")[k % 2]) for k in range(6)]
    assert [f.t_ns - START_NS for f in read_frames(save(sent))] == [k * 60_000_000 for k in range(6)]


def test_stamps_that_repeat_or_come_late(save: Save) -> None:
    steps = [0, 100, 100, 400, 50, 500]
    reader = FrameReader(
        save([cloud(points_of(XYZ), START_NS + ms * 10**6, log_time=START_NS + k) for k, ms in enumerate(steps)])
    )
    assert [(f.t_ns - START_NS) // 10**6 for f in reader.frames()] == [0, 100, 400, 500]
    reasons = {entry.reason: entry.count for entry in reader.left_out}
    assert reasons == {"sweeps with the stamp of another": 1, "sweeps that came over 0.2 s late": 1}


def test_clouds_in_world_axes_are_no_sweeps(save: Save) -> None:
    path = save([cloud(points_of(XYZ), topic="/map_cloud", frame="map"), cloud(points_of(XYZ[:1]), START_NS + 1)])
    reader = FrameReader(path)
    assert [len(f.sweeps[0]) for f in reader.frames()] == [1]
    assert [(entry.source, entry.count) for entry in reader.left_out] == [("/map_cloud", 1)]
    assert len(only(path, topic="/map_cloud").sweeps[0]) == 3


@pytest.mark.parametrize(
    ("other", "told"),
    [
        ({"is_bigendian": True}, "is_bigendian: expected little-endian points"),
        ({"fields": []}, "field x: expected x, y, z as float32 or float64, got no fields"),
        ({"fields": [{"name": a, "offset": 0, "datatype": 4, "count": 1} for a in "xyz"]}, "field x: expected x, y, z"),
    ],
)
def test_clouds_that_cannot_be_understood(save: Save, other: dict[str, Any], told: str) -> None:
    path = save([cloud(points_of(XYZ), **other)])
    with pytest.raises(EgolocError, match=f"^{path}: /points: {told}"):
        list(read_frames(path))
    assert lidar_topics(path)[0].problem.startswith(told[:20])


@pytest.mark.parametrize(
    "other",
    [
        {"width": 4},
        {"height": 1 << 20},
        {"width": (1 << 32) - 1, "height": (1 << 32) - 1},
        {"point_step": 11},
        {"row_step": 5, "height": 3, "width": 1},
        {"header": {"stamp": {"sec": 1, "nanosec": 10**9}, "frame_id": "lidar"}},
    ],
)
def test_clouds_that_do_not_hold_what_they_say(save: Save, other: dict[str, Any]) -> None:
    reader = FrameReader(save([cloud(points_of(XYZ), **other), cloud(points_of(XYZ), START_NS + 10**8)]))
    assert [f.t_ns for f in reader.frames()] == [START_NS + 10**8]
    assert [(entry.source, entry.count) for entry in reader.left_out] == [("/points", 1)]


def test_messages_cut_off_anywhere(save: Save) -> None:
    from tests.sensors.mcap.messages import encode

    data = encode("sensor_msgs/PointCloud2", cloud_value(points_of(XYZ), START_NS))
    sent = [Sent("/points", "sensor_msgs/PointCloud2", data[:n], START_NS + n) for n in range(len(data) - 1)]
    big = bytes([0, 0]) + data[2:]
    reader = FrameReader(save([*sent, Sent("/points", "sensor_msgs/PointCloud2", big, START_NS)]))
    assert list(reader.frames()) == []
    counts = {entry.reason: entry.count for entry in reader.left_out}
    assert sum(counts.values()) == len(sent) + 1
    assert any("big-endian CDR" in reason for reason in counts)


def test_topics_that_are_not_there(save: Save) -> None:
    path = save([cloud(points_of(XYZ)), *imu_messages(3)])
    with pytest.raises(EgolocError, match=r"topics.lidar: no topic /lidar; the log has /imu, /points"):
        list(read_frames(path, "/lidar"))
    with pytest.raises(EgolocError, match=r"topics.lidar: /imu has schema sensor_msgs/msg/Imu, expected sensor_msgs/P"):
        list(read_frames(path, "/points, /imu"))
    with pytest.raises(EgolocError, match=r"topics.lidar: expected topics, with commas between several, got '/a,,/b'"):
        list(read_frames(path, "/a,,/b"))


def test_ros1_messages_are_refused(save: Save) -> None:
    path = save([cloud(points_of(XYZ))], encoding="ros1")
    with pytest.raises(EgolocError, match="/points: expected cdr messages, got ros1"):
        list(read_frames(path))


def test_an_unchunked_file_without_summary(save: Save) -> None:
    sent = [cloud(points_of(XYZ), START_NS + k * 10**8) for k in range(10)]
    mount = static(transform_value("base_link", "lidar", pose(3)), log_time=START_NS + 2 * 10**9)
    path = save([*sent, *imu_messages(30), mount], use_chunking=False, use_summary_offsets=False, use_statistics=False,
                repeat_channels=False, repeat_schemas=False)  # fmt: skip
    found = list(read_frames(path))
    assert len(found) == 10
    np.testing.assert_allclose(found[0].sweeps[0].T_body_lidar, pose(3), atol=1e-12)
    assert lidar_topics(path)[0].points == 3
