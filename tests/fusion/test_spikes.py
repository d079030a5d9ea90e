"""The spike gate: what it holds back, what it lets pass, and the same in whatever pieces."""

from itertools import pairwise

import numpy as np
import pytest

from fusion.run import run
from fusion.sensor_models import ImuNoise
from fusion.spikes import MOST, SpikeGate
from sensors.records import Imu
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate

COUNT = 600


def imu(rate: dict[int, float] | None = None, noise: float = 0.01) -> Imu:
    """Six seconds at rest with white noise; rate: sample -> rad/s more about x."""
    rng = np.random.default_rng(1)
    gyro, accel = noise * rng.standard_normal((COUNT, 3)), noise * rng.standard_normal((COUNT, 3)) + [0.0, 0.0, 9.8]
    for row, more in (rate or {}).items():
        gyro[row, 0] += more
    t_ns = np.arange(COUNT) * 10_000_000 + 1_000_000_000
    return Imu(t_ns, t_ns, gyro, accel)


def passed(given: Imu, *cuts: int) -> tuple[Imu, int]:
    gate = SpikeGate(ImuNoise())
    edges = [0, *cuts, len(given)]
    parts = [gate.passed(given[a:b]) for a, b in pairwise(edges)]
    gyro, accel = (np.concatenate([getattr(part, name) for part in parts]) for name in ("gyro", "accel"))
    return Imu(given.t_ns, given.arrival_ns, gyro, accel), gate.held_back


def test_a_quiet_record_is_itself() -> None:
    given, gate = imu(), SpikeGate(ImuNoise())
    assert gate.passed(given) is given
    assert gate.held_back == 0


@pytest.mark.parametrize("cuts", [(), (299,), (300,), (301,), (299, 300, 301, 302)])
def test_one_sample_far_off_is_replaced_by_the_one_before(cuts: tuple[int, ...]) -> None:
    given = imu({300: 5.0})
    found, count = passed(given, *cuts)
    assert count == 1
    np.testing.assert_array_equal(found.gyro[300], given.gyro[299])
    np.testing.assert_array_equal(found.accel[300], given.accel[299])
    rest = np.arange(COUNT) != 300
    np.testing.assert_array_equal(found.gyro[rest], given.gyro[rest])


def test_a_step_that_stays_is_followed_one_sample_late() -> None:
    given = imu(dict.fromkeys(range(300, COUNT), 5.0))
    found, count = passed(given)
    assert count == 1
    np.testing.assert_array_equal(found.gyro[301:], given.gyro[301:])


def test_no_more_than_a_few_in_a_row_are_held_back() -> None:
    """Each far from the one before and from the last one that passed."""
    given = imu({300 + k: 3.0 * (k + 1) for k in range(20)})
    found, _ = passed(given)
    same = (found.gyro[300:320] == given.gyro[300:320]).all(axis=1)
    held = np.flatnonzero(same)
    assert len(held) >= 20 // (MOST + 1)
    assert np.diff(held).max() <= MOST + 1


def test_on_a_rattling_mount_nothing_is_a_spike() -> None:
    """Steps of a rad/s all the time."""
    _, count = passed(imu(noise=0.4))
    assert count <= 2  # before it is known what is usual here


def test_the_run_tells_of_it() -> None:
    log = simulate(30.0, 3, scenarios.load("clean"))
    assert log.imu is not None
    gyro = log.imu.gyro.copy()
    gyro[[1500, 2000]] += 2.0
    result = run(
        type(log)(
            **{
                **{n: getattr(log, n) for n in log.__dataclass_fields__},
                "imu": Imu(log.imu.t_ns, log.imu.arrival_ns, gyro, log.imu.accel),
            }
        )
    )
    (left_out,) = result.left_out
    assert (left_out.source, left_out.count) == ("imu", 2)
    assert "spike" in left_out.reason
