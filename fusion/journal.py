"""What the kernel records, call by call, until somebody takes it."""

from dataclasses import fields
from typing import TypeVar

import numpy as np

from fusion.events import Recorder, new_recorder
from fusion.recording import decided, states
from fusion.result import Decisions, States
from fusion.state import Nanoseconds

Columns = TypeVar("Columns", States, Decisions)

_ROWS = 1024
"""States and decisions that fit into a recorder, or more."""


class Journal:
    """A recorder with room for the next call; a full one is emptied into lists."""

    def __init__(self, known: list[States], made: list[Decisions], kept: int | None, axes_var: float) -> None:
        """known, made: where states and decisions go; kept: so many are kept there, or a few more (None: all).

        axes_var: as in ``fusion.events.Parameters``.
        """
        self._states, self._decisions, self._kept, self._axes_var = known, made, kept, axes_var
        self._recorder: Recorder | None = None
        self.stamps: Nanoseconds = np.zeros((0, 3), np.int64)
        """(M, 3): time, arrival and log row of the recorder's decisions."""

    def room(self, recorded: int, made: int) -> Recorder:
        """A recorder that takes so many states and decisions more."""
        rec = self._recorder
        if rec is not None and rec.filled[0] + recorded <= len(rec.t) and rec.filled[1] + made <= len(rec.event):
            return rec
        self.flush()
        if rec is not None and self._recorder is rec and recorded <= len(rec.t) and made <= len(rec.event):
            return rec
        self._recorder = rec = new_recorder(max(recorded, _ROWS), max(made, _ROWS), self._axes_var)
        self.stamps = np.zeros((len(rec.event), 3), np.int64)
        return rec

    def flush(self) -> None:
        """Put what the recorder holds into the lists. One that forgets is used again: it makes no new arrays."""
        rec = self._recorder
        if rec is None:
            return
        reused = self._kept is not None
        if rec.filled[0]:
            known = states(rec)
            self._states.append(_copy(known) if reused else known)
        if rec.filled[1]:
            made = decided(rec, *self.stamps[: int(rec.filled[1])].T.copy())
            self._decisions.append(_copy(made) if reused else made)
        if self._kept is None:
            self._recorder = None
            return
        rec.filled[:] = 0
        _forget(self._states, self._kept)
        _forget(self._decisions, self._kept)


def _copy(record: Columns) -> Columns:
    return type(record)(**{f.name: getattr(record, f.name).copy() for f in fields(record)})


def _forget(parts: list[States] | list[Decisions], kept: int) -> None:
    """Drop the oldest parts while so many rows remain."""
    rows = sum(len(part.t_ns) for part in parts)
    while parts and rows - len(parts[0].t_ns) >= kept:
        rows -= len(parts.pop(0).t_ns)
