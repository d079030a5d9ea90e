"""The filter benchmark: its JSON, what it times, and that every peer follows the drive as egoloc does."""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import find_spec

import numpy as np
import pytest

from fusion.config import FusionConfig
from fusion.result import FusionResult
from fusion.run import run as fuse
from replay.bench import filter as bench
from replay.bench import live
from replay.bench.filterpy_peer import rotation
from replay.bench.peers import EVERY, Floats, PeerDrive, peer_drive
from sensors.records import Imu, Log, WheelSpeed
from sensors.simulate.drive import simulate_drive
from sensors.simulate.scenarios import load

SECOND = 10**9
PEERS = ("filterpy", "gtsam", "pyins")
LATE = ", arrival order"
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
    """egoloc's rows are whole calls of fusion.run over the whole drive, one more than counted to warm up, by turns."""
    fused = []

    def counted(log: Log, config: FusionConfig | None = None) -> FusionResult:
        assert log.imu is not None
        assert config is not None
        fused.append((len(log.imu), log.wheel is None, config.order))
        return fuse(log, config)

    monkeypatch.setattr(bench, "fuse", counted)
    result = bench.run(repeats=2, seconds=30.0, peer_steps=SMALL)
    plain, every = ([(3001, bare, order) for order in ("stamp", "arrival")] for bare in (True, False))
    assert fused == plain * 3 + every * 3
    assert set(result) == {"bench", "rows", "ratios", "conditions"}
    assert result["bench"] == "filter"
    present = [peer for peer in PEERS if find_spec(peer)]
    rate = {row["name"]: row["median"] for row in result["rows"] if row["metric"] == "imu_steps_per_s"}
    ours = [f"egoloc{all_of_it}{order}" for all_of_it in ("", ", all sensors and constraints") for order in ("", LATE)]
    assert list(rate) == [*ours, *present]
    cost = [(row["name"], row["metric"]) for row in result["rows"] if row["metric"] != "imu_steps_per_s"]
    assert cost == [(name, of) for name in ours[1::2] for of in ("cost_over_stamp_order", "cost_over_work")]
    assert all(0 < row["min"] <= row["median"] <= row["max"] for row in result["rows"])
    assert result["ratios"] == {peer: rate["egoloc"] / rate[peer] for peer in present}
    assert result["conditions"]["missing"] == [peer for peer in PEERS if peer not in present]
    assert {"numba", "numpy", "filterpy"} <= set(result["conditions"])


def test_work_by_arrival() -> None:
    """Each late row repeats the IMU steps since its stamp: 1 + rate x latency of each sensor."""
    t = {hz: np.arange(0, 10 * SECOND + 1, SECOND // hz) for hz in (1, 10, 100)}
    axes = np.zeros((len(t[100]), 3))
    one = np.ones(len(t[10]))
    wheel = WheelSpeed(t[10], t[10] + 300_000_000, one, one)
    log = Log(imu=Imu(t[100], t[100], axes, axes), wheel=wheel)
    assert bench.work_by_arrival(log) == pytest.approx(1.0 + 10.1 * 0.3)
    assert bench.work_by_arrival(replace(log, wheel=None)) == 1.0


def test_live_pushes_every_row_by_its_arrival() -> None:
    result = live.run(repeats=1, hours=(0.01,))
    assert result["bench"] == "live"
    assert result["conditions"]["calls"] == 3601 + 1801 + 2 * 361 + 360
    times = {(row["name"], row["metric"]): row["median"] for row in result["rows"]}
    for quantile in ("p50", "p99", "p99.9", "max"):
        alone, whole = times["push", f"us_{quantile}"], times["push and the making of its record", f"us_{quantile}"]
        assert 0 < alone < whole == times["the same, least of the passes", f"us_{quantile}"]  # of one pass
    assert times["push", "us_p50"] < times["push", "us_p99.9"] <= times["push", "us_max"]
    assert times["push, pose_fixes", "us_p50"] > times["push, imu", "us_p50"]
    log = simulate_drive(5.0, 0, load("clean")).log
    calls = live.in_arrival_order(log)
    arrivals = [getattr(log, live.SENSORS[sensor]).arrival_ns[row] for sensor, row in calls]
    assert arrivals == sorted(arrivals)
    assert len(set(calls)) == len(calls) == sum(len(getattr(log, name)) for name in live.SENSORS)


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
