"""Snapshots: going back restores all that the kernels change, and only what is still there is offered."""

import numpy as np
import pytest

from fusion.config import FusionConfig
from fusion.navigator import Navigator
from fusion.rewinding import RewindingNavigator
from fusion.snapshots import _SCRATCH, S_FIRST, S_NEWEST, SPACING_NS, restore, snapshot_before, with_snapshots
from fusion.state import C_COUNT, C_STATE, Core, new_core
from sensors.records import Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate
from tests.fusion.arrivals import LATE, at_once
from tests.fusion.scenes import later, with_gap

_RINGS = ("ring", "ring_t", "saved", "saved_cov", "saved_t", "saves")


@pytest.fixture(scope="module")
def log() -> Log:
    """Twenty seconds of all sensors, at rest for a while, with a gap in the IMU."""
    return at_once(with_gap(later(simulate(60.0, 2, scenarios.load("demo")), 40.0), 12.0, 0.7))


def copies(core: Core) -> dict[str, np.ndarray]:
    """All that is neither scratch nor a ring."""
    return {name: a.copy() for name, a in core._asdict().items() if name not in (*_SCRATCH, *_RINGS)}


def test_going_back_restores_every_array(log: Log) -> None:
    """Also those that the core may get one day: nothing but scratch and rings is left out."""
    navigator = RewindingNavigator(log.vehicle, log.map_frame, LATE)
    navigator.add(log)
    assert log.imu is not None
    known: list[tuple[int, dict[str, np.ndarray]]] = []
    for k in range(300, 1400, 7):
        navigator.advance(int(log.imu.t_ns[k]))
        core = navigator.core
        assert core is not None
        newest = int(core.saves[S_NEWEST])
        if core.saved_t[newest % len(core.saved_t), 0] == core.clock[C_STATE]:
            known.append((newest, {"kept": core.saved[newest % len(core.saved_t)].copy()}))
    changed = set()
    for number, before in reversed(known[-10:]):
        now = copies(core)
        restore(core, number)
        then = copies(core)
        assert np.array_equal(then["kept"], before["kept"])
        assert core.clock[C_STATE] == core.saved_t[number % len(core.saved_t), 0]
        changed |= {name for name in then if not np.array_equal(then[name], now[name])}
    assert {"clock", "nav", "P", "last", "acc", "earth", "kept"} <= changed


def test_kept_is_the_memory_of_the_arrays() -> None:
    core = with_snapshots(new_core(), 1.0)
    for name, array in copies(core).items():
        if name in ("P", "kept"):
            continue
        live = getattr(core, name)
        live.flat[0] = 7
        assert not np.array_equal(core.kept, np.zeros(0))
        assert np.shares_memory(live, core.kept), name
        assert array.dtype == live.dtype


def test_the_state_goes_into_the_new_core() -> None:
    core = new_core()
    core.nav[:], core.P[:], core.clock[:] = np.arange(len(core.nav)), np.eye(len(core.P)), np.arange(6)
    with_it = with_snapshots(core, 0.5)
    assert np.array_equal(with_it.nav, core.nav)
    assert np.array_equal(with_it.P, core.P)
    assert np.array_equal(with_it.clock, core.clock)
    assert np.isinf(with_it.quietest).all()
    assert len(with_it.saved_t) * SPACING_NS >= 0.5e9
    assert with_it.saves[[S_NEWEST, S_FIRST]].tolist() == [0, 0]


def test_the_newest_snapshot_before_a_time() -> None:
    core = with_snapshots(new_core(), 0.1)
    size = len(core.saved_t)
    for k in range(40):
        core.clock[C_STATE], core.clock[C_COUNT] = 1000 * k, k
        core.saves[S_NEWEST] = k
        core.saves[S_FIRST] = max(0, k - size + 1)
        core.saved_t[k % size, 0] = 1000 * k
        core.saved[k % size] = core.kept
    assert snapshot_before(core, 40, 38_500) == 38
    assert snapshot_before(core, 40, 38_000) == 38  # a sample follows
    assert snapshot_before(core, 38, 38_000) == 37  # none does
    assert snapshot_before(core, 40, 39_500) == 39
    first = 40 - size
    assert snapshot_before(core, 40, 1000 * first + 1) == first
    assert snapshot_before(core, 40, 1000 * first - 1) == -1
    assert snapshot_before(core, 40 + len(core.ring_t), 39_500) == -1  # its samples are gone


def test_without_history_no_snapshot_is_taken(log: Log) -> None:
    navigator = Navigator(log.vehicle, log.map_frame, FusionConfig())
    navigator.add(log)
    navigator.advance(navigator.last_imu_ns)
    assert navigator.core is not None
    assert len(navigator.core.saved_t) == len(navigator.core.kept) == 0
    assert navigator.core.saves[S_NEWEST] == 0
