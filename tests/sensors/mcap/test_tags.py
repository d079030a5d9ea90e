"""Scene tags and drive modes in MCAP: both ways, by name only, and what is no tag."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from sensors.errors import EgolocError
from sensors.mcap.io import describe, read_log, read_pieces, write_log
from sensors.mcap.tags import MAX_TEXT, NOT_TEXT, TOO_LONG
from sensors.records import LeftOut, Log, Tags
from tests.sensors.mcap.messages import START_NS, Sent, full_log, imu_messages, mcap_bytes, stamp

Save = Callable[..., Path]
STRING = "std_msgs/String"
TEXTS = ["canyon", "canyon,night", "", "canyon", "tunnel", "Straße, 隧道", "x" * MAX_TEXT]


def tags(texts: list[str], step_ns: int = 500_000_000) -> Tags:
    t_ns = START_NS + np.arange(len(texts), dtype=np.int64) * step_ns
    return Tags(t_ns, t_ns, np.array(texts))


def said(text: str | bytes, k: int, topic: str = "/scene") -> Sent:
    data = text if isinstance(text, bytes) else text.encode()
    return Sent(topic, STRING, b"\0\1\0\0" + struct.pack("<I", len(data) + 1) + data + b"\0", stamp(k))


def texts_of(log: Log) -> list[str]:
    assert log.scene is not None
    found: list[str] = log.scene.text.tolist()
    return found


def test_tags_come_back(tmp_path: Path) -> None:
    log = replace(full_log(), scene=tags(TEXTS), mode=tags(["open-loop", "autonomous"]))
    write_log(tmp_path / "a.mcap", log)
    again = read_log(tmp_path / "a.mcap")
    assert again.left_out == ()
    assert texts_of(again) == TEXTS
    assert again.mode is not None
    assert again.mode.text.tolist() == ["open-loop", "autonomous"]
    assert log.scene is not None
    assert again.scene is not None
    np.testing.assert_array_equal(again.scene.t_ns, log.scene.t_ns)
    np.testing.assert_array_equal(again.scene.arrival_ns, log.scene.t_ns)
    pieces = list(read_pieces(tmp_path / "a.mcap", length_s=1.0))
    assert [text for piece in pieces if piece.scene is not None for text in texts_of(piece)] == TEXTS
    assert [len(piece.scene or ()) for piece in pieces] == [2, 2, 2, 1]


def test_other_readers_see_strings(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", Log(scene=tags(TEXTS)))
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = [
            (item.channel.topic, item.message.log_time, item.message.sequence, item.decoded_message.data)
            for item in reader.iter_decoded_messages()
        ]
    assert found == [("/scene", START_NS + k * 500_000_000, k, text) for k, text in enumerate(TEXTS)]


def test_strings_of_other_names_are_nothing_unless_named(save: Save) -> None:
    path = save([*imu_messages(3), said("canyon", 0, "/chatter"), said("tunnel", 1, "/chatter")])
    log = read_log(path)
    assert (log.scene, log.mode, log.left_out) == (None, None, ())
    assert texts_of(read_log(path, {"scene": "/chatter"})) == ["canyon", "tunnel"]
    topics = {topic.name: topic for topic in describe(path).topics}
    assert (topics["/chatter"].count, topics["/chatter"].sensors) == (2, ())
    note = "strings are tags on /scene and /drive_mode or where they are named under [topics]"
    assert topics["/chatter"].note == note
    assert describe(path).left_out == ()
    assert describe(path, {"mode": "/chatter"}).rows == {"imu": 3, "mode": 2}


def test_a_named_topic_takes_the_place_of_the_usual_one(save: Save) -> None:
    log = read_log(save([said("a", 0), said("b", 0, "/weather")]), {"scene": "/weather"})
    assert texts_of(log) == ["b"]
    with pytest.raises(
        EgolocError, match=r"topics\.scene: /imu has schema sensor_msgs/msg/Imu, expected one of std_msg"
    ):
        read_log(save(imu_messages(2)), {"scene": "/imu"})


def test_what_is_no_tag_is_left_out(save: Save) -> None:
    sent = [said("a", 0), said(b"\xff\xfe", 1), said("x" * (MAX_TEXT + 1), 2), said("y" * 60_000, 3), said("a\nb", 4)]
    log = read_log(save([*sent, said("ok", 5), said("隧" * MAX_TEXT, 6), said("隧" * 400, 7)]))
    assert texts_of(log) == ["a", "ok", "隧" * MAX_TEXT]
    assert set(log.left_out) == {LeftOut("/scene", TOO_LONG, 3), LeftOut("/scene", NOT_TEXT, 2)}


def test_stamps_are_log_times_and_go_up(save: Save) -> None:
    sent = [said("a", 0), said("b", 2), said("c", 1), said("d", 3), said("e", 3)]
    log = read_log(save(sent))
    assert texts_of(log) == ["a", "c", "b", "d"]
    assert log.left_out == (LeftOut("/scene", "stamp repeats", 1),)


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    for text, why in (("x" * 201, "text is longer than 200 characters"), ("a\tb", "text is not printable UTF-8")):
        with pytest.raises(EgolocError, match=rf"/scene: {why}, got"):
            write_log(tmp_path / "a.mcap", Log(scene=tags([text])))
    with pytest.raises(EgolocError, match=r"/drive_mode: t_ns: expected times since 1970, got -1"):
        write_log(tmp_path / "a.mcap", Log(mode=Tags(np.array([-1]), np.array([-1]), np.array(["open-loop"]))))


@settings(max_examples=40, deadline=None)
@given(payloads=st.lists(st.binary(max_size=300), max_size=12), raw=st.booleans())
def test_any_bytes_are_tags_or_counted(
    tmp_path_factory: pytest.TempPathFactory, payloads: list[bytes], raw: bool
) -> None:
    path = tmp_path_factory.getbasetemp() / "tags.mcap"
    sent = [said(data, k)._replace(value=data) if raw else said(data, k) for k, data in enumerate(payloads)]
    path.write_bytes(mcap_bytes(sent, {STRING: "string data"}))
    log = read_log(path)
    texts = [] if log.scene is None else texts_of(log)
    assert all(text.isprintable() and len(text) <= MAX_TEXT for text in texts)
    assert len(texts) + sum(row.count for row in log.left_out) == len(payloads)
