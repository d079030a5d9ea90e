"""Fixed-interval smoothing: every state from all measurements of the drive, those after it as well.

The Rauch-Tung-Striebel smoother in Bryson and Frazier's form (Bierman 1973; 1977, ch. X): backwards over the tape go
lambda (n,) and Lambda (n, n), of which the smoothed error is x = P lambda and its covariance P - P Lambda P. Where the
plain form inverts the predicted covariance at every step, this inverts nothing: states without variance, and P widened
over a gap, need no care. lambda has the sign of the correction (Bierman's is the other).

Over a transition lambda' = Phi' lambda, Lambda' = Phi' Lambda Phi. Over a correction with J = L^-1 H, K = W' L^-1 and
the whitened innovation w: lambda' = (I - W' J)' lambda + J' w, Lambda' = (I - W' J)' Lambda (I - W' J) + J' J.
Over the reset of the attitude error with G: lambda' = G' lambda, Lambda' = G' Lambda G.
"""

from collections.abc import Iterator
from dataclasses import fields

import numpy as np

from fusion.config import FusionConfig
from fusion.events import Recorder, new_recorder
from fusion.gating import inject, reset
from fusion.mechanization import refresh
from fusion.recording import join, states
from fusion.result import FusionResult, States
from fusion.run import Session, joined
from fusion.spool import Spool
from fusion.state import Core, Floats, new_core
from fusion.tape import COASTED, CORRECTED, CUT, FADED, MOVED, Tape
from fusion.update import record_state
from sensors.clock import NS_PER_S
from sensors.kernel import kernel
from sensors.records import Log

_SECOND = NS_PER_S
_ROUNDING = 1e-9
"""Share of P that is added to P - P Lambda P: rounding takes up to half of it where P falls from 800 m to a centimetre
at once, and would leave less than nothing."""


@kernel()
def retrace(tape: Floats, core: Core, lam: Floats, Lam: Floats, work: Floats, rec: Recorder) -> None:
    """Read a portion of the tape from its end; smoothed states go into the recorder, the last one first.

    lam (n,), Lam (n, n): carried from portion to portion, zero at the end of the drive; core, work (2, n, n): scratch.
    """
    end = len(tape)
    while end > 0:
        kind = tape[end - 1]
        if kind == MOVED:
            end = _back_over_move(tape, end - 1, core.phi, lam, Lam, work[0])
        elif kind == COASTED:
            end = _back_over_coast(tape, end - 1, lam, Lam)
        elif kind == FADED:
            end = _back_over_fade(tape, end - 1, lam, Lam)
        elif kind == CUT:
            end -= 1
            lam[:] = 0.0
            Lam[:, :] = 0.0
        elif kind == CORRECTED:
            end = _back_over_correction(tape, end - 1, lam, Lam, work)
        else:
            end = _smooth(tape, end - 1, core, lam, Lam, work, rec)


@kernel(fastmath={"contract"})
def _back_over_move(tape: Floats, end: int, phi: Floats, lam: Floats, Lam: Floats, work: Floats) -> int:
    """Phi' lambda and Phi' Lambda Phi; Phi: phi (9, 16), and -turned for the gyro's errors, above an identity."""
    size, columns = len(lam), phi.shape[1]
    scale, misalignment = int(tape[end - 2]), int(tape[end - 1])
    turned = end - 11
    start: int = turned - 9 * columns
    for i in range(9):
        for j in range(columns):
            phi[i, j] = tape[start + i * columns + j]
    for i in range(size):
        for j in range(size):
            work[i, j] = Lam[i, j] if j >= 9 else 0.0
        for k in range(9):
            for j in range(columns):
                work[i, j] += Lam[i, k] * phi[k, j]
        for k in range(3):
            if scale >= 0:
                work[i, scale] -= Lam[i, 6 + k] * tape[turned + 3 * k + 2]
            if misalignment >= 0:
                work[i, misalignment] -= Lam[i, 6 + k] * tape[turned + 3 * k]
                work[i, misalignment + 1] -= Lam[i, 6 + k] * tape[turned + 3 * k + 1]
    for i in range(size):
        for j in range(size):
            Lam[i, j] = work[i, j] if i >= 9 else 0.0
    for i in range(columns):
        for k in range(9):
            for j in range(size):
                Lam[i, j] += phi[k, i] * work[k, j]
    for k in range(3):
        for j in range(size):
            if scale >= 0:
                Lam[scale, j] -= tape[turned + 3 * k + 2] * work[6 + k, j]
            if misalignment >= 0:
                Lam[misalignment, j] -= tape[turned + 3 * k] * work[6 + k, j]
                Lam[misalignment + 1, j] -= tape[turned + 3 * k + 1] * work[6 + k, j]
    _mirror(Lam)
    for j in range(size):
        work[0, j] = lam[j] if j >= 9 else 0.0
    for k in range(9):
        for j in range(columns):
            work[0, j] += lam[k] * phi[k, j]
    for k in range(3):
        if scale >= 0:
            work[0, scale] -= lam[6 + k] * tape[turned + 3 * k + 2]
        if misalignment >= 0:
            work[0, misalignment] -= lam[6 + k] * tape[turned + 3 * k]
            work[0, misalignment + 1] -= lam[6 + k] * tape[turned + 3 * k + 1]
    for j in range(size):
        lam[j] = work[0, j]
    return start


@kernel()
def _back_over_fade(tape: Floats, end: int, lam: Floats, Lam: Floats) -> int:
    """The same where some errors keep a share of themselves."""
    first, count, keep = int(tape[end - 3]), int(tape[end - 2]), tape[end - 1]
    for k in range(first, first + count):
        lam[k] *= keep
        for j in range(len(lam)):
            Lam[k, j] *= keep
            Lam[j, k] *= keep
    return end - 3


@kernel()
def _back_over_coast(tape: Floats, end: int, lam: Floats, Lam: Floats) -> int:
    """The same where position moves with velocity and nothing else does."""
    seconds = tape[end - 1]
    size = len(lam)
    for k in range(3):
        lam[3 + k] += seconds * lam[k]
        for j in range(size):
            Lam[3 + k, j] += seconds * Lam[k, j]
    for i in range(size):
        for k in range(3):
            Lam[i, 3 + k] += seconds * Lam[i, k]
    return end - 1


@kernel(fastmath={"contract"})
def _back_over_correction(tape: Floats, end: int, lam: Floats, Lam: Floats, work: Floats) -> int:
    """Over the reset and then the measurement.

    I - W' J is formed first: where a wide P meets a sharp measurement it is tiny, and Lambda - J' (...) in its place
    would lose as many digits as P falls by orders of magnitude.
    """
    size, dof = len(lam), int(tape[end - 1])
    half = end - 4
    h = (-tape[half], -tape[half + 1], -tape[half + 2])
    reset(Lam, h)
    a, b, c = lam[6], lam[7], lam[8]
    lam[6], lam[7], lam[8] = a + (h[1] * c - h[2] * b), b + (h[2] * a - h[0] * c), c + (h[0] * b - h[1] * a)
    white = half - dof
    W, J = white - dof * size, white - 2 * dof * size  # where both begin on the tape
    left, moved = work[0], work[1]  # I - W' J, and Lambda (I - W' J)
    for i in range(size):
        for j in range(size):
            left[i, j] = 1.0 if i == j else 0.0
            moved[i, j] = 0.0
        for k in range(dof):
            for j in range(size):
                left[i, j] -= tape[W + k * size + i] * tape[J + k * size + j]
    for i in range(size):
        for k in range(size):
            for j in range(size):
                moved[i, j] += Lam[i, k] * left[k, j]
    for i in range(size):
        for j in range(size):
            Lam[i, j] = 0.0
        for k in range(dof):
            for j in range(size):
                Lam[i, j] += tape[J + k * size + i] * tape[J + k * size + j]
        for k in range(size):
            for j in range(size):
                Lam[i, j] += left[k, i] * moved[k, j]
    _mirror(Lam)
    for j in range(size):
        moved[0, j] = 0.0
        for k in range(size):
            moved[0, j] += left[k, j] * lam[k]
        for k in range(dof):
            moved[0, j] += tape[J + k * size + j] * tape[white + k]
    for j in range(size):
        lam[j] = moved[0, j]
    return J


@kernel(fastmath={"contract"})
def _smooth(tape: Floats, end: int, core: Core, lam: Floats, Lam: Floats, work: Floats, rec: Recorder) -> int:
    """Correct a recorded state by P lambda; its covariance P - P Lambda P is turned as after any correction."""
    nav, P, dx, size = core.nav, core.P, core.dx, len(lam)
    t = int(tape[end - 2]) * _SECOND + int(tape[end - 1])
    triangle = end - 2 - size * (size + 1) // 2
    start = triangle - len(nav)
    for i in range(len(nav)):
        nav[i] = tape[start + i]
    at = triangle
    for i in range(size):
        for j in range(i + 1):
            P[i, j] = P[j, i] = tape[at]
            at += 1
    gain, smoothed = work[0], work[1]  # P Lambda, and P - P Lambda P
    for i in range(size):
        dx[i] = 0.0
        for j in range(size):
            dx[i] += P[i, j] * lam[j]
            gain[i, j] = 0.0
            smoothed[i, j] = P[i, j]
        for k in range(size):
            for j in range(size):
                gain[i, j] += P[i, k] * Lam[k, j]
        for k in range(size):
            for j in range(size):
                smoothed[i, j] -= gain[i, k] * P[k, j]
    _mirror(smoothed)
    for i in range(size):
        smoothed[i, i] += _ROUNDING * P[i, i]
    for i in range(size):
        for j in range(size):
            P[i, j] = smoothed[i, j]
    refresh(nav, core.earth)
    inject(nav, core.earth, dx)
    reset(P, (0.5 * dx[6], 0.5 * dx[7], 0.5 * dx[8]))
    record_state(core, rec, t)
    return start


@kernel()
def _mirror(A: Floats) -> None:
    """Make A what its lower triangle says: rounding must not part the two."""
    for i in range(A.shape[0]):
        for j in range(i):
            A[j, i] = A[i, j]


def smoothed(tape: Tape) -> Iterator[States]:
    """The smoothed states of a drive whose tape is complete, in the order of time, a portion of the tape at a time."""
    found = Spool(tape.folder)
    core, lam, Lam, work = new_core(), np.empty(0), np.empty((0, 0)), np.empty((2, 0, 0))
    for numbers, count, size in reversed(tape):
        if not len(lam):
            core, lam, Lam, work = new_core(size), np.zeros(size), np.zeros((size, size)), np.zeros((2, size, size))
        recorder = new_recorder(count, 0)
        retrace(numbers, core, lam, Lam, work, recorder)
        part = states(recorder)
        found.append(*(np.ascontiguousarray(getattr(part, f.name)[::-1]) for f in fields(part)))
    for columns in reversed(found):
        yield States(*columns)
    found.close()


def smooth(log: Log, config: FusionConfig | None = None) -> tuple[FusionResult, States]:
    """Fuse and smooth a whole log: ``fusion.run.run`` and the smoothed states at the same times."""
    tape = Tape()
    session = Session(log.vehicle, log.map_frame, config, tape)
    result = joined([session.push(log), session.finish()])
    later = list(smoothed(tape)) or [result.states]
    tape.close()
    return result, join(later)
