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
from fusion.result import States
from fusion.run import run
from fusion.smoother import smooth
from fusion.state import Core
from sensors.records import Log
from sensors.simulate import scenarios
from sensors.simulate.drive import simulate
from tests.fusion.scenes import later, with_gap

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
                phi = np.eye(len(before))
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
