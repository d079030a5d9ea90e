"""Chunks that hold nothing of use are passed over by the summary's index, unread."""

from collections.abc import Callable
from pathlib import Path

import pytest

from sensors.mcap import container
from sensors.mcap.io import describe, read_log, read_pieces
from tests.sensors.mcap.messages import START_NS, VARIANTS, Sent, gyro_of, imu_messages, imu_of, mcap_bytes

Save = Callable[..., Path]
COUNT = 20


def with_camera() -> list[Sent]:
    """Ten IMU samples, then a picture that fills chunks of its own, and so on."""
    imu = imu_messages(10 * COUNT)
    picture = bytes(range(256)) * 80
    sent = []
    for k in range(COUNT):
        sent += imu[10 * k : 10 * k + 10]
        time = START_NS + (k + 1) * 100_000_000 - 5_000_000
        sent += [Sent("/camera", "std_msgs/Header", picture, time + n) for n in (0, 1)]
    return sent


@pytest.fixture
def unpacked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the chunks that were decompressed."""
    sizes: list[int] = []
    original = container.decompress

    def counted(data: memoryview, chunk: container.ChunkHeader) -> container.Bytes:
        sizes.append(chunk.size)
        return original(data, chunk)

    monkeypatch.setattr(container, "decompress", counted)
    return sizes


@pytest.mark.parametrize("kind", ["zstd", "none"])
def test_pictures_are_not_unpacked(save: Save, unpacked: list[int], kind: str) -> None:
    sent = with_camera()
    path = save(sent, chunk_size=15_000, **VARIANTS[kind])
    log = read_log(path)
    assert imu_of(log).gyro.tolist() == gyro_of([m for m in sent if m.topic == "/imu"]).tolist()
    assert log.left_out == ()
    assert len(unpacked) == COUNT
    total = len(container.read_summary(memoryview(path.read_bytes())).chunks)
    assert total == 2 * COUNT  # a picture with the samples before it, and one alone
    assert sum(unpacked) < 0.6 * sum(len(m.value) for m in sent if isinstance(m.value, bytes))


@pytest.mark.parametrize("kind", ["unindexed", "no summary"])
def test_without_an_index_everything_is_read(save: Save, unpacked: list[int], kind: str) -> None:
    sent = with_camera()
    log = read_log(save(sent, chunk_size=15_000, **VARIANTS[kind]))
    assert len(imu_of(log)) == 10 * COUNT
    assert len(unpacked) == 2 * COUNT


def test_damage_in_what_is_passed_over_is_not_noticed(save: Save) -> None:
    path = save(with_camera(), chunk_size=15_000, **VARIANTS["none"])
    data = bytearray(path.read_bytes())
    entries = container.read_summary(memoryview(bytes(data))).chunks
    for number in (1, 2):
        data[entries[number].start + 500] ^= 1
    path.write_bytes(data)
    log = read_log(path)
    assert [row.reason for row in log.left_out] == ["chunk fails its checksum"]
    assert len(imu_of(log)) == 10 * COUNT - 10


def test_describe_counts_them_by_their_message_indexes(save: Save, unpacked: list[int]) -> None:
    path = save(with_camera(), chunk_size=15_000)
    camera = next(topic for topic in describe(path).topics if topic.name == "/camera")
    assert (camera.count, camera.first_ns) == (2 * COUNT, START_NS + 95_000_000)
    assert camera.last_ns == START_NS + COUNT * 100_000_000 - 5_000_000 + 1
    assert len(unpacked) == COUNT


def test_a_damaged_message_index_is_said(save: Save) -> None:
    path = save(with_camera(), chunk_size=15_000)
    data = bytearray(path.read_bytes())
    place = next(iter(container.read_summary(memoryview(bytes(data))).chunks[1].indexes.values()))
    data[place] = container.METADATA
    path.write_bytes(data)
    found = describe(path)
    assert next(topic.count for topic in found.topics if topic.name == "/camera") == 2 * COUNT - 1
    assert [row.reason for row in found.left_out] == ["the message index of a chunk is damaged"]


def test_a_channel_that_the_summary_does_not_name_is_looked_for(save: Save, unpacked: list[int]) -> None:
    path = save(with_camera(), chunk_size=15_000, repeat_channels=False)
    assert len(imu_of(read_log(path))) == 10 * COUNT
    assert len(unpacked) == 2 * COUNT


def test_pieces_go_on_over_what_is_passed_over(save: Save) -> None:
    """The IMU stops for a minute in which there are only pictures."""
    first, second = imu_messages(100), [m for k, m in enumerate(imu_messages(7100)) if k >= 7000]
    pictures = [Sent("/camera", "std_msgs/Header", bytes(20_000), START_NS + k * 10**9 + 1) for k in range(1, 71)]
    path = save(sorted([*first, *pictures, *second], key=lambda m: m.log_time), chunk_size=15_000)
    pieces = list(read_pieces(path, length_s=10.0))
    assert [len(imu_of(piece)) for piece in pieces] == [100, 100]


def test_the_first_message_of_a_late_topic_is_looked_for_once(tmp_path: Path, unpacked: list[int]) -> None:
    imu = imu_messages(3000)
    other = [m._replace(topic="/imu/raw") for m in imu[2990:]]
    (tmp_path / "a.mcap").write_bytes(mcap_bytes([*imu, *other], chunk_size=4000))
    chunks = len(container.read_summary(memoryview((tmp_path / "a.mcap").read_bytes())).chunks)
    pieces = list(read_pieces(tmp_path / "a.mcap", {"imu": "/imu/raw"}, length_s=2.0))
    assert sum(len(imu_of(piece)) for piece in pieces) == 10
    assert len(unpacked) < 6 < chunks
