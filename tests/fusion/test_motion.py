"""Zero velocity at rest, and what the wheels forbid."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.result import Decisions, FusionResult, Reason, Sensor
from fusion.run import run
from sensors.geodesy import MapFrame, enu_from_llh, map_from_llh
from sensors.records import Log, PoseFix
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, sense, simulate_drive
from sensors.simulate.trajectory import KNOT_S, Profile, Truth
from sensors.vehicle import Vehicle
from tests.fusion.free import HONEST, Floats, at_rest
from tests.fusion.scenes import only, with_outage

AIDED = ("gnss", "gnss_velocity", "pose_fixes")


def moving_by(**changed: Any) -> FusionConfig:
    """HONEST with another motion model."""
    return msgspec.structs.replace(HONEST, motion=msgspec.structs.replace(HONEST.motion, **changed))


def speed(drive: Drive, t_ns: NDArray[np.int64]) -> Floats:
    """(N,) true speed, m/s."""
    result: Floats = np.linalg.norm(drive.truth.at(t_ns).vel_enu, axis=1)
    return result


def at(decisions: Decisions, sensor: Sensor) -> NDArray[np.int64]:
    """Times at which a motion update was applied or rejected."""
    return decisions.t_ns[decisions.sensor == sensor]


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Five minutes with stops at lights, white errors."""
    return simulate_drive(300.0, 41, scenarios.load("clean"))


@pytest.fixture(scope="module")
def result(drive: Drive) -> FusionResult:
    return run(only(drive.log, *AIDED), HONEST)


def test_rest_is_found_where_the_vehicle_stands_and_only_there(drive: Drive, result: FusionResult) -> None:
    t = result.states.t_ns
    resting = speed(drive, t) == 0.0
    found = np.isin(t, at(result.decisions, Sensor.ZERO_VELOCITY))
    # the window of a second must have passed at rest, and the wait after the start
    settled = np.convolve(resting, np.ones(12), "full")[: len(t)] == 12
    settled &= t - t[0] > HONEST.motion.still_wait_s * 1e9
    print(f"{resting.mean():.2f} of the time at rest; found in {found[settled].mean():.3f} of it once settled")
    assert settled.sum() > 100
    assert found[settled].mean() > 0.95
    rows = result.decisions.sensor == Sensor.ZERO_VELOCITY
    accepted = rows & (result.decisions.reason == Reason.ACCEPTED)
    assert accepted.sum() > 0.95 * rows.sum()
    # a smooth start is quiet as well, until the estimated speed shows it
    assert speed(drive, result.decisions.t_ns[accepted]).max() < 0.2
    assert (speed(drive, result.decisions.t_ns[accepted]) > 0.05).mean() < 0.03


def steady(metres_per_second: float, seconds: float = 60.0) -> Drive:
    """A straight, level line at constant speed: the IMU is as quiet as at rest."""
    none = np.zeros(round(seconds / KNOT_S) + 20)
    profile = Profile(start_s=-2.0, speed=none + metres_per_second, yaw=none + 0.7, grade=none, roll=none)
    truth = Truth(profile, (0.84, 0.2, 560.0), 1_715_673_600_000_000_000)
    return sense(truth, seconds, 42, scenarios.load("clean"))


@pytest.mark.parametrize(
    ("metres_per_second", "sensors"),
    [
        (0.35, AIDED),
        (0.5, AIDED),
        (0.5, (*AIDED, "wheel")),
        (1.0, ("pose_fixes",)),
        (2.0, ("pose_fixes",)),
        (2.0, ("gnss", "pose_fixes")),
        (10.0, ("pose_fixes",)),
    ],
)
def test_steady_driving_is_not_taken_for_rest(metres_per_second: float, sensors: tuple[str, ...]) -> None:
    """Neither by the alignment (velocity zero, rates as bias) nor later: the estimated speed tells them apart."""
    drive = steady(metres_per_second)
    result = run(only(drive.log, *sensors), HONEST)
    states, motion = result.states, drive.truth.at(result.states.t_ns)
    assert len(states) > 550
    applied = (result.decisions.sensor == Sensor.ZERO_VELOCITY) & (result.decisions.reason == Reason.ACCEPTED)
    assert applied.sum() == 0
    error = enu_from_llh(states.llh, motion.llh[0]) - enu_from_llh(motion.llh, motion.llh[0])
    assert np.hypot(error[:, 0], error[:, 1])[100:].max() < 0.2
    assert (result.decisions.reason[result.decisions.sensor == Sensor.POSE_FIX] == Reason.CHI_SQUARE).mean() < 0.01


def test_motion_updates_stay_out_of_vehicles_that_slip(drive: Drive) -> None:
    log = only(drive.log, *AIDED)
    boat = msgspec.structs.replace(log.vehicle, land_vehicle=False)
    decisions = run(
        Log(log.imu, log.gnss, log.gnss_velocity, log.pose_fixes, vehicle=boat, map_frame=log.map_frame)
    ).decisions
    assert (decisions.sensor < Sensor.ZERO_VELOCITY).all()


def test_each_can_be_switched_off(drive: Drive) -> None:
    log = only(drive.log, *AIDED)
    for field, sensor in (("zero_velocity", Sensor.ZERO_VELOCITY), ("non_holonomic", Sensor.NON_HOLONOMIC)):
        assert len(at(run(log, moving_by(**{field: False})).decisions, sensor)) == 0


def test_non_holonomic_waits_for_speed(drive: Drive, result: FusionResult) -> None:
    t = at(result.decisions, Sensor.NON_HOLONOMIC)
    assert speed(drive, t).min() > HONEST.motion.min_speed - 0.3
    fast = speed(drive, result.states.t_ns) > HONEST.motion.min_speed + 0.3
    assert np.isin(result.states.t_ns[fast], t).mean() > 0.99


def end_of_outage(config: FusionConfig, seeds: range, length_s: float, wheel: bool) -> Floats:
    """(N,) horizontal errors at the end of an outage of GNSS and pose fixes."""
    found = []
    for seed in seeds:
        drive = simulate_drive(60.0 + length_s, 700 + seed, scenarios.load("clean"))
        names = (*AIDED, "wheel") if wheel else AIDED
        result = run(with_outage(only(drive.log, *names), 58.0, length_s + 5.0), config)
        motion = drive.truth.at(result.states.t_ns[-1:])
        found.append(float(np.hypot(*enu_from_llh(result.states.llh[-1:], motion.llh[0])[0, :2])))
    return np.array(found)


def test_non_holonomic_and_wheel_reduce_the_drift_of_an_outage() -> None:
    """Thirty seconds without GNSS and pose fixes, the same twelve drives."""
    seeds, length = range(12), 30.0
    free = end_of_outage(moving_by(non_holonomic=False, zero_velocity=False), seeds, length, wheel=False)
    bound = end_of_outage(HONEST, seeds, length, wheel=False)
    wheeled = end_of_outage(HONEST, seeds, length, wheel=True)
    medians = [float(np.median(x)) for x in (free, bound, wheeled)]
    free_m, bound_m, wheeled_m = medians
    print(f"median error after {length:g} s: free {free_m:.2f}, non-holonomic {bound_m:.2f}, wheel {wheeled_m:.2f} m")
    assert medians[1] < 0.7 * medians[0]
    assert medians[2] < 0.7 * medians[1]


def test_rest_makes_the_gyro_bias_known() -> None:
    """A drive that begins at rest, pose fixes alone: with zero rate the bias about the vertical is known better."""
    drive = simulate_drive(60.0, 43, scenarios.load("clean"))
    log = only(drive.log, "pose_fixes")
    assert log.imu is not None
    standing = float((np.flatnonzero(speed(drive, log.imu.t_ns) > 0)[0]) / 100.0)
    assert standing > 3.0, "this drive is meant to begin at rest"
    sigma = []
    for config in (moving_by(zero_velocity=False), moving_by(zero_rate_sigma_deg=0.02)):
        states = run(log, config).states
        k = int(np.searchsorted(states.t_ns, log.imu.t_ns[0] + round(standing * 1e9))) - 1
        sigma.append(np.degrees(states.sigma[k, 9:12]) * 3600)
        row = int(np.searchsorted(log.imu.t_ns, states.t_ns[k]))
        error = np.degrees(states.gyro_bias[k] - drive.imu_biases.gyro[row]) * 3600
        assert (np.abs(error) < 3.5 * sigma[-1]).all()
    print(
        f"gyro bias sigma after {standing:.1f} s at rest, deg/h: {sigma[0].round(1)} without, {sigma[1].round(1)} with"
    )
    assert (sigma[1] < sigma[0]).all()


@pytest.mark.parametrize("speed_m_s", [0.0, 0.4, 0.6, 1.0, 1.5])
def test_a_steady_creep_from_the_start_is_not_rest(speed_m_s: float) -> None:
    """Pose fixes alone, 5 cm, and an IMU as quiet as at rest: only the fixes show that it moves, after seconds."""
    frame = MapFrame("enu", (49.0, 8.4, 110.0))
    t = 10**18 + np.arange(3001) * 10_000_000
    nav = np.zeros(17)
    nav[:3], nav[3], nav[9] = (np.radians(49.0), np.radians(8.4), 110.0), speed_m_s, 1.0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        imu = at_rest(nav, t)
        imu = replace(
            imu, accel=imu.accel + rng.normal(0.0, 0.02, (3001, 3)), gyro=imu.gyro + rng.normal(0.0, 2e-4, (3001, 3))
        )
        at_ns, sigma = t[10::10], np.array([0.05, 0.05, np.radians(0.1)])
        way = np.outer(speed_m_s * (at_ns - t[0]) * 1e-9, [1.0, 0.0, 0.0])
        pose, cov = way + sigma * rng.normal(size=way.shape), np.tile(np.diag(sigma**2), (len(at_ns), 1, 1))
        fixes = PoseFix(at_ns, at_ns, pose, cov)
        result = run(Log(imu=imu, pose_fixes=fixes, vehicle=Vehicle(), map_frame=frame))
        error = map_from_llh(frame, result.states.llh)[:, 0] - speed_m_s * (result.states.t_ns - t[0]) * 1e-9
        rests = (result.decisions.sensor == Sensor.ZERO_VELOCITY).sum()
        assert np.abs(error).max() < 0.3
        assert (rests > 200) == (speed_m_s == 0.0)
