"""The modes of pose fixes travel on a topic of their own, so that the fixes stay a message that every tool reads.

Here the rows of both meet again, by stamp.
"""

from collections.abc import MutableMapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sensors.records import Floats, LeftOut, PoseFix, _Columns


@dataclass(frozen=True, slots=True, eq=False)
class PoseModes(_Columns):
    """Modes and weights of pose fixes, see PoseFix."""

    modes: Floats
    weights: Floats


def join_modes(rows: MutableMapping[str, Any], topic: str) -> tuple[LeftOut, ...]:
    """Put the pose_modes of a window (sensor -> record) into its pose_fixes; returns those without a fix."""
    found: PoseModes | None = rows.pop("pose_modes", None)
    if found is None:
        return ()
    fixes: PoseFix | None = rows.get("pose_fixes")
    matched = np.zeros(len(found), bool) if fixes is None else np.isin(found.t_ns, fixes.t_ns, assume_unique=True)
    if fixes is not None and matched.any():
        mine = found[matched]
        at = np.searchsorted(fixes.t_ns, mine.t_ns)
        modes, weights = fixes.modes.copy(), fixes.weights.copy()
        modes[at], weights[at] = mine.modes, mine.weights
        rows["pose_fixes"] = replace(fixes, modes=modes, weights=weights)
    strays = int((~matched).sum())
    return (LeftOut(topic, "no pose fix has this stamp", strays),) if strays else ()
