"""Which topic feeds which sensor, and what describe says of it."""

import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import Writer

from sensors.errors import EgolocError
from sensors.mcap.io import describe, read_log, write_log
from sensors.mcap.schemas import schema_text
from sensors.records import GnssStatus, LeftOut, Log
from tests.sensors.mcap.messages import (
    COV,
    START_NS,
    Sent,
    encode,
    gps,
    imu_messages,
    imu_value,
    nav_sat,
    pose,
    stamp,
    twist,
)

Save = Callable[..., Path]


def test_a_velocity_topic_comes_before_gps_fix(save: Save) -> None:
    log = read_log(save([gps(0, speed=10.0), twist(0, "enu")]))
    assert log.gnss_velocity is not None
    assert log.gnss_velocity.vel_enu.tolist() == [[3, 4, 5]]
    log = read_log(save([gps(0, speed=10.0), twist(0, "enu")]), {"gnss_velocity": "/gps"})
    assert log.gnss_velocity is not None
    assert log.gnss_velocity.vel_enu.tolist() == [[0, 10, 0]]


@pytest.mark.parametrize(
    ("frame", "sensor"), [("enu", "gnss_velocity"), ("/map", "gnss_velocity"), ("base_link", "wheel")]
)
def test_a_twist_is_what_its_frame_says(save: Save, frame: str, sensor: str) -> None:
    log = read_log(save([twist(0, frame)]))
    assert [name for name in ("gnss_velocity", "wheel") if getattr(log, name) is not None] == [sensor]
    if log.wheel is not None:
        assert (log.wheel.speed.tolist(), log.wheel.sigma.tolist()) == ([3], [2])
    elif log.gnss_velocity is not None:
        assert log.gnss_velocity.cov_enu.ravel().tolist() == list(COV)


def test_a_twist_of_another_frame_is_ignored_unless_named(save: Save) -> None:
    path = save([twist(0, "camera"), twist(1, "camera")])
    assert read_log(path).wheel is None
    note = describe(path).topics[0].note
    assert note.startswith("frame_id 'camera' is neither enu/map/world (GNSS velocity) nor base_footprint/")
    log = read_log(path, {"wheel": "/twist"})
    assert log.wheel is not None
    assert log.gnss_velocity is None
    assert len(log.wheel) == 2


def test_rows_of_another_frame_are_left_out(save: Save) -> None:
    log = read_log(save([twist(0, "enu"), twist(1, "ens"), twist(2, "enu"), twist(3, "base_link"), twist(4, "enu")]))
    assert log.gnss_velocity is not None
    assert log.gnss_velocity.t_ns.tolist() == [stamp(k) for k in (0, 2, 4)]
    assert log.left_out == (LeftOut("/twist", "header.frame_id is not that of the first message", 2),)


def test_odometry_of_another_frame_is_ignored_unless_named(save: Save) -> None:
    path = save([pose(0, frame="odom", odometry=True)])
    assert read_log(path).reference is None
    assert describe(path).topics[0].note == "frame_id 'odom' is not map or world; name it under [topics] if it is"
    assert read_log(path, {"reference": "/odom"}).reference is not None
    fixes = read_log(path, {"pose_fixes": "/odom"})
    assert fixes.pose_fixes is not None
    assert fixes.reference is None


def test_two_candidates_are_both_listed(save: Save) -> None:
    path = save([*imu_messages(5), *imu_messages(5, topic="/imu/raw"), nav_sat(0), gps(0)])
    both = r"foreign\.mcap: imu: /imu \(sensor_msgs/msg/Imu\) and /imu/raw \(sensor_msgs/msg/Imu\) could all feed it"
    with pytest.raises(EgolocError, match=both):
        read_log(path)
    both = (
        r"gnss: /fix \(sensor_msgs/msg/NavSatFix\) and /gps \(gps_msgs/msg/GPSFix\) could all feed it; name one under"
    )
    with pytest.raises(EgolocError, match=both):
        read_log(path, {"imu": "/imu"})
    log = read_log(path, {"imu": "/imu/raw", "gnss": "/gps"})
    assert log.imu is not None
    assert log.gnss is not None
    assert log.gnss.status.tolist() == [GnssStatus.FIXED]
    notes = {topic.name: (topic.sensors, topic.note) for topic in describe(path, {"gnss": "/fix"}).topics}
    assert notes["/imu"] == ((), "imu: /imu/raw could feed it too; name one under [topics]")
    assert notes["/fix"] == (("gnss",), "")
    assert notes["/gps"] == ((), "gnss comes from /fix")


@pytest.mark.parametrize(
    ("topics", "expected"),
    [
        ({"imu": "/nothing"}, r"topics\.imu: no topic /nothing; the log has /fix, /imu"),
        ({"imu": "/fix"}, r"topics\.imu: /fix has schema sensor_msgs/msg/NavSatFix, expected one of sensor_msgs/Imu"),
        ({"sonar": "/imu"}, r"topics\.sonar: no such sensor, expected one of imu, gnss, gnss_velocity,"),
    ],
)
def test_a_wrong_choice_is_named(save: Save, topics: dict[str, str], expected: str) -> None:
    with pytest.raises(EgolocError, match=expected):
        read_log(save([*imu_messages(2), nav_sat(0)]), topics)


def test_unreadable_schemas_are_named(save: Save) -> None:
    path = save(imu_messages(2), texts={"sensor_msgs/Imu": schema_text("sensor_msgs/Imu").replace("accel", "axel")})
    assert read_log(path).imu is None
    expected = "schema sensor_msgs/Imu: expected a number at linear_acceleration.x"
    assert describe(path).topics[0].note == expected
    with pytest.raises(EgolocError, match=expected):
        read_log(path, {"imu": "/imu"})
    path = save(imu_messages(2), encoding="json")
    with pytest.raises(EgolocError, match="expected cdr messages with a ros2msg schema, got json with ros2msg"):
        read_log(path, {"imu": "/imu"})


def test_a_topic_without_messages_is_said(tmp_path: Path, log: Log) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start("ros2", "test")
        schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", schema_text("sensor_msgs/Imu").encode())
        writer.register_channel("/imu", "cdr", schema)
        writer.finish()
    assert read_log(path).imu is None
    assert read_log(path, {"imu": "/imu"}).left_out == (LeftOut("/imu", "no messages", 0),)
    assert describe(path).topics[0].note == "no messages"


def test_several_channels_of_one_topic_are_one(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", schema_text("sensor_msgs/Imu").encode())
        channels = [writer.register_channel("/imu", "cdr", schema, {"publisher": str(k)}) for k in range(2)]
        for k in range(10):
            value = imu_value(stamp(k), (k, 0, 0), (0, 0, 9.8))
            writer.add_message(channels[k % 2], stamp(k), encode("sensor_msgs/Imu", value), stamp(k))
        writer.finish()
    log = read_log(path)
    assert log.imu is not None
    assert log.imu.gyro[:, 0].tolist() == list(range(10))


def test_metadata_of_others(tmp_path: Path, log: Log) -> None:
    def read(text: str) -> Log:
        with (tmp_path / "a.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start("ros2", "test")
            writer.add_metadata("other", {"a": "b"})
            writer.add_metadata("egoloc", {"json": text, "crc32": f"{zlib.crc32(text.encode()):08x}"})
            writer.finish()
        return read_log(tmp_path / "a.mcap")

    assert read('{"vehicle": {"gnss_delay_s": 0.25}}').vehicle.gnss_delay_s == 0.25
    with pytest.raises(EgolocError, match=r"a\.mcap: metadata egoloc: .*lever.*\$\.vehicle"):
        read('{"vehicle": {"lever": 1}}')
    with pytest.raises(EgolocError, match=r"a\.mcap: metadata egoloc: .*zone: expected 1\.\.60"):
        read('{"map_frame": {"kind": "utm", "zone": 61}}')


def test_describe(tmp_path: Path, log: Log) -> None:
    write_log(tmp_path / "a.mcap", log)
    found = describe(tmp_path / "a.mcap")
    assert (found.complete, found.indexed, found.bytes_lost, found.compressions) == (True, True, 0, ("zstd",))
    assert found.rows["imu"] == 400
    assert (found.vehicle, found.map_frame, found.left_out) == (log.vehicle, log.map_frame, ())
    topics = {topic.name: topic for topic in found.topics}
    imu, fix = topics["/imu"], topics["/gnss/fix"]
    assert (imu.schema, imu.encoding, imu.count, imu.sensors) == ("sensor_msgs/msg/Imu", "cdr", 400, ("imu",))
    assert (imu.first_ns, imu.last_ns) == (START_NS, START_NS + 399 * 10_000_000)
    assert (imu.median_rate_hz, imu.longest_gap_s) == (100.0, 0.01)
    assert (fix.median_rate_hz, fix.sensors) == (10.0, ("gnss",))


def test_describe_what_feeds_nothing(save: Save) -> None:
    messages = [m for k, m in enumerate(imu_messages(20)) if not 5 <= k < 10]
    camera = Sent("/camera", "std_msgs/Header", b"anything", START_NS)
    found = describe(save([*messages, camera, camera._replace(log_time=START_NS + 500_000_000)]))
    imu, picture = found.topics
    assert imu.longest_gap_s == 0.06
    assert (picture.count, picture.stamped, picture.median_rate_hz) == (2, False, 2.0)
    assert picture.note == "schema std_msgs/msg/Header feeds no sensor"
