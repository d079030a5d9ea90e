"""The tape: what the filter did to its error state, step by step, for the smoother to read backwards.

A record is its numbers and then its kind, so that it can be read from the end. Records, of n error states:

MOVED      phi (9, 16), the upper rows of the transition, whose others are the identity's; Core.turned (3, 3), by which
           the gyro's scale and misalignment move the attitude, and where these two stand
COASTED    seconds at constant velocity
FADED      first error, count, the share of them that stayed: errors that last; 0 where a state was set anew
CUT        nothing: the filter started again, and what comes later says nothing of what was before
CORRECTED  L^-1 H (dof, n), W (dof, n), the whitened innovation (dof,), half the attitude's correction (3,), dof
RECORDED   nav (n + 1,), the lower triangle of P by rows, seconds and nanoseconds of the state's time

What widens P alone is not on it: the smoother asks only how errors move and what was seen of them.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.events import Parameters
from fusion.layout import Layout
from fusion.spool import Spool
from fusion.state import C_SAMPLE, Core, Floats
from sensors.clock import NS_PER_S
from sensors.kernel import kernel

MOVED, COASTED, CORRECTED, RECORDED, FADED, CUT = 1.0, 2.0, 3.0, 4.0, 5.0, 6.0
_SECOND = NS_PER_S

PORTION = 1 << 20
"""Numbers that a portion of a drive may put on the tape: 8 MB of memory."""
_CORRECTIONS = 2
_FADES = 6
"""At most, at one event: zero rate and zero velocity, of which one is a correction each; a position's lasting error
moved on, met once more after it was renewed, and all states and both lasting errors where the state starts again."""


@kernel()
def note_move(core: Core, layout: Layout) -> None:
    """Put down the transition that P has just gone through: Core.phi and Core.turned."""
    tape, phi = core.tape, core.phi
    end, columns = core.tape_end[0], phi.shape[1]
    core.tape_end[0] = last = end + 9 * columns + 12
    if last > len(tape):
        return
    for i in range(9):
        for j in range(columns):
            tape[end] = phi[i, j]
            end += 1
    for i in range(3):
        for j in range(3):
            tape[end] = core.turned[i, j]
            end += 1
    tape[end], tape[end + 1], tape[end + 2] = layout.gyro_scale, layout.gyro_misalignment, MOVED


@kernel()
def note_coast(core: Core, seconds: float) -> None:
    """Put down that P went on at constant velocity."""
    end = core.tape_end[0]
    core.tape_end[0] = end + 2
    if end + 2 <= len(core.tape):
        core.tape[end], core.tape[end + 1] = seconds, COASTED


@kernel()
def note_fade(core: Core, first: int, count: int, keep: float) -> None:
    """Put down that so many errors from the first on went on as a share of themselves and something new."""
    tape, end = core.tape, core.tape_end[0]
    core.tape_end[0] = end + 4
    if end + 4 <= len(tape):
        tape[end], tape[end + 1], tape[end + 2], tape[end + 3] = first, count, keep, FADED


@kernel()
def note_correction(core: Core, dof: int) -> None:
    """Put down the correction just made: what ``innovate``, ``whiten`` and ``correct`` left in the core."""
    tape, H, L, W, white, dx = core.tape, core.H, core.L, core.W, core.residual, core.dx
    end, size = core.tape_end[0], len(dx)
    core.tape_end[0] = end + dof * (2 * size + 1) + 5
    if core.tape_end[0] > len(tape):
        return
    for i in range(dof):
        row = end + i * size
        for j in range(size):
            tape[row + j] = H[i, j]
        for k in range(i):
            for j in range(size):
                tape[row + j] -= L[i, k] * tape[end + k * size + j]
        for j in range(size):
            tape[row + j] /= L[i, i]
    end += dof * size
    for i in range(dof):
        for j in range(size):
            tape[end] = W[i, j]
            end += 1
    for i in range(dof):
        tape[end] = white[i]
        end += 1
    for i in range(3):
        tape[end + i] = 0.5 * dx[6 + i]
    tape[end + 3], tape[end + 4] = dof, CORRECTED


@kernel()
def note_state(core: Core, t: int) -> None:
    """Put down nav and P at time t, ns."""
    tape, nav, P = core.tape, core.nav, core.P
    end, size = core.tape_end[0], P.shape[0]
    core.tape_end[0] = end + len(nav) + size * (size + 1) // 2 + 3
    if core.tape_end[0] > len(tape):
        return
    for i in range(len(nav)):
        tape[end] = nav[i]
        end += 1
    for i in range(size):
        for j in range(i + 1):
            tape[end] = P[i, j]
            end += 1
    tape[end], tape[end + 1], tape[end + 2] = t // _SECOND, t % _SECOND, RECORDED


class Tape:
    """The records of a drive, in a temporary file of a folder (None: the system's) that vanishes with its user."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder
        self.axes_var = 0.0
        """As in ``fusion.events.Parameters``, for the smoothed states."""
        self._file = Spool(folder)
        self._buffer: Floats = np.empty(0)
        self._end = np.zeros(1, np.int64)

    def threaded(self, core: Core, numbers: int) -> Core:
        """The core with room for so many numbers on the tape; to be followed by ``keep``."""
        if len(self._buffer) < numbers:
            self._buffer = np.empty(max(numbers, PORTION))
        self._end[0] = 0
        return core._replace(tape=self._buffer, tape_end=self._end)

    def keep(self, core: Core, states: int) -> None:
        """Put away what the kernel wrote, in which there are so many states."""
        written = int(self._end[0])
        if written > len(self._buffer):
            raise AssertionError(f"tape: {written} numbers where {len(self._buffer)} were expected at most")
        if written:
            self._file.append(self._buffer[:written], np.array([states, len(core.dx)]))

    def cut(self, core: Core) -> None:
        """Part what was put down so far from what comes after a new start. core: of before or after."""
        self._file.append(np.array([CUT]), np.array([0, len(core.dx)]))

    def __reversed__(self) -> Iterator[tuple[Floats, int, int]]:
        """Portions from the last to the first: numbers, how many states are in it, the size of the error state."""
        for numbers, (states, size) in reversed(self._file):
            yield numbers, int(states), int(size)

    @property
    def nbytes(self) -> int:
        """Size of the file."""
        return self._file.nbytes

    def close(self) -> None:
        """Delete the file."""
        self._file.close()


def portions(
    core: Core, imu_t: NDArray[np.int64], event_t: NDArray[np.int64], par: Parameters, step_ns: int
) -> Iterator[tuple[slice, int]]:
    """IMU samples in parts, each with the most numbers that it can put on the tape: PORTION but for single samples.

    step_ns: by which gaps are crossed.
    """
    size, columns = len(core.dx), core.phi.shape[1]
    moved = 9 * columns + 12
    corrected, recorded = 6 * size + 8, size + size * (size + 1) // 2 + 4
    whole = np.diff(imu_t, prepend=core.clock[C_SAMPLE])
    steps = np.where(whole > par.max_gap_ns, whole // step_ns + 2, 0)
    events = np.diff(np.searchsorted(event_t, imu_t, side="right"), prepend=0)
    most = events * (moved + _CORRECTIONS * corrected + _FADES * 4 + recorded)
    most += (steps + events) * np.where(whole > par.bridge_ns, 2, moved) * (steps > 0) + moved
    part = (np.cumsum(most) - most) // PORTION
    edges = np.flatnonzero(np.diff(part, prepend=-1))
    for first, last in zip(edges, [*edges[1:], len(imu_t)], strict=True):
        yield slice(int(first), int(last)), int(most[first:last].sum())
