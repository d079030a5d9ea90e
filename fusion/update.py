"""What happens at an event: a measurement is judged and corrects the state, or the state is recorded."""

import math

import numpy as np

from fusion._linalg import Vector, attitude
from fusion.axes import add_lean
from fusion.blocks import renew
from fusion.covariance import propagate
from fusion.events import MOTION, OUTPUT, Events, Measurements, Parameters, Recorder
from fusion.gating import correct, innovate, whiten
from fusion.health import SOURCES, hopeless, judge, level_of, noted, questionable
from fusion.measurements import Pair, heading
from fusion.motion import motion
from fusion.observing import measure, triple
from fusion.recovery import believed, doubted, hold_on, in_doubt, pulled_off
from fusion.result import Reason, Sensor
from fusion.robust import reweigh
from fusion.state import A_T, H_CAUSE, H_STATE, ROW, Core
from fusion.streak import ALIAS_M, may_renew, tally, threshold_of
from fusion.tape import note_correction, note_move, note_state
from sensors.kernel import kernel

_GNSS_POSITION = int(Sensor.GNSS_POSITION)
_GNSS_VELOCITY = int(Sensor.GNSS_VELOCITY)
_POSE_FIX = int(Sensor.POSE_FIX)
_ACCEPTED = int(Reason.ACCEPTED)
_CHI_SQUARE = int(Reason.CHI_SQUARE)
_RECEIVER = int(Reason.RECEIVER)
_MODES_AGREE = int(Reason.MODES_AGREE)
_SOURCES = len(SOURCES)
_LASTS = np.bool_(True)
"""Not a literal, for which numba would compile a second ``measure``."""


@kernel(inline="always")
def gives_up(core: Core, par: Parameters, ev: Events, e: int, now: int) -> bool:
    """Whether event e is a position that had better begin a new alignment than be judged by this state."""
    kind = ev.kind[e]
    return bool(
        kind in (_GNSS_POSITION, _POSE_FIX)
        and ev.verdict[e] < 0
        and questionable(core.health, core.P, par.health)
        and hopeless(core, par.health, kind, now)
    )


@kernel()
def handle(core: Core, rec: Recorder, par: Parameters, m: Measurements, ev: Events, e: int, rate: Vector) -> None:
    """Apply or record event e at the state's time; rate: bias-free body rate, rad/s.

    Compiled for itself: both orders share it, and what it calls is large.
    """
    kind = ev.kind[e]
    if ev.verdict[e] >= 0:
        record_decision(rec, e, kind, 0, ev.verdict[e])
        return
    move(core, par)
    if kind == OUTPUT:
        _record_health(core, rec, par, ev.t[e])
        record_state(core, rec, ev.t[e])
        if len(core.tape):
            note_state(core, ev.t[e])
        return
    accepted = _ACCEPTED
    if kind == MOTION:
        kind, dof = motion(core, par, ev.t[e], rate)
        if dof == 0:
            return
    elif kind == _GNSS_VELOCITY and in_doubt(core, 0, ev.t[e]):
        record_decision(rec, e, kind, 0, _RECEIVER)
        noted(core.health, core.trust, par.health.suspect, kind, False, False, ev.t[e])
        return
    else:
        dof, accepted = measure(core, par, m, kind, ev.row[e], rate, _LASTS)
        if dof == 0:
            record_decision(rec, e, kind, 0, accepted)
            return
    k = record_decision(rec, e, kind, dof, _CHI_SQUARE)
    threshold = threshold_of(core, par, dof, ev.t[e]) if kind == _POSE_FIX else par.gate[dof - 1]
    passed = _apply(core, rec, par, k, dof, threshold, accepted)
    if kind in (_GNSS_POSITION, _POSE_FIX):
        first = par.layout.pose_error if kind == _POSE_FIX else par.layout.gnss_error
        if not passed and first >= 0:
            passed, dof, accepted = _apply_renewed(core, rec, par, m, ev, e, rate, k, (threshold, first))
        if not (passed and accepted == _MODES_AGREE):  # which says nothing of where the modes differ
            tally(core, par, int(kind == _POSE_FIX), passed, ev.t[e])
        if dof == 3:
            _weigh(core, rec, par, int(kind == _POSE_FIX), passed, k, ev.t[e])
            if kind == _POSE_FIX and pulled_off(core, par, ev.t[e]):
                passed = _hold_on(core, rec, par, m, ev, e, rate, k) or passed
    if kind < _SOURCES:
        explained = passed and rec.scores[k, 0] <= par.health.explained[dof - 1]
        noted(core.health, core.trust, par.health.suspect, kind, passed, explained, ev.t[e])


@kernel(inline="always")
def _weigh(core: Core, rec: Recorder, par: Parameters, which: int, passed: bool, k: int, now: int) -> None:
    """What the fate of a whole position of sensor which (0 GNSS, 1 pose fix), decision k, says of the state."""
    if passed:
        believed(core, par, which, triple(rec.innovation, k), now)
        return
    ahead: Pair = (1.0, 0.0)
    if which:
        ahead = heading(attitude(core.nav))
    doubted(core, par, which, triple(rec.innovation, k), ahead, now)


@kernel()
def _apply_renewed(
    core: Core,
    rec: Recorder,
    par: Parameters,
    m: Measurements,
    ev: Events,
    e: int,
    rate: Vector,
    k: int,
    judged: tuple[float, int],
) -> tuple[bool, int, int]:
    """A position that was rejected once more: what lasts of its error may have changed all at once, and then the state
    need not move for it. Seldom, so it is compiled for itself.

    judged: the threshold, and where the states of what lasts begin. Returns what ``measure`` gives, after whether the
    position passed.
    """
    threshold, first = judged
    kind, passed = ev.kind[e], False
    dof, accepted = 0, 0
    for lasts in (False, True):
        dof, accepted = measure(core, par, m, kind, ev.row[e], rate, lasts)
        if lasts:
            passed = _apply(core, rec, par, k, dof, threshold, accepted)
            break
        known = may_renew(core, int(kind == _POSE_FIX), ev.t[e]) and innovate(
            core.P, core.H, core.W, dof, core.R, core.L
        )
        if not (known and whiten(dof, core.residual, core.L) <= threshold):
            break
        renew(core, first)
    return passed, dof, accepted


@kernel()
def _hold_on(
    core: Core, rec: Recorder, par: Parameters, m: Measurements, ev: Events, e: int, rate: Vector, k: int
) -> bool:
    """A pose fix beside a state that was pulled off: it is applied with nothing known of errors that last, unless it
    fits the state without any, or is so far off that it may be an alias. Seldom, so it is compiled for itself. Whether
    it passed."""
    kind, residual = ev.kind[e], core.residual
    dof, accepted = measure(core, par, m, kind, ev.row[e], rate, np.bool_(False))
    place_var, yaw_var = residual[0] * residual[0] + residual[1] * residual[1], residual[2] * residual[2]
    known = innovate(core.P, core.H, core.W, dof, core.R, core.L)
    if place_var > ALIAS_M * ALIAS_M or (known and whiten(dof, residual, core.L) <= par.gate[dof - 1]):
        return False
    hold_on(core, par, place_var, yaw_var, ev.t[e])
    dof, accepted = measure(core, par, m, kind, ev.row[e], rate, _LASTS)
    passed: bool = _apply(core, rec, par, k, dof, par.gate[dof - 1], accepted)
    return passed


@kernel()
def _apply(core: Core, rec: Recorder, par: Parameters, k: int, dof: int, threshold: float, accepted: int) -> bool:
    """Gate the core's residual and correct the state; complete decision k. Whether it passed."""
    L, residual = core.L, core.residual
    rec.scores[k, 1] = threshold
    rec.scores[k, 2] = rec.scores[k, 3] = rec.scores[k, 4] = 0.0
    for i in range(dof):
        rec.innovation[k, i] = residual[i]
    if not innovate(core.P, core.H, core.W, dof, core.R, L):
        return False
    for i in range(dof):
        total = 0.0
        for j in range(i + 1):
            total += L[i, j] * L[i, j]
        rec.sigma[k, i] = np.sqrt(total)
    score = whiten(dof, residual, L)
    rec.scores[k, 0] = score
    if not score <= threshold:
        return False
    weight = 1.0
    if par.robust:
        weight = reweigh(
            core.P, core.H, core.W, dof, core.R, L, residual, rec.innovation, k, par.robust, par.robust_sigmas, core.dx
        )  # fmt: skip
    correct(core.nav, core.earth, core.P, core.W, core.dx, residual, dof)
    if len(core.tape):
        note_correction(core, dof)
    dx = core.dx
    rec.reason[k] = accepted
    rec.scores[k, 2] = np.sqrt(dx[0] ** 2 + dx[1] ** 2 + dx[2] ** 2)
    rec.scores[k, 3] = abs(dx[8])
    rec.scores[k, 4] = weight
    return True


@kernel()
def record_decision(rec: Recorder, event: int, sensor: int, dof: int, reason: int) -> int:
    """Open a decision; returns its row."""
    k = int(rec.filled[1])
    rec.filled[1] = k + 1
    rec.event[k], rec.sensor[k], rec.dof[k], rec.reason[k] = event, sensor, dof, reason
    for i in range(3):
        rec.innovation[k, i] = rec.sigma[k, i] = np.nan
    for i in range(5):
        rec.scores[k, i] = np.nan
    return k


@kernel(inline="always")
def _record_health(core: Core, rec: Recorder, par: Parameters, t: int) -> None:
    """Record how the filter is doing, into the row of the state that is recorded next."""
    k = rec.filled[0]
    judge(core, par.health, t)
    rec.health[k, 0], rec.health[k, 1] = core.health[H_STATE], core.health[H_CAUSE]
    for sensor in range(_SOURCES):
        rec.levels[k, sensor] = level_of(core.trust, par.health.stale_ns[sensor], par.health.suspect, sensor, t)


@kernel(inline="always")
def record_state(core: Core, rec: Recorder, t: int) -> None:
    """Record nav, the pose covariance (position, attitude) and every sigma."""
    P = core.P
    k = rec.filled[0]
    rec.filled[0] = k + 1
    rec.t[k] = t
    for i in range(16):
        rec.nav[k, i] = core.nav[i]
    for i in range(15):
        rec.sigma_state[k, i] = np.sqrt(P[i, i])
    for i in range(6):
        a = i if i < 3 else i + 3
        for j in range(6):
            b = j if j < 3 else j + 3
            rec.pose_cov[k, i, j] = P[a, b]
    if rec.axes_var > 0.0:
        add_lean(core.nav, rec.axes_var, rec.sigma_state[k], rec.pose_cov[k])


@kernel()
def move(core: Core, par: Parameters) -> None:
    """Bring P up to the state's time."""
    span = core.span[0]
    if span == 0.0:
        return
    if core.P.shape[0] > ROW:
        age(core, span)
    taped = len(core.tape) > 0
    if taped:
        for i in range(3):
            for j in range(3):
                core.turned[i, j] = core.acc[A_T + i, j]
    propagate(core.nav, core.earth, core.P, core.acc, core.span, (core.phi, core.M, core.Mt), par.noise)
    if taped:
        note_move(core, par.layout)


@kernel(inline="always")
def age(core: Core, dt: float) -> None:
    """Time and road go by for the errors that last."""
    core.aged[0] += dt
    core.aged[1] += dt * math.sqrt(core.nav[3] * core.nav[3] + core.nav[4] * core.nav[4])
