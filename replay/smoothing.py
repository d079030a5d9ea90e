"""A drive smoothed at its end: smoothed states beside the reference that the filter's were compared with.

While the filter runs, its tape and the reference at every epoch go into temporary files; memory does not follow the
length of the drive.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.events import new_recorder
from fusion.recording import states
from fusion.result import States
from fusion.smoother import smoothed
from fusion.spool import Spool
from fusion.tape import Tape
from replay.evaluation import Batch, split_at
from replay.references import FOREVER_NS, Samples

Columns = dict[str, NDArray[Any]]
Compare = Callable[[States, Samples], Columns]
"""Columns of states and of epochs without one beside the reference at all of them."""
TAGS = ("scene", "mode")


class Smoothing:
    """Takes the batches of a drive while it is filtered, and gives smoothed rows at its end.

    folder: where temporary files go (None: where the system has them); they have no name and vanish with the process.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.tape = Tape(folder)
        self._epochs = Spool(folder)

    def add(self, batch: Batch) -> None:
        """The next epochs of the drive."""
        samples = [np.asarray(getattr(batch.samples, f.name)) for f in fields(Samples)]
        self._epochs.append(*samples, *(batch.states[name] for name in TAGS))

    def rows(self, compare: Compare) -> Iterator[Columns]:
        """Columns as of states.parquet, in the order of time; only once, after all has been added."""
        coming, nothing = smoothed(self.tape), states(new_recorder(0, 0))
        held = [nothing]
        for *columns, scene, mode in self._epochs:
            samples = _samples(columns)
            until = int(samples.t_ns[-1]) if len(samples.t_ns) else -FOREVER_NS
            while _last_ns(held[-1]) < until and (portion := next(coming, None)) is not None:
                held.append(portion)
            here, held = split_at(held, until)
            held = held or [nothing]
            yield compare(here, samples) | dict(zip(TAGS, (scene, mode), strict=True))
        self.tape.close()
        self._epochs.close()


def _last_ns(found: States) -> int:
    return int(found.t_ns[-1]) if len(found) else -FOREVER_NS


def _samples(columns: list[NDArray[Any]]) -> Samples:
    names = [f.name for f in fields(Samples)]
    found: dict[str, Any] = dict(zip(names, columns, strict=True))
    return Samples(**found | {"has_heading": bool(found["has_heading"])})
