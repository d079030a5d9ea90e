"""The smoother against plain dense RTS on the same steps, against itself cut in pieces, and against the truth."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import fusion.tape
from fusion.config import FusionConfig, HealthModel
from fusion.layout import layout_of
from fusion.result import States
from fusion.run import Session, run
from fusion.smoother import smooth, smoothed
from fusion.tape import Tape
from sensors.records import Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate, simulate_drive
from sensors.simulate.trajectory import Truth
from tests.fusion.dense_rts import Watch, rts
from tests.fusion.free import HONEST_FREE
from tests.fusion.scenes import later, only, seconds, with_gap, with_outage, without
from tests.fusion.test_consistency import pose_and_velocity_nees
from tests.fusion.test_session import assert_same, cuts_of, pieces

Floats = NDArray[np.float64]

GNSS, BEGINS = ("gnss", "gnss_velocity"), (50.0, 100.0, 150.0, 200.0)
TOLERANCE = 1e-6
"""In smoothed sigmas: the oracle inverts covariances."""


def rough(log: Log) -> Log:
    """A bridged gap in the IMU, a long one, GNSS and pose fixes that leave the state for good at once, and a receiver
    that states more from then on."""
    log = with_gap(with_gap(log, 8.0, 1.5), 20.0, 4.0)
    assert log.gnss is not None
    assert log.pose_fixes is not None
    assert log.imu is not None
    away = log.imu.t_ns[0] + 30 * 10**9
    llh, pose = log.gnss.llh.copy(), log.pose_fixes.pose.copy()
    llh[log.gnss.t_ns > away, 0] += 5.0 / 6.37e6
    pose[log.pose_fixes.t_ns > away, 1] += 5.0
    cov = log.gnss.cov_enu * np.where(log.gnss.t_ns > away + 5 * 10**9, 9.0, 1.0)[:, None, None]
    return replace(log, gnss=replace(log.gnss, llh=llh, cov_enu=cov), pose_fixes=replace(log.pose_fixes, pose=pose))


SURE = FusionConfig(health=HealthModel(blown_sigma_m=0.12))
"""A state that is not known to twelve centimetres counts as diverged, and alignment begins anew."""


@pytest.fixture(scope="module")
def log() -> Log:
    """Forty seconds with a standstill, all sensors, an IMU whose scale and mounting are known roughly: all blocks."""
    drive = later(simulate(70.0, 2, scenarios.load("demo")), 30.0)
    imu = msgspec.structs.replace(drive.vehicle.imu, gyro_scale_ppm=3000.0, gyro_misalignment_deg=0.3)
    return replace(drive, vehicle=msgspec.structs.replace(drive.vehicle, imu=imu))


ALWAYS = {"move", "correct", "state", "fade"}
SCENES: dict[str, tuple[Callable[[Log], Log], set[str]]] = {
    "whole": (lambda log: log, set()),
    "rough": (rough, {"coast", "widen", "give way", "renew"}),
    "cut": (lambda log: with_outage(log, 12.0, 14.0), {"cut"}),
}


@pytest.mark.parametrize("scene", SCENES)
def test_equals_dense_rts(log: Log, scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """State by state to rounding, in units of the smoothed sigma, over every kind of step, with all blocks."""
    change, more = SCENES[scene]
    drive, config = change(log), SURE if scene == "cut" else FusionConfig()
    layout = layout_of(drive.vehicle, config)
    assert min(layout.gnss_error, layout.pose_error, layout.gyro_scale, layout.gyro_misalignment) >= 16
    result, states = smooth(drive, config)
    with monkeypatch.context() as patch:
        watch = Watch(patch, layout)
        run(drive, config)
    expected = rts(watch.steps)
    assert watch.kinds >= ALWAYS | more
    assert len(result.restarts) == (scene == "cut")
    assert states.t_ns.tolist() == result.states.t_ns.tolist() == sorted(expected)
    moved = np.concatenate([displacement(result.states, states), states.vel_enu - result.states.vel_enu], axis=1)
    moved = np.concatenate([moved, turn(result.states, states), states.gyro_bias - result.states.gyro_bias], axis=1)
    moved = np.concatenate([moved, states.accel_bias - result.states.accel_bias], axis=1)
    pose = np.r_[0:3, 6:9]
    for i, t in enumerate(states.t_ns.tolist()):
        d, P = expected[t]
        sigma = np.sqrt(np.diag(P))
        assert states.sigma[i] == pytest.approx(sigma[:15], rel=TOLERANCE)
        assert np.abs((moved[i] - d[:15]) / sigma[:15]).max() < TOLERANCE
        apart = states.pose_cov[i] - P[np.ix_(pose, pose)]
        assert np.abs(apart / np.outer(sigma[pose], sigma[pose])).max() < TOLERANCE
    assert np.abs(moved / states.sigma).max() > 1.0  # it did something


def test_portions_and_pieces_change_no_bit(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither where the tape is cut, nor the drive; and the filter does not notice that it is taken down."""
    drive, config = rough(log), FusionConfig(output_hz=20.0)
    plain = run(drive, config)
    result, whole = smooth(drive, config)
    assert_same(plain, result)
    monkeypatch.setattr(fusion.tape, "PORTION", 20_000)
    for seed in range(3):
        tape = Tape()
        session = Session(drive.vehicle, drive.map_frame, config, tape)
        for piece in pieces(drive, cuts_of(drive, seed)):
            session.push(piece)
        session.finish()
        parts = list(smoothed(tape))
        assert len(parts) > 10
        for name in whole.__dataclass_fields__:
            found = np.concatenate([getattr(part, name) for part in parts])
            assert found.tobytes() == getattr(whole, name).tobytes(), name


@pytest.mark.parametrize("portion", [1, 3_000, 100_000])
def test_the_tape_never_needs_more_than_was_set_aside(log: Log, portion: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With events of every kind at every sample, and gaps: ``Tape.keep`` raises where numbers did not fit."""
    monkeypatch.setattr(fusion.tape, "PORTION", portion)
    result, states = smooth(rough(log), FusionConfig(output_hz=100.0))
    assert len(states) == len(result.states) > 3000
    assert np.isfinite(states.sigma).all()


def test_states_before_a_new_start_learn_nothing_from_after_it(log: Log) -> None:
    """Whatever comes behind it moves them by no bit; the cut may lie anywhere in the portions."""
    drive = with_outage(log, 12.0, 14.0)
    result, states = smooth(drive, SURE)
    (restart,) = result.restarts
    before = states.t_ns <= restart.t_ns
    assert 200 < before.sum() < len(states) - 100
    assert drive.pose_fixes is not None
    pose = drive.pose_fixes.pose + np.where(drive.pose_fixes.t_ns > restart.t_ns, 3.0, 0.0)[:, None] * [1.0, 1.0, 0.0]
    other = replace(drive, gnss=None, gnss_velocity=None, pose_fixes=replace(drive.pose_fixes, pose=pose))
    kept = {name: getattr(drive, name)[getattr(drive, name).t_ns <= restart.t_ns] for name in ("gnss", "gnss_velocity")}
    moved, others = smooth(replace(other, **kept), SURE)
    assert moved.restarts == result.restarts
    assert others.llh[before].tobytes() == states.llh[before].tobytes()
    assert others.sigma[before].tobytes() == states.sigma[before].tobytes()
    assert np.abs(others.llh - states.llh)[~before].max() > 1e-7  # rad: metres


def test_a_drive_that_never_aligns_has_no_smoothed_states(log: Log) -> None:
    result, states = smooth(only(log, "wheel"))
    assert result.aligned_ns is None
    assert len(states) == 0


def test_consistent_and_better_than_the_filter_through_outages() -> None:
    """White noise, honest figures: NEES as stated; within outages the largest error falls on every drive."""
    scores = []
    for seed in range(12):
        drive = simulate_drive(70.0, 2000 + seed, scenarios.load("clean"))
        log = with_outage(drive.log, 25.0, 30.0)
        result, states = smooth(log, HONEST_FREE)
        after = replace(result, states=states)
        pose, velocity = pose_and_velocity_nees(after, drive.truth)
        scores.append((pose.mean() / 6, velocity.mean() / 3))
        hidden = (seconds(log, states.t_ns) > 25.0) & (seconds(log, states.t_ns) < 55.0)
        assert hidden.sum() > 290
        before, then = (worst(of, drive.truth, hidden) for of in (result.states, states))
        assert then < 0.5 * before
        assert (states.sigma <= result.states.sigma * (1 + 1e-6)).all()
    mean = np.mean(scores, axis=0)
    print(f"NEES per degree of freedom: pose {mean[0]:.3f}, velocity {mean[1]:.3f}")
    assert mean == pytest.approx([1.0, 1.0], abs=0.25)


@pytest.mark.parametrize("grade", ["tactical", "automotive", "consumer"])
def test_better_than_the_filter_in_every_hidden_stretch(grade: str) -> None:
    """GNSS and IMU alone, half a minute hidden of every fifty seconds, against the truth; the vehicle also stands."""
    scene = scenarios.load("clean")
    scene = msgspec.structs.replace(scene, imu=msgspec.structs.replace(scene.imu, preset=grade))
    for seed in (100_004, 100_005):
        drive = simulate_drive(240.0, seed, scene)
        log = replace(drive.log, pose_fixes=None, wheel=None)
        for begin in BEGINS:
            log = replace(log, **{n: without(getattr(log, n), log, begin, begin + 30.0) for n in GNSS})
        result, states = smooth(log)
        s = seconds(log, states.t_ns)
        for begin in BEGINS:
            rows = (s > begin) & (s < begin + 30.0)
            before, after = (worst(of, drive.truth, rows) for of in (result.states, states))
            assert after < before, (seed, begin)


def test_a_minute_without_imu(log: Log) -> None:
    """P grows to 700 m and falls to a centimetre at the first fix: no digit is lost that smoothing needs."""
    assert log.imu is not None
    middle = int(log.imu.t_ns[2000])
    pause = 60 * 10**9

    def apart(record: Any) -> Any:
        return record and replace(record, t_ns=record.t_ns + np.where(record.t_ns > middle, pause, 0))

    names = ("imu", "gnss", "gnss_velocity", "pose_fixes", "wheel")
    drive = replace(log, reference=None, **{name: apart(getattr(log, name)) for name in names})
    result, states = smooth(drive, FusionConfig(health=HealthModel(restart=False)))
    assert np.linalg.eigvalsh(states.pose_cov).min() > 0.0
    horizontal = np.hypot(states.sigma[:, 0], states.sigma[:, 1])
    inside = (states.t_ns > middle) & (states.t_ns < middle + pause)
    assert 100.0 < horizontal[inside].max() < 0.2 * result.states.sigma[inside, :2].max()
    assert horizontal[~inside].max() < 0.05


def worst(of: States, truth: Truth, rows: NDArray[np.bool_]) -> float:
    """Largest horizontal error, m."""
    known = truth.at(of.t_ns[rows]).llh
    d = known - of.llh[rows]
    meridian, transverse = radii_of(known[:, 0])
    return float(np.hypot(d[:, 0] * meridian, d[:, 1] * transverse * np.cos(known[:, 0])).max())


def displacement(of: States, to: States) -> Floats:
    """(N, 3) ENU m."""
    meridian, transverse = radii_of(of.llh[:, 0])
    d = to.llh - of.llh
    east = d[:, 1] * (transverse + of.llh[:, 2]) * np.cos(of.llh[:, 0])
    return np.stack((east, d[:, 0] * (meridian + of.llh[:, 2]), d[:, 2]), axis=-1)


def radii_of(latitude: Floats) -> tuple[Floats, Floats]:
    a, e2 = 6378137.0, 6.69437999014e-3
    w = 1.0 - e2 * np.sin(latitude) ** 2
    return a * (1 - e2) / w**1.5, a / np.sqrt(w)


def turn(of: States, to: States) -> Floats:
    """(N, 3) rotation vector on the left, rad."""
    delta = Rotation.from_quat(to.q_enu_body) * Rotation.from_quat(of.q_enu_body).inv()
    result: Floats = delta.as_rotvec()
    return result
