"""The filter benchmark: its JSON, what it times, and that every peer follows the drive as egoloc does."""

from collections.abc import Callable
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import find_spec

import numpy as np
import pytest

from fusion.config import FusionConfig
from fusion.result import FusionResult
from fusion.run import run as fuse
from replay.bench import filter as bench
from replay.bench.filterpy_peer import rotation
from replay.bench.peers import EVERY, Floats, PeerDrive, peer_drive
from sensors.records import Log

PEERS = ("filterpy", "gtsam", "pyins")
SMALL = {"filterpy": 300, "gtsam": 300, "pyins": 100}


def tracker(peer: str) -> Callable[[PeerDrive, int], Floats]:
    """A peer's track function; the test is skipped, and says so, where the peer is not installed."""
    if find_spec(peer) is None:
        pytest.skip(f"{peer} is not installed: pip install 'egoloc[bench]'")
    found: Callable[[PeerDrive, int], Floats] = import_module(f"replay.bench.{peer}_peer").track
    return found


@pytest.fixture(scope="module")
def drive() -> PeerDrive:
    return peer_drive(210.0)


def test_its_json_has_every_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """egoloc's rows are whole calls of fusion.run over the whole drive, one more than counted to warm up."""
    fused = []

    def counted(log: Log, config: FusionConfig | None = None) -> FusionResult:
        assert log.imu is not None
        fused.append((len(log.imu), log.wheel is None))
        return fuse(log, config)

    monkeypatch.setattr(bench, "fuse", counted)
    result = bench.run(repeats=2, seconds=30.0, peer_steps=SMALL)
    assert fused == [(3001, True)] * 3 + [(3001, False)] * 3
    assert set(result) == {"bench", "rows", "ratios", "conditions"}
    assert result["bench"] == "filter"
    present = [peer for peer in PEERS if find_spec(peer)]
    names = [row["name"] for row in result["rows"]]
    assert names == ["egoloc", "egoloc, all sensors and constraints", *present]
    assert {row["metric"] for row in result["rows"]} == {"imu_steps_per_s"}
    assert all(0 < row["min"] <= row["median"] <= row["max"] for row in result["rows"])
    rate = {row["name"]: row["median"] for row in result["rows"]}
    assert result["ratios"] == {peer: rate["egoloc"] / rate[peer] for peer in present}
    assert result["conditions"]["missing"] == [peer for peer in PEERS if peer not in present]
    assert {"numba", "numpy", "filterpy"} <= set(result["conditions"])


def test_a_peer_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def only_filterpy(name: str) -> ModuleSpec | None:
        return find_spec(name) if name == "filterpy" else None

    monkeypatch.setattr(bench, "find_spec", only_filterpy)
    result = bench.run(repeats=1, seconds=10.0, peer_steps=SMALL)
    assert result["conditions"]["missing"] == ["gtsam", "pyins"]
    assert result["conditions"]["peer_steps"] == {"filterpy": 300}
    assert set(result["ratios"]) == {"filterpy"}


def test_the_peers_get_the_drive_in_one_plane(drive: PeerDrive) -> None:
    """Antenna and pose fix lie where the truth puts them, to their sigmas; the drive moves by hundreds of metres."""
    assert len(drive.truth) == 2101
    assert np.ptp(drive.truth[:, :2], axis=0).max() > 300
    apart = drive.pose[:, :2] - drive.truth[:, :2]
    along, across = np.cos(drive.pose[:, 2]), np.sin(drive.pose[:, 2])
    left = along * apart[:, 1] - across * apart[:, 0]
    assert np.sqrt(np.mean(left**2)) == pytest.approx(0.03, rel=0.1)
    arm = np.hypot(*(drive.antenna - drive.truth)[:, :2].T)
    assert arm.mean() == pytest.approx(drive.arm[0], abs=0.05)
    gyro, accel = drive.middle(100)
    assert gyro.shape == accel.shape == (100, 3)
    assert gyro[7] == pytest.approx((drive.gyro[7] + drive.gyro[8]) / 2)


@pytest.mark.parametrize(("peer", "steps"), [("filterpy", 3000), ("gtsam", 3000), ("pyins", 1000)])
def test_peers_follow_the_truth(peer: str, steps: int, drive: PeerDrive) -> None:
    """Once the first second is over; GNSS alone is good to 3 cm in 3-D, the fused track must be better."""
    error = tracker(peer)(drive, steps) - drive.truth[1 : steps // EVERY + 1]
    assert error.shape == (steps // EVERY, 3)
    size = np.linalg.norm(error[10:], axis=1)
    assert np.sqrt(np.mean(size**2)) < 0.02
    assert size.max() < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("peer", PEERS)
def test_peers_follow_the_truth_to_the_end(peer: str, drive: PeerDrive) -> None:
    steps = bench.PEER_STEPS[peer]
    error = tracker(peer)(drive, steps)[-1] - drive.truth[steps // EVERY]
    assert np.linalg.norm(error) < 0.06


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 0.01, 1.0, 3.0])
def test_rotation_by_a_vector(size: float) -> None:
    from scipy.spatial.transform import Rotation

    v = size * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(rotation(v), Rotation.from_rotvec(v).as_matrix(), atol=1e-15)
