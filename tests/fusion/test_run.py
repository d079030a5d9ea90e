"""The batch run on whole logs: bad input, gaps, decisions, reproducibility, accuracy."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fusion.config import FusionConfig, Gates
from fusion.result import FusionResult, Reason, Sensor
from fusion.run import run
from fusion.sensor_models import GnssModel, ImuNoise, MotionModel, PoseModel
from sensors.errors import EgolocError
from sensors.geodesy import enu_from_llh
from sensors.records import GnssStatus
from sensors.rotation import wrap, yaw_from_q
from sensors.simulate import scenarios
from sensors.simulate.drive import Drive, simulate_drive
from tests.fusion.free import HONEST, Floats
from tests.fusion.scenes import later, only, with_gap, without

DEMO = msgspec.structs.replace(
    HONEST,
    imu=ImuNoise(noise_scale=1.5, max_gap_s=0.5, coast_accel=3.0, coast_rate_deg=20.0),
    gnss=GnssModel(
        inflation=4.0,
        velocity_inflation=1.0,
        sigma_floor_horizontal_m=0.02,
        sigma_floor_vertical_m=0.05,
        sigma_floor_velocity=0.03,
        min_status=GnssStatus.SINGLE,
    ),
    pose=msgspec.structs.replace(HONEST.pose, inflation=2.0, sigma_floor_m=0.02, sigma_floor_yaw_deg=0.05),
)
"""Inflation for errors that are correlated in time."""


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Three minutes with float, lost and blind stretches."""
    return simulate_drive(180.0, 31, scenarios.load("demo"))


@pytest.fixture(scope="module")
def result(drive: Drive) -> FusionResult:
    return run(drive.log, DEMO)


def errors(result: FusionResult, drive: Drive) -> tuple[Floats, Floats]:
    """(N, 3) ENU m and (N,) yaw rad, estimate minus truth."""
    motion = drive.truth.at(result.states.t_ns)
    datum = motion.llh[0]
    place = enu_from_llh(result.states.llh, datum) - enu_from_llh(motion.llh, datum)
    return place, wrap(yaw_from_q(result.states.q_enu_body) - yaw_from_q(motion.q_enu_body))


def test_accuracy_on_the_demo_scenario(drive: Drive, result: FusionResult) -> None:
    place, yaw = errors(result, drive)
    horizontal = np.hypot(place[:, 0], place[:, 1])
    rms, most, yaw_rms = np.sqrt((horizontal**2).mean()), horizontal.max(), np.degrees(np.sqrt((yaw**2).mean()))
    print(f"demo, 180 s: horizontal RMS {rms:.3f} m, largest {most:.3f} m, yaw RMS {yaw_rms:.3f} deg")
    assert rms < 0.06
    assert most < 0.3
    assert yaw_rms < 0.15
    assert np.abs(place[:, 2]).max() < 0.6
    assert result.left_out == ()


def test_states_lie_on_the_output_grid_from_alignment_to_the_last_sample(drive: Drive, result: FusionResult) -> None:
    assert drive.log.imu is not None
    assert result.aligned_ns is not None
    t = result.states.t_ns
    assert (t % 100_000_000 == 0).all()
    assert (np.diff(t) == 100_000_000).all()
    assert 0 <= t[0] - result.aligned_ns <= 100_000_000
    assert 0 <= drive.log.imu.t_ns[-1] - t[-1] < 100_000_000


@pytest.mark.parametrize("imu", [None, 0, 1])
def test_log_without_imu(drive: Drive, imu: int | None) -> None:
    assert drive.log.imu is not None
    log = replace(drive.log, imu=None if imu is None else drive.log.imu[:imu])
    with pytest.raises(EgolocError, match=r"no IMU samples: expected sensor_msgs/msg/Imu"):
        run(log)


def test_pose_fixes_without_map_frame(drive: Drive) -> None:
    with pytest.raises(EgolocError, match=r"pose fixes but no map frame: expected \[map_frame\]"):
        run(replace(drive.log, map_frame=None))


@pytest.mark.parametrize(
    ("config", "key"),
    [
        (FusionConfig(gates=Gates(probability=0.49)), "gates.probability: expected 0.5..1, got 0.49"),
        (FusionConfig(gates=Gates(probability=1.0)), "gates.probability: expected 0.5..1, got 1.0"),
        (FusionConfig(output_hz=0.0), "output_hz: expected a number above zero, got 0.0"),
        (FusionConfig(output_hz=-10.0), "output_hz: expected"),
        (FusionConfig(motion=MotionModel(rate_hz=0.0)), "motion.rate_hz: expected"),
        (FusionConfig(imu=ImuNoise(noise_scale=float("nan"))), "imu.noise_scale: expected .* got nan"),
        (FusionConfig(gnss=GnssModel(inflation=float("inf"))), "gnss.inflation: expected .* got inf"),
        (FusionConfig(pose=PoseModel(max_sigma_lateral_m=0.0)), "pose.max_sigma_lateral_m: expected"),
    ],
)
def test_config_that_cannot_run(drive: Drive, config: FusionConfig, key: str) -> None:
    with pytest.raises(EgolocError, match=rf"config: fusion\.{key}"):
        run(drive.log, config)


def test_every_measurement_has_exactly_one_decision(drive: Drive, result: FusionResult) -> None:
    log, decisions = drive.log, result.decisions
    names = {Sensor.GNSS_POSITION: "gnss", Sensor.GNSS_VELOCITY: "gnss_velocity", Sensor.POSE_FIX: "pose_fixes"}
    for sensor, name in (*names.items(), (Sensor.WHEEL, "wheel")):
        rows = decisions.row[decisions.sensor == sensor]
        assert np.array_equal(np.sort(rows), np.arange(len(getattr(log, name)))), sensor
    assert (decisions.row[decisions.sensor >= Sensor.ZERO_VELOCITY] == -1).all()
    assert (decisions.reason == Reason.USED_FOR_ALIGNMENT).sum() == 1
    applied = np.isin(decisions.reason, (Reason.ACCEPTED, Reason.PARTLY_ACCEPTED))
    assert np.isfinite(decisions.nis[applied]).all()
    assert (decisions.nis[applied] <= decisions.threshold[applied]).all()
    assert (decisions.dof[applied] > 0).all()
    after = decisions.t_ns > result.aligned_ns
    assert (np.diff(decisions.t_ns[after]) >= 0).all()


def test_the_same_log_twice_gives_the_same_bytes(drive: Drive, result: FusionResult) -> None:
    again = run(drive.log, DEMO)
    for part in ("states", "decisions"):
        one, other = getattr(result, part), getattr(again, part)
        for name in one.__dataclass_fields__:
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name


def test_the_log_is_not_changed(drive: Drive) -> None:
    log = drive.log
    assert log.imu is not None
    assert log.gnss is not None
    before = (log.imu.gyro.tobytes(), log.gnss.llh.tobytes(), log.gnss.cov_enu.tobytes())
    run(log, DEMO)
    assert before == (log.imu.gyro.tobytes(), log.gnss.llh.tobytes(), log.gnss.cov_enu.tobytes())


def test_gnss_before_the_first_imu_sample(drive: Drive) -> None:
    """Measurements before and after the IMU are counted, and the rest runs."""
    assert drive.log.imu is not None
    log = replace(drive.log, imu=drive.log.imu[2000:10_000])
    result = run(log, DEMO)
    assert log.imu is not None
    decisions = result.decisions
    early, late = decisions.t_ns < log.imu.t_ns[0], decisions.t_ns > log.imu.t_ns[-1]
    assert early.sum() > 100
    assert late.sum() > 100
    assert (decisions.reason[early] == Reason.BEFORE_ALIGNMENT).all()
    assert (decisions.reason[late] == Reason.OUTSIDE_IMU).all()
    assert len(result.states) > 750
    place, _ = errors(result, drive)
    assert np.hypot(*place[-1, :2]) < 0.3


def test_gnss_that_never_meets_the_imu(drive: Drive) -> None:
    assert drive.log.imu is not None
    log = replace(later(drive.log, 100.0), imu=drive.log.imu[:5000])
    result = run(log, DEMO)
    assert result.aligned_ns is None
    assert len(result.states) == 0
    assert (result.decisions.reason == Reason.BEFORE_ALIGNMENT).all()


def test_never_aligned_gives_empty_states(drive: Drive) -> None:
    """An IMU alone."""
    result = run(only(drive.log), DEMO)
    assert result.aligned_ns is None
    assert len(result.states) == 0
    assert result.states.pose_cov.shape == (0, 6, 6)
    assert len(result.decisions.t_ns) == 0


def test_imu_gap_is_counted_and_coasted(drive: Drive) -> None:
    """Three seconds without IMU and without fixes: sigma grows in them and the filter recovers."""
    log, begin, length = drive.log, 90.0, 3.0
    blind = replace(
        with_gap(log, begin, length),
        gnss=without(log.gnss, log, begin, begin + length),
        gnss_velocity=without(log.gnss_velocity, log, begin, begin + length),
        pose_fixes=without(log.pose_fixes, log, begin, begin + length),
        wheel=None,
    )
    result = run(blind, DEMO)
    assert [(x.source, x.count) for x in result.left_out] == [("imu", 1)]
    assert "gap over 0.5 s" in result.left_out[0].reason
    assert log.imu is not None
    s = (result.states.t_ns - log.imu.t_ns[0]) * 1e-9
    sigma = np.hypot(*result.states.sigma[:, :2].T)
    inside = (s > begin + 0.05) & (s < begin + length)
    assert inside.sum() > 25  # states come out in the gap as well
    assert (np.diff(sigma[inside]) > 0).all()
    assert sigma[inside][-1] > 20 * sigma[s < begin][-1]
    place, yaw = errors(result, drive)
    horizontal = np.hypot(place[:, 0], place[:, 1])
    assert (horizontal[inside] < 4 * sigma[inside] + 0.1).all()
    after = s > begin + length + 5.0
    assert horizontal[after].max() < 0.3
    assert sigma[after].max() < 0.2
    assert np.degrees(np.abs(yaw[after])).max() < 0.6


def test_measurements_inside_a_gap_are_used(drive: Drive) -> None:
    log = with_gap(drive.log, 90.0, 3.0)
    result = run(log, DEMO)
    assert drive.log.imu is not None
    s = (result.decisions.t_ns - drive.log.imu.t_ns[0]) * 1e-9
    inside = (s > 90.1) & (s < 92.9) & (result.decisions.sensor == Sensor.POSE_FIX)
    assert np.isin(result.decisions.reason[inside], (Reason.ACCEPTED, Reason.PARTLY_ACCEPTED)).mean() > 0.9
    place, _ = errors(result, drive)
    t = (result.states.t_ns - drive.log.imu.t_ns[0]) * 1e-9
    assert np.hypot(place[:, 0], place[:, 1])[(t > 90) & (t < 93)].max() < 1.0


def test_status_gate(drive: Drive) -> None:
    """Fixed solutions only: every other one is recorded with its reason and none is applied."""
    config = msgspec.structs.replace(DEMO, gnss=msgspec.structs.replace(DEMO.gnss, min_status=GnssStatus.FIXED))
    result = run(drive.log, config)
    assert drive.log.gnss is not None
    decisions = result.decisions
    rows = decisions.sensor == Sensor.GNSS_POSITION
    status = drive.log.gnss.status[decisions.row[rows]]
    assert (status < GnssStatus.FIXED).any()
    assert ((decisions.reason[rows] == Reason.STATUS) == (status < GnssStatus.FIXED)).all()


def test_fix_without_a_solution_is_never_applied(drive: Drive) -> None:
    assert drive.log.gnss is not None
    log = replace(drive.log, gnss=replace(drive.log.gnss, status=np.zeros(len(drive.log.gnss), np.int8)))
    config = msgspec.structs.replace(DEMO, gnss=msgspec.structs.replace(DEMO.gnss, min_status=0))
    reasons = run(log, config).decisions
    assert (reasons.reason[reasons.sensor == Sensor.GNSS_POSITION] == Reason.STATUS).all()


OFF = {
    Sensor.GNSS_POSITION: msgspec.structs.replace(DEMO, gnss=GnssModel(use=False)),
    Sensor.GNSS_VELOCITY: msgspec.structs.replace(DEMO, gnss=GnssModel(use_velocity=False)),
    Sensor.POSE_FIX: msgspec.structs.replace(DEMO, pose=PoseModel(use=False)),
    Sensor.WHEEL: msgspec.structs.replace(DEMO, motion=MotionModel(wheel=False)),
}


@pytest.mark.parametrize("sensor", list(OFF))
def test_switched_off_sensor(drive: Drive, sensor: Sensor) -> None:
    result = run(drive.log, OFF[sensor])
    reasons = result.decisions.reason[result.decisions.sensor == sensor]
    assert len(reasons) > 0
    assert (reasons == Reason.SWITCHED_OFF).all()
    assert len(result.states) > (1000 if sensor == Sensor.POSE_FIX else 1700)  # then the course gives the first yaw
    others = result.decisions.reason[result.decisions.sensor != sensor]
    assert (others == Reason.SWITCHED_OFF).any() == (sensor == Sensor.GNSS_POSITION)  # with it goes the velocity


def test_yaw_without_sigma_is_no_measurement(drive: Drive) -> None:
    """A heading whose accuracy is unknown must not reach the filter as NaN."""
    assert drive.log.gnss is not None
    fixes = replace(drive.log.gnss, yaw=np.zeros(len(drive.log.gnss)), yaw_sigma=None)
    result = run(replace(drive.log, gnss=fixes), DEMO)
    assert np.isfinite(result.states.sigma).all()
    assert (result.decisions.sensor != Sensor.GNSS_YAW).all()


def test_delays_move_measurements_to_when_they_were_true(drive: Drive) -> None:
    """GNSS stamped 0.2 s late is as good as before once the vehicle says so."""
    log, delay = drive.log, 200_000_000
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    late = replace(
        log,
        gnss=replace(log.gnss, t_ns=log.gnss.t_ns + delay),
        gnss_velocity=replace(log.gnss_velocity, t_ns=log.gnss_velocity.t_ns + delay),
        vehicle=msgspec.structs.replace(log.vehicle, gnss_delay_s=0.2, gnss_velocity_delay_s=0.2),
    )
    one, other = run(log, DEMO).states, run(late, DEMO).states
    assert np.array_equal(one.llh, other.llh)
    assert np.array_equal(one.pose_cov, other.pose_cov)
