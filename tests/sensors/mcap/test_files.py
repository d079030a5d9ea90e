"""Every kind of MCAP file that others write, files that are no log, and memory."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType

from sensors.errors import EgolocError
from sensors.mcap import container
from sensors.mcap.io import describe, read_log
from tests.sensors.mcap.messages import (
    SMALL,
    START_NS,
    VARIANTS,
    Sent,
    encode,
    gyro_of,
    imu_messages,
    imu_of,
    imu_value,
    mcap_bytes,
)

Save = Callable[..., Path]


@pytest.mark.parametrize("options", VARIANTS.values(), ids=VARIANTS)
def test_every_kind_of_file(save: Save, options: dict[str, Any]) -> None:
    messages = imu_messages(200)
    log = read_log(save(messages, **SMALL, **options))
    assert log.left_out == ()
    np.testing.assert_array_equal(imu_of(log).gyro, gyro_of(messages))
    assert imu_of(log).t_ns.tolist() == [START_NS + k * 10_000_000 for k in range(200)]
    assert imu_of(log).arrival_ns.tolist() == [m.log_time for m in messages]


@pytest.mark.parametrize("content_size", [True, False])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_chunks_compressed_by_streaming_writers(compression: str, content_size: bool) -> None:
    plain = bytes(range(256)) * 40
    if compression == "zstd":
        packed = zstandard.ZstdCompressor(write_content_size=content_size).compress(plain)
    else:
        packed = lz4.frame.compress(plain, store_size=content_size)
    chunk = container.ChunkHeader(compression, len(plain), 0, 0, len(packed))
    assert container.decompress(memoryview(packed), chunk).tobytes() == plain
    for size in (len(plain) - 1, len(plain) + 1, 1 << 40):
        with pytest.raises(container.DamagedError):
            container.decompress(memoryview(packed), chunk._replace(size=size))


def test_a_decompressor_is_not_asked_for_more_than_its_input_can_hold() -> None:
    packed = zstandard.ZstdCompressor().compress(bytes(1 << 20))
    chunk = container.ChunkHeader("zstd", 1 << 30, 0, 0, len(packed))
    with pytest.raises(container.DamagedError, match="claims 1073741824 bytes"):
        container.decompress(memoryview(packed), chunk)


def test_an_unknown_compression_is_named(save: Save) -> None:
    path = save(imu_messages(20), **VARIANTS["lz4"])
    path.write_bytes(path.read_bytes().replace(b"lz4", b"br9", 1))
    log = read_log(path)
    assert log.imu is None
    assert log.left_out[0].reason == "chunk has unknown compression 'br9', expected zstd, lz4 or none"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, r"cannot be read: No such file"),
        (b"", r"the file is empty, expected an MCAP log"),
        (b"\x89MC", r"not an MCAP file, its first bytes are 89 4d 43"),
        (b"#ROSBAG V2.0\n" + bytes(99), r"not an MCAP file, its first bytes are 23 52 4f 53 42 41 47 20"),
    ],
)
def test_files_that_are_no_log(tmp_path: Path, content: bytes | None, reason: str) -> None:
    path = tmp_path / "bad.mcap"
    if content is not None:
        path.write_bytes(content)
    for read in (read_log, describe):
        with pytest.raises(EgolocError, match=rf"bad\.mcap: {reason}") as caught:
            read(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(EgolocError, match="expected an MCAP log, got a folder"):
        read_log(tmp_path)


def test_memory_follows_the_columns_not_the_file(tmp_path: Path) -> None:
    """100 MB of messages that no sensor wants beside a few of the IMU (peak resident size, in a fresh process)."""
    wanted = imu_messages(300)
    camera = [Sent("/camera", "std_msgs/Header", bytes(1_000_000), START_NS + k * 10**7) for k in range(100)]
    plain = {"compression": CompressionType.NONE}
    (tmp_path / "small.mcap").write_bytes(mcap_bytes(wanted + camera[:1], **plain))
    (tmp_path / "large.mcap").write_bytes(mcap_bytes(wanted + camera, **plain))
    code = (
        "import sys; from replay.bench.memory import peak_mb; from sensors.mcap.io import read_log;"
        "log = read_log(sys.argv[1]); print(len(log.imu), peak_mb())"
    )
    peaks = {}
    for name in ("small", "large"):
        run = [sys.executable, "-c", code, str(tmp_path / f"{name}.mcap")]
        rows, peak = subprocess.run(run, capture_output=True, text=True, check=True).stdout.split()
        assert int(rows) == 300
        peaks[name] = float(peak)
    assert peaks["large"] - peaks["small"] < 50


def test_an_imu_message_is_what_the_oracle_encodes() -> None:
    """Guards the fixtures: header, stamp, 8-byte alignment after a frame_id of five bytes."""
    data = encode("sensor_msgs/Imu", imu_value(START_NS, (1, 2, 3), (4, 5, 6)))
    assert data[:4] == b"\x00\x01\x00\x00"
    assert len(data) == 4 + 24 + 37 * 8
