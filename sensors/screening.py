"""Which rows of a raw source may become a record: finite, in order, stamped near their arrival. The rest is counted."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sensors.records import LeftOut

JUMP_NS = 10_000_000_000
"""A stamp this far from its arrival (beyond the log's usual offset) has jumped."""


def screen(
    source: str,
    t_ns: NDArray[np.int64],
    arrival_ns: NDArray[np.int64],
    valid: Mapping[str, NDArray[np.bool_]],
) -> tuple[NDArray[np.bool_], tuple[LeftOut, ...]]:
    """Rows to keep, (N,) bool, and what was left out with its reason.

    valid: reason -> (N,) mask of rows that pass it, e.g. ``{"gyro is not finite": np.isfinite(gyro).all(1)}``.
    Then stamps: a stamp that jumps away from its arrival, repeats or goes back is left out; the first row wins.
    """
    keep = np.ones(len(t_ns), bool)
    left_out: list[LeftOut] = []

    def drop(reason: str, bad: NDArray[np.bool_]) -> None:
        bad = bad & keep
        if bad.any():
            left_out.append(LeftOut(source, reason, int(bad.sum())))
            keep[bad] = False

    for reason, passes in valid.items():
        drop(reason, ~passes)
    if keep.any():
        offset = t_ns - arrival_ns
        drop("stamp jumps away from its arrival", np.abs(offset - int(np.median(offset[keep]))) > JUMP_NS)
        previous = np.full(len(t_ns), np.iinfo(np.int64).min)
        stamps = np.where(keep, t_ns, np.iinfo(np.int64).min)
        previous[1:] = np.maximum.accumulate(stamps)[:-1]
        drop("stamp repeats", t_ns == previous)
        drop("stamp goes back", t_ns < previous)
    return keep, tuple(left_out)
