"""An oracle of the smoother: the loop as plain Python, watched step by step, and plain dense RTS over the steps."""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import fusion._kernels
import fusion.gating
import fusion.motion
import fusion.navigator
import fusion.observing
import fusion.recovery
import fusion.update
from fusion.layout import Layout, used
from fusion.navigator import Navigator
from fusion.state import A_T, Core

Floats = NDArray[np.float64]


class Step(NamedTuple):
    """One thing that happened to P: before and after; Phi of a transition, dx of a correction, t of a state, nothing of
    a cut."""

    before: Floats
    after: Floats
    phi: Floats | None = None
    dx: Floats | None = None
    t_ns: int | None = None


WIDENED = ("forget", "doubt_all", "give_way", "give_way_turning", "give_way_upwards")
PLAIN = {
    fusion._kernels: ("sweep", "handle", "_coast"),
    fusion.update: ("_apply", "_weigh", "_apply_renewed", "measure", "motion", "doubted"),
    fusion.observing: ("_measure_pose", "_see_matching", "_see_receiver"),
    fusion.motion: ("_zero_rate",),
}
"""What runs as plain Python, so that the functions below can be watched."""


class Watch:
    """Runs the kernel's loop as plain Python and writes down every step, without any tape."""

    def __init__(self, patch: pytest.MonkeyPatch, layout: Layout) -> None:
        self.steps: list[Step] = []
        self.kinds: set[str] = set()
        self.size = used(layout)
        self._patch, self._layout = patch, layout
        patch.setattr(fusion.navigator, "process", fusion._kernels.process.py_func)
        for module, names in PLAIN.items():
            for name in names:
                patch.setattr(module, name, getattr(module, name).py_func)
        for name in WIDENED:
            self._watch("widen" if name == "forget" else "give way", fusion.recovery, name, self._same)
        self._watch("widen", fusion._kernels, "widen", self._same)
        self._watch("coast", fusion._kernels, "coast", self._coasted)
        for module, name, kind in (
            *((module, "move", "move") for module in (fusion._kernels, fusion.update)),
            *((module, "renew", "renew") for module in (fusion.observing, fusion.update)),
            (fusion.observing, "fade", "fade"),
        ):
            self._watch(kind, module, name, getattr(self, f"_{kind}"))
        self._watch_corrections()
        self._watch_states()

    def _watch(self, kind: str, module: ModuleType, name: str, phi_of: Callable[..., Floats]) -> None:
        """Write down each call of a function of P, or of a core, whose transition phi_of gives before it happens."""
        real = getattr(module, name)

        def watched(*given: Any) -> None:
            P = given[0].P if isinstance(given[0], Core) else given[0]
            before, phi = P.copy(), phi_of(*given)
            real(*given)
            if kind == "move":  # Core.phi is of the transition that has just been made
                phi[:9, :16] = given[0].phi
            if not np.array_equal(before, P):
                self._add(kind, Step(before, P.copy(), phi=phi))

        self._patch.setattr(module, name, watched)

    def _watch_corrections(self) -> None:
        real = fusion.gating.correct

        def correct(nav: Floats, earth: Floats, P: Floats, W: Floats, dx: Floats, *given: Any) -> None:
            before = P.copy()
            real(nav, earth, P, W, dx, *given)
            self._add("correct", Step(before, P.copy(), dx=dx.copy()))

        for module in (fusion.update, fusion.motion):
            self._patch.setattr(module, "correct", correct)

    def _watch_states(self) -> None:
        real, give_up = fusion.update.record_state, Navigator._give_up

        def record_state(core: Core, rec: Any, t: int) -> None:
            real(core, rec, t)
            self._add("state", Step(core.P.copy(), core.P.copy(), t_ns=t))

        def watched(navigator: Navigator, core: Core) -> None:
            give_up(navigator, core)
            self._add("cut", Step(core.P.copy(), core.P.copy()))

        self._patch.setattr(fusion.update, "record_state", record_state)
        self._patch.setattr(Navigator, "_give_up", watched)

    def _same(self, P: Floats, *_: Any) -> Floats:
        return np.eye(len(P))

    def _coasted(self, P: Floats, seconds: float, *_: Any) -> Floats:
        phi = np.eye(len(P))
        phi[:3, 3:6] = seconds * np.eye(3)
        return phi

    def _move(self, core: Core, *_: Any) -> Floats:
        phi, turned, layout = np.eye(len(core.P)), core.acc[A_T : A_T + 3], self._layout
        if layout.gyro_scale >= 0:
            phi[6:9, layout.gyro_scale] = -turned[:, 2]
        if layout.gyro_misalignment >= 0:
            phi[6:9, layout.gyro_misalignment : layout.gyro_misalignment + 2] = -turned[:, :2]
        return phi

    def _fade(self, core: Core, first: int, keep: float) -> Floats:
        phi = np.eye(len(core.P))
        phi[first : first + 3] *= keep
        return phi

    def _renew(self, core: Core, first: int) -> Floats:
        return self._fade(core, first, 0.0)

    def _add(self, kind: str, step: Step) -> None:
        """Without what fills the state up, which has no variance. A transition must explain P but for added noise."""
        self.kinds.add(kind)
        n = slice(self.size)
        phi, dx = None if step.phi is None else step.phi[n, n], None if step.dx is None else step.dx[n]
        step = Step(step.before[n, n], step.after[n, n], phi, dx, step.t_ns)
        if step.phi is not None:
            noise = step.after - step.phi @ step.before @ step.phi.T
            scale = np.sqrt(np.diag(step.after))
            assert np.linalg.eigvalsh(noise / np.outer(scale, scale)).min() > -1e-9, kind
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
        elif step.t_ns is None and step.dx is None:  # a new start: of what comes after it nothing is learned
            d, P = np.zeros(len(P)), step.before
        elif step.dx is not None:
            back = np.linalg.inv(reset_matrix(step.dx))
            d = back @ d + step.dx
            P = back @ P @ back.T
        else:
            assert step.t_ns is not None
            G = reset_matrix(d)
            found[step.t_ns] = d, G @ P @ G.T
    return found
