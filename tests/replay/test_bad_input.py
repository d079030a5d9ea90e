"""Bad logs through the command line: one clear line and exit code 2, or the rest is replayed and the loss counted."""

import os
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sensors.mcap.io import write_log
from sensors.records import Log
from tests.replay.spoiling import SECOND, Edit, both, logged, moved, silent, stamps, value, write
from tests.sensors.mcap.messages import Sent, encode, imu_messages, mcap_bytes

HOUR = 3600 * SECOND
DAY = 24 * HOUR
GNSS, IMU, POSE, WHEEL, REFERENCE = "/gnss/fix", "/imu", "/egovm/pose", "/wheel/speed", "/reference"


class TestFiles:
    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (None, "cannot be read: No such file or directory"),
            (b"", "the file is empty, expected an MCAP log"),
            (b"\0\0\0\x20ftypisom" + bytes(99), "not an MCAP file, its first bytes are 00 00 00 20 66 74 79 70"),
            (b"PK\x03\x04" + bytes(99), "not an MCAP file, its first bytes are 50 4b 03 04"),
            (b"hello\n", "not an MCAP file"),
            (
                b"\x89MCAP0\r\n",
                "expected IMU samples (sensor_msgs/msg/Imu), found none; left out: 1 of a.mcap: the file",
            ),
        ],
    )
    def test_foreign(self, content: bytes | None, reason: str, at: Any, replayed: Any) -> None:
        path = at("a.mcap")
        if content is not None:
            path.write_bytes(content)
        assert f"{path}: {reason}" in replayed(path).refused()

    def test_folders_and_devices(self, at: Any, replayed: Any) -> None:
        at("a.mcap").mkdir()
        os.mkfifo(at("b.mcap"))  # must not be waited for
        assert "a.mcap: expected an MCAP log, got a folder" in replayed(at("a.mcap")).refused()
        assert "b.mcap: expected an MCAP log, got no file" in replayed(at("b.mcap")).refused()

    def test_no_permission(self, at: Any, replayed: Any) -> None:
        at("a.mcap").write_bytes(b"\x89MCAP0\r\n")
        at("a.mcap").chmod(0)
        if os.access(at("a.mcap"), os.R_OK):
            pytest.skip("this user may read everything")
        assert "a.mcap: cannot be read: Permission denied" in replayed(at("a.mcap")).refused()

    def test_truncated(self, short_log: Log, at: Any, replayed: Any) -> None:
        write_log(at("whole.mcap"), short_log)
        data = at("whole.mcap").read_bytes()
        at("cut.mcap").write_bytes(data[: len(data) // 2])
        done = replayed(at("cut.mcap"))
        assert done.left_out()["cut.mcap", "the file is truncated: it has no end marker"] == 1
        assert 20 < done.metrics["duration_s"] < 40
        assert done.metrics["methods"]["fusion"]["lat"]["rmse"] < 0.1
        at("stub.mcap").write_bytes(data[:1000])
        assert "stub.mcap: expected IMU samples" in replayed(at("stub.mcap")).refused()


class TestTopics:
    @pytest.mark.parametrize(
        ("head", "reason"),
        [
            (b"\0\0", "300 of /imu: big-endian CDR (header 00 00), expected little-endian CDR (00 01)"),
            (b"\0\7", "300 of /imu: XCDR2 (header 00 07), expected little-endian CDR (00 01)"),
        ],
    )
    def test_other_serializations(self, head: bytes, reason: str, at: Any, replayed: Any) -> None:
        sent = [m._replace(value=head + encode(m.schema, m.value)[2:]) for m in imu_messages(300)]  # type: ignore[arg-type]
        at("a.mcap").write_bytes(mcap_bytes(sent))
        assert f"a.mcap: expected IMU samples (sensor_msgs/msg/Imu), found none; left out: {reason}" in (
            replayed(at("a.mcap")).refused()
        )

    def test_schemas_that_cannot_be_used(self, at: Any, replayed: Any) -> None:
        sent = imu_messages(30)
        at("a.mcap").write_bytes(mcap_bytes(sent, {"sensor_msgs/Imu": "Foo bar"}))
        assert "30 of /imu: schema sensor_msgs/Imu: type sensor_msgs/Foo" in replayed(at("a.mcap")).refused()
        at("a.mcap").write_bytes(mcap_bytes(sent, encoding="json"))
        assert "got json with ros2msg" in replayed(at("a.mcap")).refused()
        chat = [Sent("/chat", "std_msgs/String", b"\0\1\0\0\2\0\0\0a\0", sent[0].log_time)]
        at("a.mcap").write_bytes(mcap_bytes(chat, {"std_msgs/String": "string data"}))
        assert "a.mcap: expected IMU samples" in replayed(at("a.mcap")).refused()

    def test_a_frame_that_is_no_map(self, short_log: Log, at: Any, replayed: Any) -> None:
        odom: Edit = lambda m: replace(m, texts={**m.texts, "header.frame_id": "odom"})  # noqa: E731
        done = replayed(write(at("a.mcap"), short_log, {"/reference": odom}))
        assert list(done.left_out().values()) == [6001]
        assert "/reference: frame_id 'odom' is not map or world; name it under [topics] if it is." in done.text
        assert done.metrics["methods"]["fusion"]["ar"] is None

    @pytest.mark.parametrize("topic", [GNSS, POSE, WHEEL])
    def test_no_messages(self, topic: str, short_log: Log, at: Any, replayed: Any) -> None:
        assert replayed(write(at("a.mcap"), short_log, {topic: silent})).left_out() == {(topic, "no messages"): 0}


NULL_ISLAND = both(
    value("latitude", 0.0, 100, 150), value("longitude", 0.0, 100, 150), value("altitude", 0.0, 100, 150)
)
INDEFINITE = both(value("pose.covariance[1]", 5.0, 100, 150), value("pose.covariance[6]", 5.0, 100, 150))


@pytest.mark.parametrize(
    ("topic", "edit", "reason", "count"),
    [
        (IMU, value("angular_velocity.x", np.nan, 2000, 2100), "angular_velocity is not finite", 100),
        (IMU, value("linear_acceleration.z", 1e6, 2000, 2001), "linear_acceleration is beyond 1000 m/s^2", 1),
        (IMU, value("angular_velocity.z", 1e300, 2000, 2100), "angular_velocity is beyond 100 rad/s", 100),
        (GNSS, value("latitude", np.inf, 100, 150), "latitude, longitude or altitude is not finite", 50),
        (GNSS, value("latitude", 95.0, 100, 150), "latitude or longitude is out of range", 50),
        (GNSS, value("latitude", 90.0, 100, 150), "latitude or longitude is out of range", 50),
        (GNSS, value("altitude", -7e6, 100, 150), "altitude is beyond 100000 m", 50),
        (GNSS, NULL_ISLAND, "latitude and longitude are both zero", 50),
        (GNSS, value("position_covariance[0]", 0.0, 100, 150), "position_covariance is not positive definite", 50),
        (GNSS, value("position_covariance[8]", np.nan, 100, 150), "position_covariance is not finite", 50),
        ("/gnss/velocity", value("twist.twist.linear.x", 1e300, 100, 150), "twist.linear is beyond 1000 m/s", 50),
        (POSE, value("pose.pose.position.x", 1e300, 100, 150), "pose.position is beyond 2e+07 m", 50),
        (POSE, value("pose.pose.orientation.w", np.nan, 100, 150), "pose.orientation is not a unit quaternion", 50),
        (POSE, INDEFINITE, "pose.covariance of x, y, yaw is not positive definite", 50),
        (WHEEL, value("twist.twist.linear.x", -np.inf, 100, 150), "twist.linear.x is not finite", 50),
        (WHEEL, value("twist.covariance[0]", 0.0, 100, 150), "twist.covariance[0] is not positive", 50),
        (REFERENCE, value("pose.pose.position.x", 1e300, 2000, 2001), "pose.position is beyond 2e+07 m", 1),
        (IMU, moved(HOUR, 2000, 2001), "stamp jumps away from its arrival", 1),
        (IMU, moved(5 * SECOND, 2000, 2001), "stamp runs ahead of those that follow", 1),
        (IMU, moved(-SECOND // 100, 2000, 2001), "stamp repeats", 1),
        (IMU, moved(-5 * SECOND, 2000, 2001), "stamp goes back", 1),
        (IMU, stamps(lambda t: t // 20_000_000 * 20_000_000), "stamp repeats", 3000),
        (GNSS, moved(-HOUR, 200, 201), "stamp jumps away from its arrival", 1),
    ],
)
def test_bad_rows_are_left_out_and_the_rest_is_replayed(
    topic: str, edit: Edit, reason: str, count: int, short_log: Log, at: Any, replayed: Any
) -> None:
    done = replayed(write(at("a.mcap"), short_log, {topic: edit}))
    assert {key: n for key, n in done.left_out().items() if not key[1].startswith("gap over")} == {
        (topic, reason): count
    }
    assert done.warnings() == []
    assert done.metrics["methods"]["fusion"]["lat"]["rmse"] < 0.05


class TestStamps:
    @pytest.mark.parametrize(
        "edit",
        [
            moved(-1_715_673_600 * SECOND),  # the first sample of the drive becomes 1970
            stamps(lambda t: t - (1 << 32) * SECOND + 2_500_000_000 * SECOND),  # 2103 in unsigned seconds
            logged(lambda t: t * 0),
            logged(lambda t: np.full_like(t, t[0])),
        ],
    )
    def test_any_epoch_and_useless_log_times(self, edit: Edit, short_log: Log, at: Any, replayed: Any) -> None:
        done = replayed(write(at("a.mcap"), short_log, {"*": edit}))
        assert done.left_out() == {}
        assert done.metrics["methods"]["fusion"]["lat"]["rmse"] < 0.05

    def test_a_clock_that_is_set_by_100_s(self, short_log: Log, at: Any, replayed: Any) -> None:
        later = stamps(lambda t: np.where(t > t[0] + 35 * SECOND, t + 100 * SECOND, t))
        done = replayed(write(at("a.mcap"), short_log, {"*": later}))
        assert done.left_out()[IMU, "stamp jumps away from its arrival"] == 2500
        assert done.metrics["duration_s"] == pytest.approx(35.0, abs=0.2)
        assert done.metrics["methods"]["fusion"]["lat"]["rmse"] < 0.05

    def test_a_clock_that_is_set_by_half_a_century(self, short_log: Log, at: Any, replayed: Any) -> None:
        early: Any = lambda t: np.where(t < t[0] + 5 * SECOND, t - 1_700_000_000 * SECOND, t)  # noqa: E731
        done = replayed(write(at("a.mcap"), short_log, {"*": both(stamps(early), logged(early))}))
        assert done.left_out()[IMU, "stamp lies an hour or more apart from most others"] == 500
        assert done.metrics["span_s"] == pytest.approx(55.0, abs=0.2)

    @pytest.mark.parametrize("edit", [stamps(lambda t: t * 0), stamps(lambda t: t[::-1].copy())])
    def test_stamps_without_any_order(self, edit: Edit, short_log: Log, at: Any, replayed: Any) -> None:
        error = replayed(write(at("a.mcap"), short_log, {IMU: edit})).refused()
        assert "a.mcap: expected IMU samples (sensor_msgs/msg/Imu), found 1; left out: 6000 of /imu: stamp " in error

    @pytest.mark.parametrize("options", [[], ["--hide-gnss", "10:2"]])
    @pytest.mark.parametrize("shift", [DAY, -DAY])
    def test_clocks_that_do_not_overlap(
        self, shift: int, options: list[str], short_log: Log, at: Any, replayed: Any
    ) -> None:
        bare = Log(imu=short_log.imu, gnss=short_log.gnss)
        error = replayed(write(at("a.mcap"), bare, {GNSS: both(moved(shift), logged(lambda t: t + shift))}), *options)
        assert (
            "a.mcap: expected positions while the IMU runs (from 2024-05-14 08:00:00 to 2024-05-14 08:01:00), "
            f"found GNSS fixes from 2024-05-{15 if shift > 0 else 13} 08:00:00"
        ) in error.refused()
