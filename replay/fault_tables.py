"""The fault matrix for people: a table for each set of sensors, the worst drive of each fault."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from rich.console import Group, RenderableType
from rich.text import Text

from replay.bench.faults import Cell, Matrix
from replay.fault_matrix import ALERT_S, SENSOR_SETS, SIGMAS
from replay.table import bare_table, number, percent
from sensors.simulate.faults import FAULTS

HEADERS = ("fault", "what happens", "AR %", "peak m", "peak deg", "error/sigma", "recovers s", "verdict")


class Line(NamedTuple):
    """A row of the table, as texts."""

    fault: str
    happens: str
    ar: str
    peak_m: str
    peak_deg: str
    sigmas: str
    recovers: str
    verdict: str


def line(cell: Cell) -> Line:
    """The worst of a fault's drives in each column."""
    fault, outcomes = FAULTS[cell.name], cell.outcomes
    told = fault.told(cell.severity, fault.length_s(cell.severity))
    times = [one.recover_s for one in outcomes]
    recovers = "never" if None in times else number(max(time for time in times if time is not None), 1)
    return Line(
        f"{cell.name}:{cell.severity}",
        told,
        percent(min(one.ar for one in outcomes), 1),
        number(max(one.peak_horizontal_m for one in outcomes), 2),
        number(max(one.peak_yaw_deg for one in outcomes), 2),
        number(max(one.peak_sigmas for one in outcomes), 1),
        recovers,
        verdict(cell),
    )


def verdict(cell: Cell) -> str:
    """In a word: ok where errors stayed within the limits or the filter knew of them."""
    if any(one.crash for one in cell.outcomes):
        return "CRASH"
    if any(one.not_finite for one in cell.outcomes):
        return "NOT FINITE"
    if any(one.silent for one in cell.outcomes):
        return "SILENT"
    if any(one.recover_s is None for one in cell.outcomes):
        return "lost, says so"
    if any(one.astray for one in cell.outcomes):
        return "astray, says so"
    return "ok" if all(one.ar == 1.0 for one in cell.outcomes) else "out, knows it"


def fault_tables(found: Matrix) -> Group:
    """A table for each set of sensors, then what the words mean."""
    parts: list[RenderableType] = []
    for sensors, cells in _by_sensors(found):
        table = bare_table(2)
        table.title, table.title_justify = f"{sensors} ({len(cells)} faults)", "left"
        for header in HEADERS:
            words = header in {"fault", "what happens", "verdict"}
            table.add_column(header, justify="left" if words else "right", no_wrap=header == "fault")
        for cell in cells:
            table.add_row(*line(cell))
        parts += [table, Text("")]
    return Group(*parts, *(Text(note) for note in notes(found)))


def notes(found: Matrix) -> Iterator[str]:
    """What was done and what the words mean, one line each."""
    seeds = ", ".join(map(str, found.seeds))
    yield f"Scenario clean, {found.duration_s:g} s, seeds {seeds}: the worst drive, from the fault's begin to the end."
    yield f"astray: beyond a limit and {SIGMAS:g} sigmas in some epoch; says so: no state was healthy then."
    yield f"SILENT: it was said to be healthy, or recovered, for more than {ALERT_S:g} s meanwhile."
    yield "lost: not back within the limits, nor within twice the error without the fault, before the drive ends."
    yield "out, knows it: beyond a limit for a while, within its own sigmas."
    counts = {word: sum(verdict(cell) == word for cell in found.cells) for word in map(verdict, found.cells)}
    yield "Verdicts: " + ", ".join(f"{count} {word}" for word, count in counts.items()) + "."


def markdown(found: Matrix) -> str:
    """The tables as a page of their own."""
    lines = [
        "# The fault matrix",
        "",
        f"Made by `egoloc bench faults --drives {len(found.seeds)} --seed {found.seeds[0]} ",
    ]
    lines[-1] += "--markdown docs/fault-matrix.md`; what it measures: [faults.md](faults.md)."
    for sensors, cells in _by_sensors(found):
        lines += ["", f"## {sensors.capitalize()}", "", _cells(HEADERS), _cells(["---", "---", *["--:"] * 5, "---"])]
        lines += [_cells(line(cell)) for cell in cells]
    return "\n".join([*lines, "", *notes(found)]) + "\n"


def _cells(texts: Sequence[str]) -> str:
    return "| " + " | ".join(texts) + " |"


def _by_sensors(found: Matrix) -> Iterator[tuple[str, list[Cell]]]:
    for sensors in SENSOR_SETS:
        yield sensors, [cell for cell in found.cells if cell.sensors == sensors]
