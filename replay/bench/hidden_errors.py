"""Errors at the ends of hidden stretches, and the rows that they make.

Horizontal errors over sigma are the root mean square per axis: sqrt(mean(e' C^-1 e / 2)), where C is the covariance of
the estimate plus that of what it is compared with; 1 is honest.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.baselines import enu_between
from replay.bench.hidden_egoloc import Estimates
from replay.bench.hidden_plan import Plan
from sensors.rotation import wrap

Floats = NDArray[np.float64]
Row = dict[str, Any]

ALL, FIRST, SECOND, ACROSS = "all", "first half", "second half", "across"


class Miss(NamedTuple):
    """One end: horizontal error, m; e' C^-1 e; error of yaw, rad, and the same in its sigmas, NaN where not known.

    part: FIRST where the stretch ends before the middle of the drive, SECOND where it begins after it.
    """

    length_s: float
    part: str
    horizontal: float
    squared: float
    yaw: float
    yaw_sigmas: float


def misses(planned: Plan, estimates: Estimates) -> Iterator[Miss]:
    """Errors of one filter on one log."""
    for stretch in planned.stretches:
        for length, end in stretch.ends.items():
            found = estimates.get((stretch.start_ns, length))
            if found is None:
                continue
            error = enu_between(end.llh, found.llh)[:2]
            squared = float(error @ np.linalg.solve(found.cov + end.cov, error))
            yaw = float(wrap(found.yaw - end.yaw))
            over = yaw / float(np.sqrt(found.yaw_var + end.yaw_sigma**2))
            early, late = end.t_ns <= planned.middle_ns, stretch.start_ns >= planned.middle_ns
            part = FIRST if early else SECOND if late else ACROSS
            yield Miss(length, part, float(np.hypot(*error)), squared, yaw, over)


def rows_of(log: str, found: Mapping[str, list[Miss]], lengths: Sequence[float], *, halves: bool) -> list[Row]:
    """Rows of horizontal and yaw errors for each part, length and method."""
    rows = []
    for part in (ALL, FIRST, SECOND) if halves else (ALL,):
        for length in lengths:
            for method, missed in found.items():
                mine = [m for m in missed if m.length_s == length and part in (ALL, m.part)]
                if mine:
                    rows += _rows({"name": method, "log": log, "part": part, "length_s": length}, mine)
    return rows


def _rows(place: Row, missed: list[Miss]) -> list[Row]:
    horizontal = np.array([m.horizontal for m in missed])
    over = rms([m.squared / 2.0 for m in missed], squared=True)
    rows = [{**place, "metric": "end_horizontal_m", **_figures(horizontal), "error_over_sigma_rms": over}]
    known = [m for m in missed if np.isfinite(m.yaw)]
    if known:
        yaw = np.degrees(np.abs([m.yaw for m in known]))
        over = rms([m.yaw_sigmas for m in known])
        rows.append({**place, "metric": "end_yaw_deg", **_figures(yaw), "error_over_sigma_rms": over})
    return rows


def _figures(values: Floats) -> Row:
    low, middle, high = float(values.min()), float(np.median(values)), float(values.max())
    return {"count": len(values), "median": middle, "p95": float(np.percentile(values, 95)), "min": low, "max": high}


def rms(values: Sequence[float], *, squared: bool = False) -> float:
    """Root mean square; squared: of values that are squares already."""
    return float(np.sqrt(np.mean(values if squared else np.square(values))))


def ratios(rows: Sequence[Row]) -> dict[str, float]:
    """Horizontal error of egoloc with all it has over that of the best peer: median and 95 % of each block of rows."""
    blocks: dict[str, list[Row]] = {}
    for row in rows:
        if row["metric"] == "end_horizontal_m":
            part = "" if row["part"] == ALL else f", {row['part']}"
            blocks.setdefault(f"{row['log']}, {row['length_s']:g} s{part}", []).append(row)
    found = {}
    for block, here in blocks.items():
        own = next((r for r in here if r["name"] == "egoloc, all"), None)
        peers = [r for r in here if not r["name"].startswith("egoloc")]
        for figure in ("median", "p95") if own is not None and peers else ():
            assert own is not None
            found[f"{block}: {figure} of egoloc, all over the best peer's"] = own[figure] / min(
                r[figure] for r in peers
            )
    return found
