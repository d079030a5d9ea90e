"""`egoloc bench faults`: every fault in simulated drives, and what became of the filter (``replay.fault_matrix``)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from replay.bench.measure import conditions, row
from replay.fault_matrix import SENSOR_SETS, Outcome, matrix, subjects
from sensors.simulate.faults import FAULTS, SEVERITIES

SHORT_S, LONG_S = 180.0, 240.0
"""Lengths of the drives, s."""


@dataclass(frozen=True)
class Cell:
    """Outcomes of a fault, one a drive."""

    name: str
    severity: str
    sensors: str
    outcomes: list[Outcome]


@dataclass(frozen=True)
class Matrix:
    """All cells, and the drives that they come from."""

    cells: list[Cell]
    seeds: list[int]
    duration_s: float


def matrix_of(
    drives: int, first_seed: int, *, short: bool = False, tell: Callable[[str], None] = lambda _: None
) -> Matrix:
    """The matrix over so many drives. short: one shorter drive and the medium severity alone."""
    duration_s = SHORT_S if short else LONG_S
    on = list(subjects(1 if short else drives, first_seed, duration_s))
    severities = ("medium",) if short else SEVERITIES
    cells = []
    for name in FAULTS:
        tell(name)
        cells += [Cell(*found) for found in matrix(on, (name,), severities)]
    return Matrix(cells, sorted({subject.seed for subject in on}), duration_s)


def report(found: Matrix) -> dict[str, Any]:
    """The matrix as the rows of a benchmark. An error that lasts to the drive's end has no recover_s."""
    rows = []
    for cell in found.cells:
        label = f"{cell.name}:{cell.severity}, {cell.sensors}"
        rows += [row(label, metric, values) for metric, values in _figures(cell.outcomes).items() if None not in values]
    facts = {"scenario": "clean", "seconds": found.duration_s, "seeds": found.seeds, "sensors": list(SENSOR_SETS)}
    return {"bench": "faults", "rows": rows, "ratios": {}, "conditions": conditions(["numba", "numpy"], **facts)}


def _figures(outcomes: list[Outcome]) -> dict[str, list[Any]]:
    """Metric -> its value in each drive, None where it has none."""
    whole = [one for one in outcomes if not one.broken]
    figures: dict[str, list[Any]] = {"broken": [float(one.broken) for one in outcomes]}
    if whole:
        figures |= {
            "ar": [one.ar for one in whole],
            "peak_horizontal_m": [one.peak_horizontal_m for one in whole],
            "peak_yaw_deg": [one.peak_yaw_deg for one in whole],
            "peak_error_over_sigma": [one.peak_sigmas for one in whole],
            "recover_s": [one.recover_s for one in whole],
            "astray": [float(one.astray) for one in whole],
            "untold_s": [one.untold_s for one in whole],
            "warned": [float(bool(one.warned)) for one in whole],
            "silent": [float(one.silent) for one in whole],
        }
    return figures
