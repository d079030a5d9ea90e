"""Modes of pose fixes on a topic of their own: they come back, and the fixes stay what every tool reads."""

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from sensors.errors import EgolocError
from sensors.mcap.io import describe, read_log, read_pieces, write_log
from sensors.records import LeftOut, Log, PoseFix
from tests.sensors.mcap.messages import Sent, encode, full_log, header, mcap_bytes, pose, stamp


@pytest.fixture
def log() -> Log:
    """Every fourth fix with two modes, every tenth with one."""
    log = full_log(4000)
    fixes = log.pose_fixes
    assert fixes is not None
    modes, weights = np.full((len(fixes), 2, 3), np.nan), np.zeros((len(fixes), 2))
    modes[::10, 0], weights[::10, 0] = fixes.pose[::10], 0.95
    modes[::4, 0], modes[::4, 1] = fixes.pose[::4], fixes.pose[::4] + np.array([3.0, -2.0, 0.0])
    modes[::4, 1, 2] = -0.5 * fixes.pose[::4, 2]
    weights[::4] = [0.6, 0.3]
    return replace(log, pose_fixes=replace(fixes, modes=modes, weights=weights))


def fixes_of(log: Log) -> PoseFix:
    assert log.pose_fixes is not None
    return log.pose_fixes


def same(one: PoseFix, other: PoseFix) -> None:
    for name in ("t_ns", "arrival_ns", "cov", "weights"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_allclose(one.modes, other.modes, rtol=0, atol=1e-12)


def test_modes_come_back(log: Log, tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", log)
    again = read_log(tmp_path / "a.mcap")
    assert again.left_out == ()
    same(fixes_of(again), fixes_of(log))


def test_modes_come_back_in_pieces_and_late_ones_too(log: Log, tmp_path: Path) -> None:
    arrival = fixes_of(log).arrival_ns.copy()
    arrival[8] += 700_000_000
    log = replace(log, pose_fixes=replace(fixes_of(log), arrival_ns=arrival))
    write_log(tmp_path / "a.mcap", log)
    parts = [piece for piece in read_pieces(tmp_path / "a.mcap", length_s=1.7) if piece.pose_fixes is not None]
    assert len(parts) > 10
    assert all(piece.left_out == () for piece in parts)
    found = fixes_of(parts[0]).weights, *(fixes_of(piece).weights for piece in parts[1:])
    np.testing.assert_array_equal(np.concatenate(found), fixes_of(log).weights)


def test_a_log_without_modes_is_written_as_before(log: Log, tmp_path: Path) -> None:
    plain = replace(log, pose_fixes=replace(fixes_of(log), modes=None, weights=None))
    write_log(tmp_path / "a.mcap", plain)
    assert {topic.name for topic in describe(tmp_path / "a.mcap").topics} == {
        "/imu", "/gnss/fix", "/gnss/velocity", "/egovm/pose", "/wheel/speed", "/reference",
    }  # fmt: skip
    assert not fixes_of(read_log(tmp_path / "a.mcap")).weights.any()


def test_other_tools_read_the_fixes_as_before_and_the_modes_as_well(log: Log, tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", log)
    decoded: dict[str, list[Any]] = defaultdict(list)
    with (tmp_path / "a.mcap").open("rb") as stream:
        for item in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            decoded[item.channel.topic].append(item.decoded_message)
    fixes, told = fixes_of(log), fixes_of(log).weights.any(axis=1)
    assert len(decoded["/egovm/pose"]) == len(fixes)
    assert decoded["/egovm/pose"][4].pose.pose.position.x == fixes.pose[4, 0]
    assert len(decoded["/egovm/modes"]) == told.sum()
    first = decoded["/egovm/modes"][0]
    assert first.header.frame_id == "map"
    assert list(first.modes) == fixes.modes[0].ravel().tolist()
    assert list(first.weights) == [0.6, 0.3]


def test_what_info_says_of_modes(log: Log, tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", log)
    summary = describe(tmp_path / "a.mcap")
    told = int(fixes_of(log).weights.any(axis=1).sum())
    assert summary.rows["pose_modes"] == told
    topic = next(topic for topic in summary.topics if topic.name == "/egovm/modes")
    assert (topic.sensors, topic.note, topic.count) == (("pose_modes",), "", told)


def modes_message(k: int, modes: list[float], weights: list[float], topic: str = "/egovm/modes") -> Sent:
    value = {"header": header(stamp(k), "map"), "modes": modes, "weights": weights}
    return Sent(topic, "egoloc_msgs/PoseModes", encode("egoloc_msgs/PoseModes", value), stamp(k))


TWO = [1.0, 2.0, 0.1, 7.0, 2.0, 0.1]


def test_modes_without_a_fix_and_senseless_ones_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sent = [*(pose(k) for k in range(6)), modes_message(1, TWO, [0.7, 0.3])]
    sent += [modes_message(2, TWO, [0.3, 0.7]), modes_message(3, TWO[:3] + [np.nan] * 3, [0.7, 0.3])]
    sent += [modes_message(4, TWO[:3] + [np.nan] * 3, [0.7, 0.0]), modes_message(9, TWO, [0.7, 0.3])]
    path.write_bytes(mcap_bytes(sorted(sent, key=lambda message: message.log_time)))
    log = read_log(path)
    assert fixes_of(log).weights.tolist() == [[0, 0], [0.7, 0.3], [0, 0], [0, 0], [0.7, 0], [0, 0]]
    assert fixes_of(log).modes[1].ravel().tolist() == pytest.approx(TWO)
    assert set(log.left_out) == {
        LeftOut("/egovm/modes", "no pose fix has this stamp", 1),
        LeftOut("/egovm/modes", "weights are no falling masses of modes", 1),
        LeftOut("/egovm/modes", "modes is not finite", 1),
    }


def test_two_topics_of_modes_must_be_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sent = [pose(0), modes_message(0, TWO, [0.7, 0.3]), modes_message(0, TWO, [0.6, 0.4], "/other")]
    path.write_bytes(mcap_bytes(sent))
    with pytest.raises(EgolocError, match=r"pose_modes: /egovm/modes .* and /other .* could all feed it"):
        read_log(path)
    assert fixes_of(read_log(path, {"pose_modes": "/other"})).weights.tolist() == [[0.6, 0.4]]
