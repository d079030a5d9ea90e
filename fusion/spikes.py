"""Single IMU samples that no motion explains: a wrong bit turns the state by degrees, and nothing takes that back.

A sample that lies far from the one before is held back, and that one serves twice; if the next one lies near it, the
step was real and is followed, one sample late. No more than MOST samples in a row are held back, whatever comes.
"""

import numpy as np
from numpy.typing import NDArray

from fusion.history import read_only
from fusion.sensor_models import ImuNoise
from fusion.state import NEVER, Floats, Nanoseconds
from sensors.kernel import kernel
from sensors.records import Imu

MOST = 3
"""A longer run of such samples is what the IMU measures, however strange."""
UNUSUAL = 10.0
"""And beyond so many times the usual step (RMS): on a rattling mount any sample lies far from the one before."""
USUAL_SHARE = 0.01
"""What is usual is learned over a hundred samples."""
_LAST_NS, _RUN = range(2)


class SpikeGate:
    """Looks at the samples of a drive as they come, the same in whatever pieces."""

    def __init__(self, config: ImuNoise) -> None:
        self._limits = (float(np.radians(config.spike_rate_deg)), config.spike_force)
        self._gap_ns = round(config.max_gap_s * 1e9)
        self._values, self._clock = np.zeros((3, 6)), np.array([NEVER, 0])
        self.held_back = 0
        """So many samples so far."""

    def passed(self, imu: Imu) -> Imu:
        """The record with the values of samples before in place of those held back; itself where there are none."""
        serves = np.empty(len(imu), np.int64)
        columns = read_only(imu.t_ns), read_only(imu.gyro), read_only(imu.accel)
        before = self._values[0].copy()
        found = scan(*columns, self._values, self._clock, self._limits, self._gap_ns, serves)
        if not found:
            return imu
        self.held_back += found
        gyro = np.vstack((before[:3], imu.gyro))[serves + 1]
        accel = np.vstack((before[3:], imu.accel))[serves + 1]
        return Imu(imu.t_ns, imu.arrival_ns, gyro, accel)


@kernel()
def scan(
    t_ns: Nanoseconds,
    gyro: Floats,
    accel: Floats,
    values: Floats,
    clock: Nanoseconds,
    limits: tuple[float, float],
    gap_ns: int,
    serves: NDArray[np.int64],
) -> int:
    """Which sample serves for each (N,): itself or one before (-1: the last that passed earlier); how many do not pass.

    values (3, 6): the last sample that passed, the last one held back, and in [2, :2] the mean square of usual steps of
    rate and force; clock: time of the last sample ns, how many were held back since one passed. After a gap any passes.
    """
    found, good = 0, -1
    usual = values[2]
    for i in range(len(t_ns)):
        turn, push = _step(gyro, accel, i, values[0])
        known = t_ns[i] - clock[_LAST_NS] <= gap_ns
        far = known and _is_far(turn, push, usual, limits)
        if far and clock[_RUN] > 0:
            again, pushed_again = _step(gyro, accel, i, values[1])
            far = _is_far(again, pushed_again, usual, limits)
        if far and clock[_RUN] < MOST:
            found += 1
            clock[_RUN] += 1
            _keep(values[1], gyro, accel, i)
        else:
            good = i
            if known:
                usual[0] += USUAL_SHARE * (turn * turn - usual[0])
                usual[1] += USUAL_SHARE * (push * push - usual[1])
            clock[_RUN] = 0
            _keep(values[0], gyro, accel, i)
        clock[_LAST_NS] = t_ns[i]
        serves[i] = good
    return found


@kernel(inline="always")
def _is_far(turn: float, push: float, usual: Floats, limits: tuple[float, float]) -> bool:
    """Whether steps of rate and force are beyond their limits, and beyond what has been usual."""
    fast: bool = turn > limits[0] and turn * turn > UNUSUAL * UNUSUAL * usual[0]
    hard: bool = push > limits[1] and push * push > UNUSUAL * UNUSUAL * usual[1]
    return fast or hard


@kernel(inline="always")
def _step(gyro: Floats, accel: Floats, i: int, other: Floats) -> tuple[float, float]:
    """Largest step of a rate and of a force from another sample."""
    turn, push = 0.0, 0.0
    for k in range(3):
        turn = max(turn, abs(gyro[i, k] - other[k]))
        push = max(push, abs(accel[i, k] - other[3 + k]))
    return turn, push


@kernel(inline="always")
def _keep(row: Floats, gyro: Floats, accel: Floats, i: int) -> None:
    for k in range(3):
        row[k], row[3 + k] = gyro[i, k], accel[i, k]
