"""A state that both sensors outvote, and outvote again: aligned anew, whatever the IMU did to it."""

from dataclasses import replace

import numpy as np
import pytest

from fusion.result import Cause, Health, Reason, Sensor
from fusion.run import run
from sensors.records import Imu, Log
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, simulate_drive
from tests.fusion.rough import LIMITS, fused_errors
from tests.fusion.scenes import seconds
from tests.fusion.test_robustness import moving_at

LENGTH_S, BACK_S = 10.0, 10.0
ALERT_S = 1.0
"""So long a far state may be said to be well, in all."""


@pytest.fixture(scope="module")
def drive() -> Drive:
    return simulate_drive(180.0, 100_011, scenarios.load("clean"))


def with_imu(drive: Drive, begin: float, gyro_deg: tuple[float, ...], accel_scale: tuple[float, ...]) -> Log:
    """The IMU wrong for LENGTH_S."""
    imu = drive.log.imu
    assert imu is not None
    s = seconds(drive.log, imu.t_ns)
    inside = ((s >= begin) & (s < begin + LENGTH_S))[:, None]
    gyro = np.where(inside, imu.gyro + np.radians(gyro_deg), imu.gyro)
    accel = np.where(inside, imu.accel * accel_scale, imu.accel)
    return replace(drive.log, imu=Imu(imu.t_ns, imu.arrival_ns, gyro, accel))


@pytest.mark.parametrize(
    ("gyro_deg", "accel_scale"),
    [
        ((3.0, 3.0, 3.0), (1.0, 1.0, 1.0)),
        ((0.0, 0.0, 10.0), (1.0, 1.0, 1.0)),
        ((20.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    ],
)
def test_an_imu_that_was_wrong_is_recovered_from(
    gyro_deg: tuple[float, ...], accel_scale: tuple[float, ...], drive: Drive
) -> None:
    """Tilted by up to 200 deg and tens of m/s off, the covariance knowing nothing of it: within limits again."""
    begin = moving_at(drive, 5.0)
    log = with_imu(drive, begin, gyro_deg, accel_scale)
    result = run(log)
    s, errors = seconds(log, result.states.t_ns), np.abs(fused_errors(result, drive))
    largest = errors[s > begin].max(axis=0)
    print(f"largest {largest.round(2)}")
    assert (largest > LIMITS).any()
    assert (errors[s > begin + LENGTH_S + BACK_S] < LIMITS).all()
    assert {restart.cause for restart in result.restarts} <= {Cause.REJECTED}
    first = seconds(log, np.array([restart.t_ns for restart in result.restarts]))
    assert ((first > begin) & (first < begin + LENGTH_S + BACK_S)).all()
    assert (result.states.cause[result.states.health == Health.DIVERGED] == Cause.REJECTED).any()
    far = (errors > 2.0 * np.array(LIMITS)).any(axis=1)
    well = np.isin(result.states.health, (Health.HEALTHY, Health.RECOVERED))
    assert (far & well).sum() <= ALERT_S * 10.0


def test_a_height_that_runs_away_is_brought_back(drive: Drive) -> None:
    """Pose fixes hold the place, and all GNSS positions are rejected for their height alone: nothing else knows it."""
    begin = moving_at(drive, 5.0)
    log = with_imu(drive, begin, (0.0, 0.0, 0.0), (1.0, 1.0, 0.7))
    result = run(log)
    s, errors = seconds(log, result.states.t_ns), np.abs(fused_errors(result, drive))
    assert (errors[s > begin] < LIMITS).all()
    high = np.abs(result.states.llh[:, 2] - drive.truth.at(result.states.t_ns).llh[:, 2])
    assert high[(s > begin) & (s < begin + LENGTH_S)].max() > 2.0
    assert high[s > begin + LENGTH_S + BACK_S].max() < 0.2
    gnss = result.decisions.sensor == Sensor.GNSS_POSITION
    late = seconds(log, result.decisions.t_ns[gnss]) > begin + LENGTH_S + BACK_S
    assert (result.decisions.reason[gnss][late] == Reason.ACCEPTED).mean() > 0.99
