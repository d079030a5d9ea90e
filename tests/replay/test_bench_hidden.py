"""The benchmark of hidden stretches: its plan, that a copy goes on as a whole run would, and that peers are right."""

import json
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.baselines import enu_between, moved
from fusion.config import FusionConfig
from fusion.run import run as fuse
from replay.bench import hidden, hidden_egoloc
from replay.bench.hidden_egoloc import Estimates, state_at
from replay.bench.hidden_errors import misses, ratios, rms, rows_of
from replay.bench.hidden_peers import PeerLog, peer_log
from replay.bench.hidden_plan import FIXES, REFERENCE, Plan, plan
from replay.cli import main
from sensors.errors import EgolocError
from sensors.mcap.io import write_log
from sensors.records import GnssStatus, Log
from sensors.simulate.drive import simulate_drive
from sensors.simulate.imu_presets import ImuFlaws
from sensors.simulate.scenarios import load

Floats = NDArray[np.float64]
Captured = pytest.CaptureFixture[str]
SECOND = 1_000_000_000


def easy(seconds: float, seed: int = 7) -> Log:
    """White GNSS at 10 Hz, a tactical IMU that is as its datasheet says."""
    scenario = load("clean")
    without = {name: msgspec.structs.replace(getattr(scenario, name), use=False) for name in ("pose_fix", "wheel")}
    imu = msgspec.structs.replace(scenario.imu, preset="tactical", flaws=ImuFlaws())
    return simulate_drive(seconds, seed, msgspec.structs.replace(scenario, imu=imu, **without)).log


@pytest.fixture(scope="module")
def log() -> Log:
    return easy(130.0)


@pytest.fixture(scope="module")
def planned(log: Log) -> Plan:
    return plan(log, (5.0, 15.0), 10.0, ((40.0, np.inf),))


@pytest.fixture(scope="module")
def drive(log: Log) -> PeerLog:
    return peer_log(log, FusionConfig())


def test_stretches_lie_within_windows_and_log(log: Log, planned: Plan) -> None:
    assert log.gnss is not None
    since = [(s.start_ns - log.gnss.t_ns[0]) / SECOND for s in planned.stretches]
    assert since == [40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 110.0, 120.0]
    assert [sorted(s.ends) for s in planned.stretches] == [[5.0, 15.0]] * 8 + [[5.0]]
    assert planned.unused == {
        5.0: {"outside the windows": 3},
        15.0: {"outside the windows": 3, "no reference at the end": 1},
    }


def test_the_reference_judges_at_the_very_end(log: Log, planned: Plan) -> None:
    """The truth itself, at the body: position to the interpolation's millimetre, yaw from east."""
    truth = simulate_drive(130.0, 7, load("clean")).truth
    assert planned.judge == REFERENCE
    assert not planned.point.any()
    for stretch in planned.stretches:
        for length, end in stretch.ends.items():
            assert end.t_ns == stretch.start_ns + length * SECOND
            motion = truth.at(np.array([end.t_ns]))
            assert np.abs(enu_between(end.llh, motion.llh[0])).max() < 2e-3
            ahead = motion.vel_enu[0]
            if np.hypot(*ahead[:2]) > 3.0:
                assert end.yaw == pytest.approx(np.arctan2(ahead[1], ahead[0]), abs=np.radians(1.0))


def test_without_headings_the_first_fixed_position_judges(log: Log) -> None:
    """At the antenna, at or after the end; float positions judge nothing; the course only where it is straight."""
    assert log.gnss is not None
    status = log.gnss.status.copy()
    since = (log.gnss.t_ns - log.gnss.t_ns[0]) / SECOND
    status[(since >= 64.95) & (since < 65.15)] = GnssStatus.FLOAT
    status[(since >= 84.95) & (since < 85.05)] = GnssStatus.FLOAT
    bare = replace(log, reference=None, gnss=replace(log.gnss, status=status))
    found = plan(bare, (5.0,), 10.0, ((40.0, np.inf),))
    ends = {round((s.start_ns - log.gnss.t_ns[0]) / SECOND): s.ends[5.0] for s in found.stretches}
    assert found.judge == FIXES
    assert found.point.tolist() == list(log.vehicle.gnss_lever_arm)
    assert 60 not in ends
    assert found.unused[5.0]["no fixed position at the end"] == 1
    assert (ends[80].t_ns - log.gnss.t_ns[0]) / SECOND == pytest.approx(85.1)
    assert (ends[50].t_ns - log.gnss.t_ns[0]) / SECOND == pytest.approx(55.0)
    truth = simulate_drive(130.0, 7, load("clean")).truth
    known = [end for end in ends.values() if np.isfinite(end.yaw)]
    assert 0 < len(known) < len(ends)
    for end in known:
        motion = truth.at(np.array([end.t_ns]))
        assert np.hypot(*motion.vel_enu[0, :2]) > 4.5
        assert end.yaw == pytest.approx(np.arctan2(*motion.vel_enu[0, 1::-1]), abs=np.radians(1.5))


def test_a_copy_goes_on_as_a_whole_run_would(log: Log, planned: Plan) -> None:
    """egoloc's end of a stretch is that of a run over the drive without GNSS from the stretch's start on."""
    found = hidden_egoloc.ends(log, planned, FusionConfig())
    assert len(found) == sum(len(s.ends) for s in planned.stretches)
    assert log.gnss is not None
    assert log.gnss_velocity is not None
    for stretch in (planned.stretches[0], planned.stretches[4]):
        seen = log.gnss.t_ns < stretch.start_ns
        states = fuse(replace(log, gnss=log.gnss[seen], gnss_velocity=log.gnss_velocity[seen]), FusionConfig()).states
        for length, end in stretch.ends.items():
            whole, own = state_at(states, end.t_ns, planned.point), found[stretch.start_ns, length]
            assert whole.llh.tolist() == own.llh.tolist()
            assert whole.cov.tolist() == own.cov.tolist()
            assert (whole.yaw, whole.yaw_var) == (own.yaw, own.yaw_var)


def test_states_between_the_outputs(log: Log) -> None:
    """The cubic through places and velocities at 10 Hz, against states at 100 Hz, at the antenna."""
    arm = np.array(log.vehicle.gnss_lever_arm)
    often = fuse(log, msgspec.structs.replace(FusionConfig(), output_hz=100.0)).states
    seldom = fuse(log, FusionConfig()).states
    for row in range(5003, 9000, 277):
        exact = state_at(often, int(often.t_ns[row]), arm)
        between = state_at(seldom, int(often.t_ns[row]), arm)
        assert np.abs(enu_between(exact.llh, between.llh)[:2]).max() < 0.01
        assert between.yaw == pytest.approx(exact.yaw, abs=2e-3)
        np.testing.assert_allclose(between.cov, exact.cov, rtol=0.5, atol=1e-5)


def test_errors_over_sigma_of_honest_estimates_are_one(planned: Plan) -> None:
    """Estimates drawn about the truth with the covariance that they state."""
    rng = np.random.default_rng(5)
    cov = np.array([[4.0, 1.5], [1.5, 1.0]])
    found: list[Any] = []
    for _ in range(200):
        estimates: Estimates = {}
        for stretch in planned.stretches:
            for length, end in stretch.ends.items():
                llh = moved(end.llh, np.append(rng.multivariate_normal(np.zeros(2), cov), 0.0))
                yaw = end.yaw + rng.normal(0.0, 0.02)
                estimates[stretch.start_ns, length] = hidden_egoloc.Estimate(llh, cov, yaw, 0.02**2)
        found += misses(planned, estimates)
    rows = rows_of("log", {"egoloc, all": found, "pyins, positions": found}, (5.0, 15.0), halves=True)
    everything = [row for row in rows if row["part"] == "all"]
    assert len(everything) == 8
    assert all(row["error_over_sigma_rms"] == pytest.approx(1.0, abs=0.06) for row in everything)
    counts = {(row["part"], row["length_s"]): row["count"] for row in rows}
    assert counts["all", 15.0] == 1600
    assert counts["first half", 15.0] + counts["second half", 15.0] < 1600
    assert set(ratios(rows).values()) == {1.0}


def ends_by(peer: str) -> Callable[[PeerLog, Plan], Estimates]:
    if find_spec(peer) is None:
        pytest.skip(f"{peer} is not installed: pip install 'egoloc[bench]'")
    if peer == "gtsam":
        from replay.bench import hidden_gtsam

        return hidden_gtsam.ends
    from replay.bench import hidden_pyins

    return lambda drive, planned: hidden_pyins.ends(drive, planned, (hidden_pyins.POSITION,))


@pytest.mark.parametrize(("peer", "apart"), [("pyins", 0.15), ("gtsam", 0.9)])
def test_peers_are_right_on_an_easy_drive(peer: str, apart: float, log: Log, planned: Plan, drive: PeerLog) -> None:
    """Position only and white, an IMU without scale errors: each ends where egoloc does, in sigmas, and as sure of it.

    gtsam smooths: what it thinks of the time before a stretch is not what a filter thought.
    """
    few = plan_of(planned, slice(0, 5))
    config = hidden.positions_only()
    white = msgspec.structs.replace(config.gnss, white_share=1.0, lasting_share=0.0)
    none = dict.fromkeys(("gyro_scale_ppm", "gyro_misalignment_deg", "accel_scale_ppm", "accel_misalignment_deg"), 0.0)
    rigid = msgspec.structs.replace(log.vehicle.imu, **none)
    known = replace(log, vehicle=msgspec.structs.replace(log.vehicle, imu=rigid))
    own = hidden_egoloc.ends(known, few, msgspec.structs.replace(config, gnss=white))
    found = ends_by(peer)(drive, few)
    assert found.keys() == own.keys()
    assert len(own) == 10
    for key, ours in own.items():
        sigma = np.sqrt(ours.cov.trace())
        assert np.linalg.norm(enu_between(ours.llh, found[key].llh)[:2]) < apart * sigma
        assert np.sqrt(found[key].cov.trace()) == pytest.approx(sigma, rel=0.03)
        assert found[key].yaw == pytest.approx(ours.yaw, abs=2.0 * np.sqrt(ours.yaw_var))
        assert found[key].yaw_var == pytest.approx(ours.yaw_var, rel=0.1)
    missed = list(misses(few, found))
    assert rms([m.squared / 2.0 for m in missed], squared=True) < 1.3


@pytest.mark.slow
def test_pyins_with_motion_updates_is_better(planned: Plan, drive: PeerLog) -> None:
    if find_spec("pyins") is None:
        pytest.skip("pyins is not installed: pip install 'egoloc[bench]'")
    from replay.bench import hidden_pyins as pyins

    few = plan_of(planned, slice(0, 8, 3))
    kinds = (pyins.POSITION,), (pyins.POSITION, pyins.VELOCITY, pyins.LAND)
    plain, aided = (list(misses(few, pyins.ends(drive, few, k))) for k in kinds)
    assert len(aided) == 6
    assert np.mean([m.horizontal for m in aided]) < 0.8 * np.mean([m.horizontal for m in plain])


def plan_of(planned: Plan, some: slice) -> Plan:
    return replace(planned, stretches=planned.stretches[some])


def test_pyins_here_is_its_own_feedback_filter(drive: PeerLog) -> None:
    """Over a second of fixes with the lever arm, from one covariance: run_feedback_filter gives the same state."""
    if find_spec("pyins") is None:
        pytest.skip("pyins is not installed: pip install 'egoloc[bench]'")
    from pandas import DataFrame
    from pyins import filters, inertial_sensor, measurements, strapdown, transform, util
    from pyins.error_model import InsErrorModel

    from replay.bench import hidden_pyins as pyins

    begin = int(drive.begin_ns[0]) + 20 * SECOND
    begin = int(drive.states.t_ns[np.searchsorted(drive.states.t_ns, begin)])
    own = pyins.Filter(drive)
    none = np.zeros(3)
    state = own.start(begin)._replace(gyro_bias=none, accel_bias=none)
    rows = np.flatnonzero((drive.positions.t_ns > begin) & (drive.positions.t_ns <= begin + SECOND))
    sd = 0.02
    cov = np.tile(np.eye(3) * sd**2, (len(drive.positions.t_ns), 1, 1))
    same = replace(drive, positions=replace(drive.positions, cov=cov))
    t = (drive.imu.t_ns - begin) / SECOND
    chosen = slice(state.k, state.k + 103)
    imu = DataFrame(
        np.hstack((drive.imu.gyro * pyins.FRD, drive.imu.accel * pyins.FRD))[chosen],
        index=t[chosen],
        columns=[*util.GYRO_COLS, *util.ACCEL_COLS],
    )
    start = np.concatenate((state.lla, state.velocity, transform.mat_to_rph(state.mat_nb)))
    pva = DataFrame(start[None], index=[t[state.k]], columns=util.TRAJECTORY_COLS).iloc[0]
    sigma = drive.first_state(begin)[5]
    places = np.degrees(drive.positions.value[rows]) * (1.0, 1.0, np.radians(1.0))
    fixes = DataFrame(places, index=(drive.positions.t_ns[rows] - begin) / SECOND, columns=util.LLA_COLS)
    walks = np.sqrt(drive.bias_walk)
    gyro = inertial_sensor.EstimationModel(sigma[9:12], drive.noise.gyro_psd**0.5, walks[0])
    accel = inertial_sensor.EstimationModel(sigma[12:15], drive.noise.accel_psd**0.5, walks[1])
    sds = (sigma[0], sigma[3], np.degrees(sigma[6]), np.degrees(sigma[8]))
    state = state._replace(P=filters._initialize_covariance(pva, *sds, InsErrorModel(), gyro, accel))
    increments = strapdown.compute_increments_from_imu(imu, "rate")
    position = measurements.Position(fixes, sd, drive.arm * pyins.FRD)
    original = filters.run_feedback_filter(pva, *sds, increments, gyro, accel, [position], time_step=1.0)
    events = [pyins.Event(int(drive.positions.t_ns[r]), pyins.POSITION, int(r)) for r in rows]
    found = pyins.Filter(same).run(state, events)
    theirs = original.trajectory.iloc[found.k - state.k]
    apart = transform.compute_lla_difference(found.lla, theirs[util.LLA_COLS].to_numpy())
    assert len(rows) == 10
    assert np.abs(transform.compute_lla_difference(found.lla, state.lla)).max() > 1.0
    assert np.abs(apart).max() < 1e-8
    assert np.abs(transform.mat_to_rph(found.mat_nb) - theirs[util.RPH_COLS].to_numpy()).max() < 1e-8


def test_its_json_and_table(tmp_path: Path, capsys: Captured) -> None:
    write_log(tmp_path / "easy.mcap", easy(60.0))
    given = ["bench", "hidden", str(tmp_path / "easy.mcap"), "--lengths", "5", "--from", "20", "--halves", "--peers"]
    assert main([*given, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result) == {"bench", "rows", "ratios", "conditions"}
    assert {row["name"] for row in result["rows"]} == {"egoloc, positions", "egoloc, all"}
    assert {row["metric"] for row in result["rows"]} == {"end_horizontal_m", "end_yaw_deg"}
    assert {row["part"] for row in result["rows"]} == {"all", "first half", "second half"}
    assert all(row["min"] <= row["median"] <= row["p95"] <= row["max"] for row in result["rows"])
    stretches = result["conditions"]["stretches"]["easy"]["5 s"]
    assert stretches == {"used": 4, "not used": {"outside the windows": 1}}
    assert result["conditions"]["missing"] == ["pyins", "gtsam"]
    assert main(given) == 0
    shown = capsys.readouterr().out
    assert "easy, 5 s, second half" in shown
    assert "judged by the reference" in shown


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["--to", "10", "20"], "--to: expected 1 numbers, one for each of --from, got 2"),
        (["--from", "30", "--to", "20"], "--from, --to: expected 0 <= from < to, got 30 and 20"),
        (["--lengths", "0"], "--lengths: expected seconds from 0.1 to a day, got 0"),
        (["--every", "nan"], "--every: expected seconds from 0.1 to a day, got nan"),
        (["--lengths"], "--lengths: expected at least one length in s, got none"),
        (["--from", "5000"], "expected at least one stretch within the windows and the log, found none"),
    ],
)
def test_mistakes_are_one_line(given: list[str], expected: str, tmp_path: Path, capsys: Captured) -> None:
    write_log(tmp_path / "easy.mcap", easy(40.0))
    assert main(["bench", "hidden", str(tmp_path / "easy.mcap"), "--peers", *given]) == 2
    assert expected in capsys.readouterr().err


def test_logs_without_imu_or_positions_are_refused(log: Log) -> None:
    with pytest.raises(EgolocError, match="expected a log with an IMU"):
        plan(replace(log, imu=None), (15.0,), 10.0, ((0.0, 100.0),))
    with pytest.raises(EgolocError, match="expected a log with GNSS positions"):
        plan(replace(log, gnss=None), (15.0,), 10.0, ((0.0, 100.0),))
