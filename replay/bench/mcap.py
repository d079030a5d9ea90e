"""`egoloc bench mcap`: IMU columns from an MCAP file, in messages/s, beside mcap-ros2-support in the same run.

egoloc's figures are whole calls of read_log (opening, checksums, screening and the record's checks included) after one
warm-up call; the peer decodes the same messages into Python lists of the same columns.
"""

import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from replay.bench.measure import conditions, rate, row, times
from sensors.clock import NS_PER_S
from sensors.geodesy import MapFrame
from sensors.mcap.io import read_log, write_log
from sensors.records import GnssFix, GnssVelocity, Imu, Log, PoseFix, Trajectory

METRIC = "messages_per_s"
PEER = "mcap-ros2-support"
_PEER_MESSAGES = 20_000
_START_NS = 1_700_000_000 * NS_PER_S
_COMPRESSIONS: tuple[tuple[Literal["zstd", "lz4", "none"], str], ...] = (
    ("zstd", "egoloc"),
    ("lz4", "egoloc, lz4"),
    ("none", "egoloc, uncompressed"),
)


def run(repeats: int = 5, messages: int = 360_000) -> dict[str, Any]:
    """Medians over repeats; messages: IMU samples in the file (100 Hz: 360,000 are an hour)."""
    log = sensors(messages)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for compression, name in _COMPRESSIONS:
            path = Path(folder) / f"{compression}.mcap"
            write_log(path, Log(imu=log.imu), compression)
            rows.append(rate(name, METRIC, messages, times(lambda: read_log(path), repeats)))  # noqa: B023
        if find_spec("mcap_ros2"):
            path = Path(folder) / "peer.mcap"
            count = min(messages, _PEER_MESSAGES)
            assert log.imu is not None
            write_log(path, Log(imu=log.imu[:count]))
            rows.append(rate(PEER, METRIC, count, times(lambda: read_with_peer(path), min(repeats, 3))))
        path = Path(folder) / "all.mcap"
        write_log(path, log)
        rows.append(row("egoloc, all sensors", "read_s", times(lambda: read_log(path), repeats)))
    median = {r["name"]: r["median"] for r in rows}
    ratios = {PEER: median["egoloc"] / median[PEER]} if PEER in median else {}
    facts = {
        "messages": messages,
        "peer_messages": min(messages, _PEER_MESSAGES),
        "all_sensors": f"{messages / 100:.0f} s: IMU and reference 100 Hz; GNSS, velocity, pose fixes 10 Hz; zstd",
        "repeats": repeats,
    }
    packages = ["numba", "numpy", "zstandard", *([PEER] if PEER in median else [])]
    return {"bench": "mcap", "rows": rows, "ratios": ratios, "conditions": conditions(packages, **facts)}


def sensors(messages: int) -> Log:
    """Noise at 100 Hz (IMU, reference) and 10 Hz (GNSS, velocity, pose fixes): as hard to compress as real signals."""
    rng = np.random.default_rng(0)
    fast = _START_NS + np.arange(messages, dtype=np.int64) * (NS_PER_S // 100)
    slow = fast[::10]
    n = len(slow)
    q = rng.normal(size=(messages, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    cov = np.eye(3) * rng.uniform(0.01, 0.1, (n, 1, 1))
    llh = np.radians((49.0, 8.4, 0.0)) + rng.normal(size=(n, 3)) * (1e-6, 1e-6, 1.0)
    return Log(
        imu=Imu(fast, fast + 1_000_000, rng.normal(size=(messages, 3)), rng.normal(size=(messages, 3))),
        gnss=GnssFix(slow, slow + 50_000_000, llh, cov, np.full(n, 4, np.int8)),
        gnss_velocity=GnssVelocity(slow, slow + 50_000_000, rng.normal(size=(n, 3)), cov),
        pose_fixes=PoseFix(slow, slow + 120_000_000, rng.normal(size=(n, 3)), cov),
        reference=Trajectory(fast, fast, rng.normal(size=(messages, 3)), q, np.full((messages, 2), 0.01)),
        map_frame=MapFrame("enu", (49.0, 8.4, 0.0)),
    )


def read_with_peer(path: Path) -> np.ndarray:
    """(N, 7) stamp, gyro and acceleration by mcap-ros2-support."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    rows = []
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, _, _, m in reader.iter_decoded_messages(topics=["/imu"], log_time_order=False):
            stamp, w, a = m.header.stamp, m.angular_velocity, m.linear_acceleration
            rows.append((stamp.sec * NS_PER_S + stamp.nanosec, w.x, w.y, w.z, a.x, a.y, a.z))
    return np.array(rows)
