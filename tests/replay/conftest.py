"""A run folder as egoloc replay lays it out, drawn from a seeded random drive of known shape."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from sensors.records import Log
from sensors.simulate.drive import simulate
from sensors.simulate.scenarios import load
from tests.replay.spoiling import Replayed

T0_NS = 1_700_000_000_000_000_000
SENSORS = ("gnss_position", "pose_fix", "non_holonomic")
HEALTH = ("healthy", "dead_reckoning", "recovered")
REASONS = ("accepted", "chi_square", "status")
CONFIG = "seed = 0\n\n[fusion.gnss]\nuse = true\ninflation = {inflation}\n\n[limits]\nlon_m = 0.6\n"
METRICS = {
    "limits": {"lon_m": 0.6, "lat_m": 0.3, "yaw_deg": 1.0},
    "duration_s": 60.0,
    "distance_m": 590.0,
    "epochs": 600,
    "excluded": {"gap": 3},
    "methods": {
        "gnss": {
            "ar": 0.75,
            "coverage": 0.8,
            "lon": {"mae": 0.04, "rmse": 0.05, "max": 0.3},
            "lat": {"mae": 0.03, "rmse": 0.04, "max": 0.2},
            "yaw": None,
        },
        "fusion": {
            "ar": 0.995,
            "coverage": 1.0,
            "lon": {"mae": 0.02, "rmse": 0.03, "max": 0.1},
            "lat": {"mae": 0.02, "rmse": 0.03, "max": 0.1},
            "yaw": {"mae": 0.05, "rmse": 0.06, "max": 0.2},
        },
    },
}


def _wander(rng: np.random.Generator, n: int, sigma: float) -> NDArray[np.float64]:
    """A first-order Gauss-Markov sequence of the given standard deviation."""
    values = np.empty(n)
    values[0] = rng.normal(0, sigma)
    for i in range(1, n):
        values[i] = 0.95 * values[i - 1] + rng.normal(0, sigma * np.sqrt(1 - 0.95**2))
    return values


def _states(rng: np.random.Generator, duration_s: float, hz: float) -> dict[str, Any]:
    """A figure of eight at 10 m/s; the reference is missing between 20 and 25 s; dead reckoning from 30 to 45 s."""
    n = int(duration_s * hz)
    t = np.arange(n) / hz
    phase = t * 0.05
    ref_x, ref_y = 200 * np.sin(phase), 100 * np.sin(2 * phase)
    vx, vy = 10 * np.cos(phase), 10 * np.cos(2 * phase)
    yaw = np.arctan2(vy, vx)
    known = ~((t >= 20) & (t < 25))
    errors = {axis: _wander(rng, n, sigma) for axis, sigma in (("lon", 0.04), ("lat", 0.03), ("yaw", 0.001))}
    columns: dict[str, Any] = {
        "t_ns": T0_NS + np.round(t * 1e9).astype(np.int64),
        "x": ref_x + errors["lon"] * np.cos(yaw) - errors["lat"] * np.sin(yaw),
        "y": ref_y + errors["lon"] * np.sin(yaw) + errors["lat"] * np.cos(yaw),
        "z": np.full(n, 30.0),
        "roll": np.zeros(n),
        "pitch": np.zeros(n),
        "yaw": yaw + errors["yaw"],
        "ve": vx,
        "vn": vy,
        "vu": np.zeros(n),
        "lat_deg": np.full(n, 48.0),
        "lon_deg": np.full(n, 11.0),
        "height_m": np.full(n, 530.0),
        **{f"gyro_bias_{a}": np.full(n, 1e-5) for a in "xyz"},
        **{f"accel_bias_{a}": np.full(n, 1e-2) for a in "xyz"},
        "pose_cov": pa.FixedSizeListArray.from_arrays(pa.array(np.tile(np.eye(6).ravel(), n)), 36),
    }
    for name, values in (("x", ref_x), ("y", ref_y), ("z", columns["z"]), ("yaw", yaw), ("speed", np.hypot(vx, vy))):
        columns[f"ref_{name}"] = np.where(known, values, np.nan)
    for axis, sigma in (("lon", 0.05), ("lat", 0.04), ("yaw", 0.0012)):
        columns[f"err_{axis}"] = np.where(known, errors[axis], np.nan)
        columns[f"sigma_{axis}"] = np.full(n, sigma)
    columns["stretch"] = np.full(n, -1, np.int32)
    health = np.where(t < 30, 0, np.where(t < 45, 1, 2)).astype(np.int8)
    columns["health"] = pa.DictionaryArray.from_arrays(pa.array(health), pa.array(HEALTH))
    return columns


def _decisions(rng: np.random.Generator, states: dict[str, Any], hz: float) -> dict[str, Any]:
    """10 Hz of each sensor; GNSS is lost between 30 and 40 s and float before 10 s; pose fixes are gated at 45 s."""
    step = max(1, int(hz / 10))
    rows = np.arange(0, len(states["t_ns"]), step)
    seconds = (states["t_ns"][rows] - T0_NS) * 1e-9
    lost = (seconds >= 30) & (seconds < 40)
    index = np.concatenate([rows[~lost], rows, rows])
    sensor = np.repeat([0, 1, 2], [len(rows) - lost.sum(), len(rows), len(rows)])
    n = len(index)
    t = states["t_ns"][index]
    s = (t - T0_NS) * 1e-9
    reason = np.where((sensor == 1) & (s >= 45) & (s < 45.2), 1, np.where((sensor == 0) & (s < 10), 2, 0))
    placed = sensor < 2
    columns: dict[str, Any] = {
        "t_ns": t,
        "arrival_ns": t,
        "sensor": pa.DictionaryArray.from_arrays(pa.array(sensor.astype(np.int8)), pa.array(SENSORS)),
        "row": index,
        "reason": pa.DictionaryArray.from_arrays(pa.array(reason.astype(np.int8)), pa.array(REASONS)),
        "accepted": reason == 0,
        "nis": np.where(reason == 1, 80.0, rng.chisquare(3, n)),
        "threshold": np.full(n, 21.1),
        "dof": np.full(n, 3, np.int8),
        "moved_m": np.full(n, 0.01),
        "moved_yaw": np.full(n, 1e-4),
        "weight": np.ones(n),
        "z": np.where(placed, 30.0, np.nan),
        "yaw": np.where(sensor == 1, states["yaw"][index], np.nan),
    }
    status = np.where(s < 10, 3, 4)
    columns["status"] = pa.array(status.astype(np.int8), mask=sensor != 0)
    for i in range(3):
        columns[f"innovation_{i}"] = rng.normal(0, 0.1, n)
        columns[f"innovation_sigma_{i}"] = np.full(n, 0.1)
    for axis in ("x", "y"):
        columns[axis] = np.where(placed, states[axis][index] + rng.normal(0, 0.05, n), np.nan)
    for axis in ("lon", "lat"):
        columns[f"err_{axis}"] = np.where(placed, rng.normal(0, 0.05, n), np.nan)
    columns["err_yaw"] = np.where(sensor == 1, rng.normal(0, 0.002, n), np.nan)
    order = np.argsort(t, kind="stable")
    return {name: pa.array(column).take(pa.array(order)) for name, column in columns.items()}


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a run folder and gives its path."""

    def make(
        name: str = "run", *, seed: int = 1, duration_s: float = 60.0, hz: float = 10.0, inflation: float = 4.0
    ) -> Path:
        rng = np.random.default_rng(seed)
        run = tmp_path / name
        run.mkdir()
        states = _states(rng, duration_s, hz)
        pq.write_table(pa.table(states), run / "states.parquet")
        pq.write_table(pa.table(_decisions(rng, states, hz)), run / "decisions.parquet")
        (run / "metrics.json").write_text(json.dumps(METRICS))
        (run / "manifest.json").write_text(json.dumps({"egoloc": "0.1.0", "config_sha256": f"{seed:064x}"}))
        (run / "config.toml").write_text(CONFIG.format(inflation=inflation))
        return run

    return make


@pytest.fixture(scope="session")
def short_log() -> Log:
    """A simulated minute, at rest for the first ten seconds, with every sensor and a reference."""
    return simulate(60.0, 3, load("clean"))


@pytest.fixture
def at(tmp_path: Path) -> Callable[[str], Path]:
    """The path of a log by its name."""
    (tmp_path / "logs").mkdir()
    return lambda name: tmp_path / "logs" / name


@pytest.fixture
def replayed(capsys: pytest.CaptureFixture[str]) -> Callable[..., Replayed]:
    """A function that replays a log of `at` through the command line."""
    return lambda path, *options: Replayed(path, capsys, *options)
