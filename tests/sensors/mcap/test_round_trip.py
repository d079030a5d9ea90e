"""write_log and read_log: every record comes back, and other readers see what we wrote."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from sensors.errors import EgolocError
from sensors.mcap.io import read_log, write_log
from sensors.records import GnssVelocity, Imu, Log
from tests.sensors.mcap.messages import START_NS, full_log

RECORDS = ("imu", "gnss", "gnss_velocity", "pose_fixes", "wheel", "reference")
# through degrees, or through a quaternion of yaw; everything else is exact
ROUNDED = {("gnss", "llh"): 1e-15, ("gnss", "yaw"): 2e-15, ("gnss", "yaw_sigma"): 1e-15, ("pose_fixes", "pose"): 2e-15}


def columns(log: Log) -> Iterator[tuple[str, str, Any]]:
    for name in RECORDS:
        record = getattr(log, name)
        if record is not None:
            for field in fields(record):
                yield name, field.name, getattr(record, field.name)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_every_record_comes_back(log: Log, tmp_path: Path, compression: Any) -> None:
    path = tmp_path / "new folder" / "a.mcap"
    write_log(path, log, compression)
    again = read_log(path)
    assert again.left_out == ()
    assert (again.vehicle, again.map_frame) == (log.vehicle, log.map_frame)
    assert [p.name for p in path.parent.iterdir()] == ["a.mcap"]
    found = {(name, field): column for name, field, column in columns(again)}
    assert set(found) == {(name, field) for name, field, _ in columns(log)}
    for name, field, column in columns(log):
        if tolerance := ROUNDED.get((name, field)):
            np.testing.assert_allclose(
                found[name, field], column, rtol=0, atol=tolerance * max(1, np.nanmax(np.abs(column)))
            )
        else:
            np.testing.assert_array_equal(found[name, field], column, err_msg=f"{name}.{field}", strict=True)


def test_many_chunks_come_back(tmp_path: Path) -> None:
    log = Log(imu=full_log(20_000).imu)
    assert log.imu is not None
    write_log(tmp_path / "a.mcap", log)
    again = read_log(tmp_path / "a.mcap").imu
    assert again is not None
    np.testing.assert_array_equal(again.gyro, log.imu.gyro)
    np.testing.assert_array_equal(again.t_ns, log.imu.t_ns)


def test_mcap_ros2_reads_what_we_write(log: Log, tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", log)
    decoded = defaultdict(list)
    times = []
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        for item in reader.iter_decoded_messages(log_time_order=False):
            decoded[item.channel.topic].append(item.decoded_message)
            times.append(item.message.log_time)
    assert times == sorted(times)
    assert log.imu is not None
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    assert log.pose_fixes is not None
    assert log.wheel is not None
    assert log.reference is not None
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(times) == sum(len(getattr(log, name)) for name in RECORDS)
    assert {s.name for s in summary.schemas.values()} >= {"sensor_msgs/msg/Imu", "gps_msgs/msg/GPSFix"}
    imu, fix = decoded["/imu"], decoded["/gnss/fix"]
    assert [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in imu] == log.imu.t_ns.tolist()
    gyro = [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in imu]
    assert gyro == log.imu.gyro.tolist()
    assert imu[0].orientation_covariance[0] == -1
    assert [m.status.status for m in fix[:5]] == [-1, 0, 18, 20, 19]
    assert [list(m.position_covariance) for m in fix] == log.gnss.cov_enu.reshape(-1, 9).tolist()
    assert np.isnan(fix[0].dip)
    assert fix[1].dip == pytest.approx((90 - np.degrees(log.gnss.yaw[1])) % 360)
    velocity, pose = decoded["/gnss/velocity"], decoded["/egovm/pose"]
    assert (velocity[0].header.frame_id, pose[0].header.frame_id) == ("enu", "map")
    assert velocity[3].twist.covariance[1] == log.gnss_velocity.cov_enu[3, 0, 1]
    assert pose[3].pose.covariance[5] == log.pose_fixes.cov[3, 0, 2]
    assert pose[3].pose.covariance[35] == log.pose_fixes.cov[3, 2, 2]
    assert decoded["/wheel/speed"][7].twist.twist.linear.x == log.wheel.speed[7]
    reference = decoded["/reference"]
    assert (reference[0].header.frame_id, reference[0].child_frame_id) == ("map", "body")
    assert reference[0].pose.pose.orientation.w == 0.0
    assert reference[1].pose.pose.orientation.w == log.reference.q_map_body[1, 3]


def test_late_fixes_keep_stamp_and_arrival(log: Log, tmp_path: Path) -> None:
    assert log.pose_fixes is not None
    arrival = log.pose_fixes.arrival_ns.copy()
    arrival[3] += 250_000_000
    late = replace(log.pose_fixes, arrival_ns=arrival)
    write_log(tmp_path / "a.mcap", replace(log, pose_fixes=late))
    again = read_log(tmp_path / "a.mcap")
    assert again.left_out == ()
    assert again.pose_fixes is not None
    np.testing.assert_array_equal(again.pose_fixes.t_ns, late.t_ns)
    np.testing.assert_array_equal(again.pose_fixes.arrival_ns, arrival)


def test_an_empty_log_comes_back_empty(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", Log())
    again = read_log(tmp_path / "a.mcap")
    assert again.left_out == ()
    assert all(getattr(again, name) is None for name in RECORDS)


def test_a_file_is_replaced_whole_or_not_at_all(log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    write_log(path, Log(imu=log.imu))
    before = path.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sensors.mcap.writer.ChunkWriter.finish", fail)
    with pytest.raises(EgolocError, match=r"a\.mcap: cannot be written: No space left on device"):
        write_log(path, log)
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_what_cannot_be_written_is_named(log: Log, tmp_path: Path) -> None:
    one = np.array([START_NS])
    zero = np.zeros((1, 3))
    with pytest.raises(EgolocError, match=r"/imu: t_ns: expected stamps before 2038"):
        write_log(tmp_path / "a.mcap", Log(imu=Imu(one * 3, one, zero, zero)))
    with pytest.raises(EgolocError, match=r"/gnss/velocity: arrival_ns: expected times since 1970"):
        write_log(tmp_path / "a.mcap", Log(gnss_velocity=GnssVelocity(one, -one, zero, np.eye(3)[None])))
    with pytest.raises(EgolocError, match=r"compression: expected zstd, lz4 or none, got 'gzip'"):
        write_log(tmp_path / "a.mcap", log, "gzip")  # type: ignore[arg-type]
    (tmp_path / "folder").mkdir()
    with pytest.raises(EgolocError, match="folder: cannot be written"):
        write_log(tmp_path / "folder", log)
