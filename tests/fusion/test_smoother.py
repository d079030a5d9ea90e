"""The smoother against plain dense RTS on the same steps, against itself cut in pieces, and against the truth."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import fusion._kernels
import fusion.motion
import fusion.navigator
import fusion.tape
from fusion.config import FusionConfig
from fusion.result import States
from fusion.run import Session, run
from fusion.smoother import smooth, smoothed
from fusion.state import Core
from fusion.tape import Tape
from sensors.records import Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate, simulate_drive
from sensors.simulate.trajectory import Truth
from tests.fusion.free import HONEST_FREE
from tests.fusion.scenes import later, only, seconds, with_gap, with_outage
from tests.fusion.test_consistency import pose_and_velocity_nees
from tests.fusion.test_session import assert_same, cuts_of, pieces

Floats = NDArray[np.float64]

TOLERANCE = 1e-6
"""In smoothed sigmas: the oracle inverts covariances."""


class Step(NamedTuple):
    """One thing that happened to P: before and after; Phi of a transition, or dx of a correction, or t of a state."""

    before: Floats
    after: Floats
    phi: Floats | None = None
    dx: Floats | None = None
    t_ns: int | None = None


class Watch:
    """Runs the kernel's loop as plain Python and writes down every step, without any tape."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.steps: list[Step] = []
        self.kinds: set[str] = set()
        kernels, motion = fusion._kernels, fusion.motion
        for name in ("_handle", "_apply", "_coast", "motion"):
            patch.setattr(kernels, name, getattr(kernels, name).py_func)
        patch.setattr(motion, "_zero_rate", motion._zero_rate.py_func)
        patch.setattr(fusion.navigator, "process", kernels.process.py_func)
        real: dict[str, Callable[..., Any]] = {
            name: getattr(kernels, name)
            for name in ("_move", "propagate", "coast", "widen", "correct", "doubted", "record_state")
        }

        def move(core: Core, par: Any) -> None:
            if core.span[0] != 0.0:
                before = core.P.copy()
                real["_move"](core, par)
                phi = np.diag(core.stay)
                phi[:9] = 0.0
                phi[:9, : core.phi.shape[1]] = core.phi
                self._add("move", Step(before, core.P.copy(), phi=phi))

        def coast(P: Floats, seconds: float, accel: float, rate: float) -> None:
            before, phi = P.copy(), np.eye(len(P))
            phi[:3, 3:6] = seconds * np.eye(3)
            real["coast"](P, seconds, accel, rate)
            self._add("coast", Step(before, P.copy(), phi=phi))

        def widen(P: Floats, *given: float) -> None:
            before = P.copy()
            real["widen"](P, *given)
            self._add("widen", Step(before, P.copy(), phi=np.eye(len(P))))

        def doubted(core: Core, *given: Any) -> None:
            before = core.P.copy()
            real["doubted"](core, *given)
            if not np.array_equal(before, core.P):
                self._add("give way", Step(before, core.P.copy(), phi=np.eye(len(before))))

        def correct(nav: Floats, earth: Floats, P: Floats, W: Floats, dx: Floats, *given: Any) -> None:
            before = P.copy()
            real["correct"](nav, earth, P, W, dx, *given)
            self._add("correct", Step(before, P.copy(), dx=dx.copy()))

        def record_state(core: Core, rec: Any, t: int) -> None:
            real["record_state"](core, rec, t)
            self._add("state", Step(core.P.copy(), core.P.copy(), t_ns=t))

        for name, function in (
            *(("_move", move), ("coast", coast), ("widen", widen), ("doubted", doubted)),
            *(("correct", correct), ("record_state", record_state)),
        ):
            patch.setattr(kernels, name, function)
        patch.setattr(motion, "correct", correct)

    def _add(self, kind: str, step: Step) -> None:
        self.kinds.add(kind)
        self.steps.append(step)


def skew(v: Floats) -> Floats:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def reset_matrix(dx: Floats) -> Floats:
    G = np.eye(len(dx))
    G[6:9, 6:9] += 0.5 * skew(dx[6:9])
    return G


def rts(steps: list[Step]) -> dict[int, tuple[Floats, Floats]]:
    """t -> smoothed error and covariance: Rauch, Tung and Striebel's recursion on dense matrices."""
    found = {}
    P = steps[-1].after
    assert (np.diag(P) > 0).all()  # it is inverted
    d = np.zeros(len(P))
    for step in reversed(steps):
        if step.phi is not None:
            C = np.linalg.solve(step.after, step.phi @ step.before).T
            d = C @ d
            P = step.before + C @ (P - step.after) @ C.T
        elif step.dx is not None:
            back = np.linalg.inv(reset_matrix(step.dx))
            d = back @ d + step.dx
            P = back @ P @ back.T
        else:
            assert step.t_ns is not None
            G = reset_matrix(d)
            found[step.t_ns] = d, G @ P @ G.T
    return found


def rough(log: Log) -> Log:
    """A bridged gap in the IMU, a long one, and GNSS and pose fixes that leave the state for good at once."""
    log = with_gap(with_gap(log, 8.0, 1.5), 20.0, 4.0)
    assert log.gnss is not None
    assert log.pose_fixes is not None
    assert log.imu is not None
    away = log.imu.t_ns[0] + 30 * 10**9
    llh, pose = log.gnss.llh.copy(), log.pose_fixes.pose.copy()
    llh[log.gnss.t_ns > away, 0] += 5.0 / 6.37e6
    pose[log.pose_fixes.t_ns > away, 1] += 5.0
    return replace(log, gnss=replace(log.gnss, llh=llh), pose_fixes=replace(log.pose_fixes, pose=pose))


@pytest.fixture(scope="module")
def log() -> Log:
    """Forty seconds with a standstill, all sensors."""
    return later(simulate(70.0, 2, scenarios.load("demo")), 30.0)


@pytest.mark.parametrize("scene", ["whole", "rough"])
def test_equals_dense_rts(log: Log, scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """State by state to rounding, in units of the smoothed sigma, over every kind of step."""
    drive = rough(log) if scene == "rough" else log
    result, states = smooth(drive)
    with monkeypatch.context() as patch:
        watch = Watch(patch)
        run(drive)
    expected = rts(watch.steps)
    assert watch.kinds == {"move", "correct", "state"} | ({"coast", "widen", "give way"} if scene == "rough" else set())
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


def test_a_minute_without_imu(log: Log) -> None:
    """P grows to 700 m and falls to a centimetre at the first fix: no digit is lost that smoothing needs."""
    assert log.imu is not None
    middle = int(log.imu.t_ns[2000])
    pause = 60 * 10**9

    def apart(record: Any) -> Any:
        return record and replace(record, t_ns=record.t_ns + np.where(record.t_ns > middle, pause, 0))

    names = ("imu", "gnss", "gnss_velocity", "pose_fixes", "wheel")
    drive = replace(log, reference=None, **{name: apart(getattr(log, name)) for name in names})
    result, states = smooth(drive, FusionConfig())
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
