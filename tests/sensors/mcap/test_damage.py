"""Truncated and damaged files: what is whole and passes its checksum comes back, the rest is counted."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensors.errors import EgolocError
from sensors.mcap import container
from sensors.mcap.io import describe, read_log, write_log
from sensors.records import LeftOut, Log
from tests.sensors.mcap.messages import (
    SMALL,
    VARIANTS,
    full_log,
    gyro_of,
    imu_messages,
    imu_of,
    mcap_bytes,
)

Save = Callable[..., Path]


def truncated(kind: str) -> tuple[bytes, np.ndarray]:
    messages = imu_messages(60)
    return mcap_bytes(messages, **SMALL, **VARIANTS[kind]), gyro_of(messages)


@pytest.mark.parametrize("kind", ["zstd", "lz4", "none", "unchunked"])
def test_a_truncated_file_gives_what_is_whole(tmp_path: Path, kind: str) -> None:
    data, gyro = truncated(kind)
    path = tmp_path / "cut.mcap"
    rows = []
    for size in range(len(data) - 1, 8, -97):
        path.write_bytes(data[:size])
        log = read_log(path)
        rows.append(0 if log.imu is None else len(log.imu))
        assert any("truncated" in row.reason for row in log.left_out) or rows[-1] == len(gyro)
        if log.imu is not None:
            np.testing.assert_array_equal(log.imu.gyro, gyro[: rows[-1]])
    assert rows == sorted(rows, reverse=True)
    assert rows[0] == len(gyro)
    assert rows[-1] == 0


@pytest.mark.parametrize("kind", ["none without checksums", "unchunked"])
def test_whole_messages_of_a_cut_uncompressed_part_are_used(tmp_path: Path, kind: str) -> None:
    data, gyro = truncated(kind)
    # the tenth message's record ends where the eleventh begins
    ends = [at + 9 + struct.unpack_from("<Q", data, at + 1)[0] for at in message_records(data)]
    (tmp_path / "cut.mcap").write_bytes(data[: ends[9] + 100])
    log = read_log(tmp_path / "cut.mcap")
    np.testing.assert_array_equal(imu_of(log).gyro, gyro[:10])
    assert LeftOut("cut.mcap", "bytes that belong to no whole record", 100) in log.left_out
    assert LeftOut("cut.mcap", "the file is truncated: it has no end marker", 1) in log.left_out


def test_a_cut_chunk_that_carries_a_checksum_is_not_used(tmp_path: Path) -> None:
    data, gyro = truncated("none")
    (tmp_path / "cut.mcap").write_bytes(data[: chunk_starts(data)[2] - 1000])
    used = imu_of(read_log(tmp_path / "cut.mcap")).gyro
    np.testing.assert_array_equal(used, gyro[: len(used)])
    (tmp_path / "cut.mcap").write_bytes(data[: chunk_starts(data)[1]])
    assert len(imu_of(read_log(tmp_path / "cut.mcap"))) == len(used)


def message_records(data: bytes) -> list[int]:
    """Offsets of message records in an uncompressed file."""
    found = []
    at = data.find(b"\x05")
    while at >= 0:
        if struct.unpack_from("<QH", data, at + 1)[1:] == (1,) and struct.unpack_from("<Q", data, at + 1)[0] < 1000:
            found.append(at)
        at = data.find(b"\x05", at + 1)
    return found


def chunk_starts(data: bytes) -> tuple[int, ...]:
    return container.read_summary(memoryview(data)).chunk_starts


@pytest.mark.parametrize("kind", ["zstd", "lz4", "none"])
def test_a_chunk_that_fails_its_checksum_is_left_out(tmp_path: Path, kind: str) -> None:
    data, gyro = truncated(kind)
    starts = chunk_starts(data)
    for number in (0, 2):
        broken = bytearray(data)
        header = container.chunk_header(memoryview(data), starts[number] + 9, len(data))
        broken[(header.start + header.stop) // 2] ^= 0x10
        (tmp_path / "a.mcap").write_bytes(broken)
        log = read_log(tmp_path / "a.mcap")
        assert [row.count for row in log.left_out] == [1]
        assert "chunk" in log.left_out[0].reason
        assert 0 < len(imu_of(log)) < len(gyro)
        np.testing.assert_array_equal(imu_of(log).gyro, gyro[np.isin(gyro[:, 0], imu_of(log).gyro[:, 0])])


def test_a_damaged_length_costs_one_chunk(tmp_path: Path) -> None:
    data, gyro = truncated("none")
    starts = chunk_starts(data)
    broken = bytearray(data)
    broken[starts[1] + 7] ^= 1
    (tmp_path / "a.mcap").write_bytes(broken)
    log = read_log(tmp_path / "a.mcap")
    assert len(gyro) - 13 < len(imu_of(log)) < len(gyro)
    assert {row.reason for row in log.left_out} == {
        "damaged stretch between chunks",
        "bytes that belong to no whole record",
    }


def test_a_wrong_data_section_checksum_is_said(save: Save) -> None:
    path = save(imu_messages(20), **VARIANTS["unchunked with checksum"])
    data = bytearray(path.read_bytes())
    data[message_records(bytes(data))[5] + 60] ^= 1
    path.write_bytes(data)
    log = read_log(path)
    assert [row.reason for row in log.left_out] == [
        "the data section fails its checksum, its messages are used unchecked"
    ]


def test_messages_outside_the_chunks_of_a_chunked_file_are_not_trusted(tmp_path: Path) -> None:
    data, gyro = truncated("none")
    first = message_records(data)[0]
    size = 9 + struct.unpack_from("<Q", data, first + 1)[0]
    second_chunk = chunk_starts(data)[1]
    stray = data[:second_chunk] + data[first : first + size] + data[second_chunk:]
    stray = stray[: stray.rfind(b"\x0f" + struct.pack("<Q", 4))]
    (tmp_path / "a.mcap").write_bytes(stray)
    log = read_log(tmp_path / "a.mcap")
    np.testing.assert_array_equal(imu_of(log).gyro, gyro)
    assert LeftOut("a.mcap", "messages outside the chunks, which no checksum covers", 1) in log.left_out


DAMAGE_KINDS = ("zstd", "lz4", "none", "no summary", "unchunked", "without checksums", "none without checksums")
UNCHECKED = {"unchunked", "without checksums", "none without checksums"}
ORIGINALS = {kind: mcap_bytes(imu_messages(40), chunk_size=4000, **VARIANTS[kind]) for kind in DAMAGE_KINDS}
ROWS = {row.tobytes() for row in gyro_of(imu_messages(40))}


def read_damaged(folder: Path, data: bytes) -> Log | None:
    path = folder / "damaged.mcap"
    path.write_bytes(data)
    try:
        describe(path)
        return read_log(path)
    except EgolocError as error:
        if "\n" in str(error):
            raise AssertionError("expected one line") from error
        return None


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_byte_flips_and_truncation_never_crash_nor_give_a_wrong_row(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    kind = data.draw(st.sampled_from(DAMAGE_KINDS))
    damaged = bytearray(ORIGINALS[kind])
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, len(damaged) - 1), st.integers(1, 255)), max_size=4)):
        damaged[at] ^= value
    keep = data.draw(st.one_of(st.just(len(damaged)), st.integers(0, len(damaged))))
    log = read_damaged(tmp_path_factory.getbasetemp(), bytes(damaged[:keep]))
    if log is None or log.imu is None or kind in UNCHECKED:
        return
    assert {row.tobytes() for row in log.imu.gyro} <= ROWS


RECORDS = message_records(ORIGINALS["unchunked"])


@settings(max_examples=100, deadline=None)
@given(at=st.integers(0, 400), value=st.integers(1, 255), number=st.integers(0, 39))
def test_flips_inside_unchecked_messages_never_crash(
    tmp_path_factory: pytest.TempPathFactory, at: int, value: int, number: int
) -> None:
    damaged = bytearray(ORIGINALS["unchunked"])
    damaged[RECORDS[number] + at] ^= value
    log = read_damaged(tmp_path_factory.getbasetemp(), bytes(damaged))
    assert log is None or log.imu is None or np.isfinite(log.imu.gyro).all()


@settings(max_examples=60, deadline=None)
@given(junk=st.binary(max_size=300), at=st.integers(0, 200))
def test_junk_after_the_magic_never_crashes(tmp_path_factory: pytest.TempPathFactory, junk: bytes, at: int) -> None:
    whole = ORIGINALS["no summary"]
    read_damaged(tmp_path_factory.getbasetemp(), whole[: 8 + at] + junk + whole[8 + at :])
    read_damaged(tmp_path_factory.getbasetemp(), whole[:8] + junk)


def test_a_row_of_every_record_survives_flips(tmp_path: Path) -> None:
    """Flips all over a log of ours: no wrong vehicle, map frame or row (seeded)."""
    log = full_log(100)
    write_log(tmp_path / "a.mcap", log)
    data = (tmp_path / "a.mcap").read_bytes()
    rng = np.random.default_rng(5)
    assert log.gnss is not None
    assert log.reference is not None
    for at in rng.integers(8, len(data), 300).tolist():
        damaged = bytearray(data)
        damaged[at] ^= int(rng.integers(1, 256))
        again = read_damaged(tmp_path, bytes(damaged))
        if again is None:
            continue
        assert again.vehicle in {log.vehicle, Log().vehicle}
        assert again.map_frame in {log.map_frame, None}
        if again.gnss is not None:
            np.testing.assert_array_equal(again.gnss.cov_enu, log.gnss.cov_enu)
        if again.reference is not None:
            np.testing.assert_array_equal(again.reference.p_map, log.reference.p_map)
