"""What `egoloc info` says of a log, whatever its length."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replay.inventory import Inventory, file_inventory, inventory, print_inventory
from sensors.mcap.io import write_log
from sensors.pieces import cut
from sensors.records import Imu, LeftOut, Log, Tags
from tests.sensors.mcap.messages import START_NS, full_log, imu_messages, mcap_bytes

SECOND = 10**9


def tagged() -> Log:
    """A minute with every record, scenes that change, and a gap in the IMU."""
    log = full_log(6000)
    t_ns = START_NS + np.array([0, 10, 20, 30]) * SECOND
    text = np.array(["city", "canyon,night", "", "tunnel, night"])
    keep = np.ones(6000, bool)
    keep[1000:1500] = False
    assert log.imu is not None
    mode = Tags(t_ns[1:2], t_ns[1:2], np.array(["autonomous"]))
    left_out = (LeftOut("/imu", "stamp repeats", 3),)
    return replace(log, imu=log.imu[keep], scene=Tags(t_ns, t_ns, text), mode=mode, left_out=left_out)


def test_pieces_are_counted_as_the_whole() -> None:
    log = tagged()
    whole = inventory(log, "x")
    for length_s in (0.5, 7.0, 90.0):
        assert inventory(cut(log, length_s), "x") == whole
    assert whole["sensors"]["imu"] == {
        "count": 5500,
        "rate_hz": 100.0,
        "span_s": 59.99,
        "gaps": 1,
        "longest_gap_s": 5.01,
    }
    assert whole["left_out"] == [{"source": "/imu", "reason": "stamp repeats", "count": 3}]
    json.dumps(whole)


def test_tags_are_told_by_how_long_they_held() -> None:
    found = inventory(tagged(), "x")
    assert found["scene_s"] == {
        "canyon": 10.0,
        "city": 10.0,
        "night": pytest.approx(39.99),
        "tunnel": pytest.approx(29.99),
    }
    assert found["mode_s"] == {"autonomous": pytest.approx(49.99)}
    assert found["sensors"]["scene"] == {"count": 4, "rate_hz": None, "span_s": 30.0, "gaps": 0, "longest_gap_s": None}


def test_a_file_is_described_with_its_tag_topics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(tmp_path / "a.mcap", tagged())
    found = file_inventory(tmp_path / "a.mcap", {})
    assert {topic["name"]: topic["sensors"] for topic in found["topics"]} == {
        "/imu": ["imu"],
        "/gnss/fix": ["gnss"],
        "/gnss/velocity": ["gnss_velocity"],
        "/egovm/pose": ["pose_fixes"],
        "/wheel/speed": ["wheel"],
        "/reference": ["reference"],
        "/scene": ["scene"],
        "/drive_mode": ["mode"],
    }
    assert found["sensors"] == inventory(replace(tagged(), left_out=()), "")["sensors"]
    print_inventory(found)
    text = capsys.readouterr().out
    assert "Scene: canyon 10.0 s, city 10.0 s, night 40.0 s, tunnel 30.0 s" in text
    assert "Drive mode: autonomous 50.0 s" in text


def test_two_topics_for_a_sensor_are_said(tmp_path: Path) -> None:
    sent: Any = [*imu_messages(5), *imu_messages(5, topic="/imu/raw")]
    (tmp_path / "a.mcap").write_bytes(mcap_bytes(sent))
    found = file_inventory(tmp_path / "a.mcap", {})
    assert found["remarks"][0].startswith(f"Not to be replayed as it is: {tmp_path / 'a.mcap'}: imu: /imu (sensor_msgs")
    assert found["sensors"] == {}
    assert [topic["count"] for topic in found["topics"]] == [5, 5]


def test_watching_passes_the_pieces_on() -> None:
    counted, pieces = Inventory(), list(cut(tagged(), 10.0))
    assert list(counted.watch(iter(pieces))) == pieces
    assert counted.found("x") == inventory(tagged(), "x")


def test_nothing_at_all() -> None:
    found = inventory(Log(), "x")
    assert (found["duration_s"], found["start_utc"], found["sensors"], found["scene_s"]) == (0.0, None, {}, {})
    assert found["remarks"] == ["It cannot be replayed: expected IMU samples (sensor_msgs/msg/Imu), found none."]
    one = Imu(np.array([START_NS]), np.array([START_NS]), np.zeros((1, 3)), np.zeros((1, 3)))
    assert inventory(Log(imu=one), "x")["sensors"]["imu"]["rate_hz"] is None
