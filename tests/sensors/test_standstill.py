"""The longest stretch at rest: found among motion, gaps and lost samples; what is none is refused."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.records import GnssVelocity, Imu, WheelSpeed
from sensors.standstill import longest_rest, sampling_interval

START_NS = 1_700_000_000 * NS_PER_S
HZ = 100


def shaken(*stretches: tuple[float, float]) -> Imu:
    """An IMU over stretches of (seconds, times as shaky as at rest)."""
    rng = np.random.default_rng(1)
    level = np.concatenate([np.full(round(seconds * HZ), times) for seconds, times in stretches])
    t_ns = START_NS + np.arange(len(level)) * (NS_PER_S // HZ)
    gyro = 5e-4 * level[:, None] * rng.standard_normal((len(level), 3)) + 0.001
    accel = 0.01 * level[:, None] * rng.standard_normal((len(level), 3)) + (0.0, 0.0, 9.81)
    return Imu(t_ns, t_ns, gyro, accel)


def without(imu: Imu, rows: NDArray[np.int64] | slice) -> Imu:
    keep = np.ones(len(imu), bool)
    keep[rows] = False
    return imu[keep]


def gnss_speed(speed: float, begin_s: float, end_s: float) -> GnssVelocity:
    t_ns = START_NS + np.arange(round(begin_s), round(end_s)) * NS_PER_S
    vel = np.tile((speed, 0.0, 0.0), (len(t_ns), 1))
    return GnssVelocity(t_ns, t_ns, vel, np.tile(0.01 * np.eye(3), (len(t_ns), 1, 1)))


def test_the_longest_of_two_rests_without_its_first_and_last_second() -> None:
    rest = longest_rest(shaken((20, 1), (30, 20), (40, 1), (10, 20)))
    begin, end = ((t - START_NS) / NS_PER_S for t in rest.t_ns)
    assert begin == pytest.approx(51.0)
    assert end == pytest.approx(88.99)
    assert len(rest.gyro) == len(rest.accel) == 3800
    assert rest.interval_s == pytest.approx(0.01)
    assert not rest.whole
    assert rest.seconds == 60


def test_a_log_at_rest_is_used_whole() -> None:
    rest = longest_rest(shaken((60, 1)))
    assert rest.whole
    assert rest.filled == 0


def test_lost_samples_are_filled_and_counted() -> None:
    imu = shaken((60, 1))
    rest = longest_rest(without(imu, np.array([1000, 2000, 2001, 2002])))
    assert rest.filled == 4
    assert len(rest.gyro) == 5800
    np.testing.assert_allclose(rest.gyro[900], (imu.gyro[999] + imu.gyro[1001]) / 2)
    np.testing.assert_array_equal(rest.gyro[901], imu.gyro[1001])


def test_a_gap_ends_a_stretch() -> None:
    rest = longest_rest(without(shaken((60, 1)), slice(2000, 2050)))
    begin, end = ((t - START_NS) / NS_PER_S for t in rest.t_ns)
    assert (begin, end) == (pytest.approx(22.0, abs=1.1), pytest.approx(58.99))
    assert not rest.whole


@pytest.mark.parametrize("sensor", ["gnss", "wheel"])
def test_a_speed_contradicts_a_smooth_ride(sensor: str) -> None:
    speeds: GnssVelocity | WheelSpeed = gnss_speed(2.0, 25, 60)
    if sensor == "wheel":
        speeds = WheelSpeed(speeds.t_ns, speeds.t_ns, np.full(len(speeds), 2.0), np.full(len(speeds), 0.05))
    rest = longest_rest(shaken((60, 1)), [speeds])
    assert (rest.t_ns[1] - START_NS) / NS_PER_S == pytest.approx(23.99)


def test_a_steady_turn_is_no_rest() -> None:
    imu = shaken((60, 1))
    turning = imu.gyro.copy()
    turning[4000:, 2] += 0.02
    rest = longest_rest(Imu(imu.t_ns, imu.t_ns, turning, imu.accel))
    assert (rest.t_ns[1] - START_NS) / NS_PER_S <= 39.0


def test_motion_alone_is_refused() -> None:
    with pytest.raises(EgolocError, match=r"at rest for 12 s on end, got 0 s at most \(0 of 60 s are quiet\)"):
        longest_rest(shaken((60, 60)))
    with pytest.raises(EgolocError, match="got 8 s at most"):
        longest_rest(shaken((8, 1), (52, 60)))
    with pytest.raises(EgolocError, match="got 0 s at most"):
        longest_rest(shaken((60, 1)), [gnss_speed(3.0, 0, 60)])


def test_an_uneven_rate_is_refused() -> None:
    imu = shaken((60, 1))
    late = imu.t_ns + np.random.default_rng(2).integers(0, 8_000_000, len(imu))
    with pytest.raises(EgolocError, match=r"even rate, got \d+ % of the intervals 25 % off the median"):
        longest_rest(Imu(late, late, imu.gyro, imu.accel))
    with pytest.raises(EgolocError, match="expected IMU samples, got 1"):
        sampling_interval(imu.t_ns[:1])


def test_a_rate_that_does_not_divide_a_second_is_even() -> None:
    t_ns = START_NS + np.rint(np.arange(6000) * (NS_PER_S / 104.0)).astype(np.int64)
    assert sampling_interval(t_ns) == pytest.approx(NS_PER_S / 104.0, rel=1e-6)


def test_a_slow_imu_is_refused() -> None:
    imu = shaken((60, 1))
    with pytest.raises(EgolocError, match="five samples a second at least, got 4"):
        longest_rest(imu[::25])
