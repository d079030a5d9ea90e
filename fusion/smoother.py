"""Fixed-interval smoothing: every state from all measurements of the drive, those after it as well.

The Rauch-Tung-Striebel smoother in Bryson and Frazier's form (Bierman 1973; 1977, ch. X): backwards over the tape go
lambda (n,) and Lambda (n, n), of which the smoothed error is x = P lambda and its covariance P - P Lambda P. Where the
plain form inverts the predicted covariance at every step, this inverts nothing: states without variance, and P widened
over a gap, need no care. lambda has the sign of the correction (Bierman's is the other).

Over a transition lambda' = Phi' lambda, Lambda' = Phi' Lambda Phi. Over a correction with J = L^-1 H, K = W' L^-1 and
the whitened innovation w: lambda' = (I - W' J)' lambda + J' w, Lambda' = (I - W' J)' Lambda (I - W' J) + J' J.
Over the reset of the attitude error with G: lambda' = G' lambda, Lambda' = G' Lambda G.

Lambda goes as a root, Lambda = C' C: every step is one on the rows of C, and lambda is a row like them; J is more rows,
and now and then a QR decomposition makes fewer of them. So P may fall from 800 m to a centimetre at once: what rounding
does to C enters Lambda with its square, or times what is left of C.
"""

import math
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
from fusion.state import ROW, Core, Floats, Nanoseconds, new_core
from fusion.tape import COASTED, CORRECTED, CUT, FADED, MOVED, Tape
from fusion.update import record_state
from sensors.clock import NS_PER_S
from sensors.kernel import kernel
from sensors.records import Log

_SECOND = NS_PER_S


@kernel()
def retrace(tape: Floats, core: Core, held: Floats, count: Nanoseconds, work: Floats, rec: Recorder) -> None:
    """Read a portion of the tape from its end; smoothed states go into the recorder, the last one first.

    held (2n + 4, n): lambda, and count (1,) rows of the root of Lambda; carried from portion to portion, zero at the
    end of the drive. core, work (2n + 4, n): scratch.
    """
    end = len(tape)
    while end > 0:
        kind = tape[end - 1]
        if kind == MOVED:
            end = _back_over_move(tape, end - 1, held, 1 + count[0])
        elif kind == COASTED:
            end = _back_over_coast(tape, end - 1, held, 1 + count[0])
        elif kind == FADED:
            end = _back_over_fade(tape, end - 1, held, 1 + count[0])
        elif kind == CUT:
            end -= 1
            count[0] = 0
            for j in range(held.shape[1]):
                held[0, j] = 0.0
        elif kind == CORRECTED:
            end = _back_over_correction(tape, end - 1, held, count, work)
        else:
            end = _smooth(tape, end - 1, core, held, count[0], work, rec)


@kernel(fastmath={"contract"})
def _back_over_move(tape: Floats, end: int, held: Floats, rows: int) -> int:
    """Rows times Phi: phi (9, 16), and -turned for the gyro's errors, above an identity."""
    scale, misalignment = int(tape[end - 2]), int(tape[end - 1])
    turned = end - 11
    start: int = turned - 9 * ROW
    for r in range(rows):
        row, total = held[r, :ROW], held[r, 9:]
        x, y, z = row[6], row[7], row[8]
        moved = (row[0], row[1], row[2], row[3], row[4], row[5], x, y, z)
        for j in range(9):
            row[j] = 0.0
        for k in range(9):
            for j in range(ROW):
                row[j] += moved[k] * tape[start + k * ROW + j]
        if scale >= 0:
            total[scale - 9] -= x * tape[turned + 2] + y * tape[turned + 5] + z * tape[turned + 8]
        if misalignment >= 0:
            for j in range(2):
                seen = x * tape[turned + j] + y * tape[turned + 3 + j] + z * tape[turned + 6 + j]
                total[misalignment + j - 9] -= seen
    return start


@kernel()
def _back_over_fade(tape: Floats, end: int, held: Floats, rows: int) -> int:
    """The same where some errors keep a share of themselves."""
    first, count, keep = int(tape[end - 3]), int(tape[end - 2]), tape[end - 1]
    for r in range(rows):
        for k in range(first, first + count):
            held[r, k] *= keep
    return end - 3


@kernel()
def _back_over_coast(tape: Floats, end: int, held: Floats, rows: int) -> int:
    """The same where position moves with velocity and nothing else does."""
    seconds = tape[end - 1]
    for r in range(rows):
        for k in range(3):
            held[r, 3 + k] += seconds * held[r, k]
    return end - 1


@kernel(fastmath={"contract"})
def _back_over_correction(tape: Floats, end: int, held: Floats, count: Nanoseconds, work: Floats) -> int:
    """Over the reset and then the measurement."""
    size, dof = held.shape[1], int(tape[end - 1])
    half = end - 4
    x, y, z = tape[half], tape[half + 1], tape[half + 2]
    white = half - dof
    W = white - dof * size  # where it begins on the tape
    J: int = W - dof * size
    if 1 + count[0] + dof > held.shape[0]:
        count[0] = _compress(held, count[0], work)
    for r in range(1 + count[0]):
        a, b, c = held[r, 6], held[r, 7], held[r, 8]
        held[r, 6], held[r, 7], held[r, 8] = a + (b * z - c * y), b + (c * x - a * z), c + (a * y - b * x)
        for k in range(dof):
            work[0, k] = 0.0
            for j in range(size):
                work[0, k] += held[r, j] * tape[W + k * size + j]
        for k in range(dof):
            for j in range(size):
                held[r, j] -= work[0, k] * tape[J + k * size + j]
    for k in range(dof):
        count[0] += 1
        for j in range(size):
            held[count[0], j] = tape[J + k * size + j]
            held[0, j] += tape[J + k * size + j] * tape[white + k]
    return J


@kernel(fastmath={"contract"})
def _compress(held: Floats, count: int, work: Floats) -> int:
    """The same Lambda in n rows, n or more before: R of their QR decomposition, by Householder's reflections."""
    size: int = held.shape[1]
    mirrored = work[0]
    for c in range(size):
        total = 0.0
        for r in range(c + 1, count + 1):
            total += held[r, c] * held[r, c]
        if total == 0.0:
            continue
        first = held[c + 1, c]
        length = -math.copysign(math.sqrt(total), first)
        held[c + 1, c] = first - length
        share = 1.0 / (total - first * length)  # two over the square of the mirror's normal, which stands in column c
        for j in range(c + 1, size):
            mirrored[j] = 0.0
        for r in range(c + 1, count + 1):
            for j in range(c + 1, size):
                mirrored[j] += held[r, c] * held[r, j]
        for r in range(c + 1, count + 1):
            for j in range(c + 1, size):
                held[r, j] -= share * held[r, c] * mirrored[j]
            held[r, c] = 0.0
        held[c + 1, c] = length
    return size


@kernel(fastmath={"contract"})
def _smooth(tape: Floats, end: int, core: Core, held: Floats, count: int, work: Floats, rec: Recorder) -> int:
    """Correct a recorded state by P lambda; its covariance P - (C P)' C P is turned as after any correction."""
    nav, P, dx, size = core.nav, core.P, core.dx, held.shape[1]
    t = int(tape[end - 2]) * _SECOND + int(tape[end - 1])
    triangle = end - 2 - size * (size + 1) // 2
    start: int = triangle - len(nav)
    for i in range(len(nav)):
        nav[i] = tape[start + i]
    at = triangle
    for i in range(size):
        for j in range(i + 1):
            P[i, j] = P[j, i] = tape[at]
            at += 1
    for r in range(count + 1):
        for j in range(size):
            work[r, j] = 0.0
        for k in range(size):
            for j in range(size):
                work[r, j] += held[r, k] * P[k, j]
    for j in range(size):
        dx[j] = work[0, j]
    for r in range(1, count + 1):
        for i in range(size):
            for j in range(size):
                P[i, j] -= work[r, i] * work[r, j]
    refresh(nav, core.earth)
    inject(nav, core.earth, dx)
    reset(P, (0.5 * dx[6], 0.5 * dx[7], 0.5 * dx[8]))
    record_state(core, rec, t)
    return start


def smoothed(tape: Tape) -> Iterator[States]:
    """The smoothed states of a drive whose tape is complete, in the order of time, a portion of the tape at a time."""
    found = Spool(tape.folder)
    core, held, work, count = new_core(), np.empty((0, 0)), np.empty((0, 0)), np.zeros(1, np.int64)
    for numbers, outputs, size in reversed(tape):
        if not len(held):
            core, held, work = new_core(size), np.zeros((2 * size + 4, size)), np.zeros((2 * size + 4, size))
        recorder = new_recorder(outputs, 0, tape.axes_var)
        retrace(numbers, core, held, count, work, recorder)
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
