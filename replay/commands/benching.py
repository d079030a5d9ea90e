"""egoloc bench: speed beside other libraries, and how well the filter does where it is hard."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from replay.commands.output import print_json, stage
from sensors.errors import EgolocError

Number = Annotated[int, tyro.conf.arg(metavar="N")]
Hours = Annotated[float, tyro.conf.arg(metavar="H")]


@dataclass(frozen=True)
class BenchFilter:
    """IMU steps/s of the whole filter, beside filterpy, gtsam and pyins, on one core."""

    repeats: Number = 5
    """Timed calls of each row, after one that warms up; the median counts."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import filter

        _at_least_one(repeats=self.repeats)
        _timed("filter", lambda: filter.run(self.repeats), self.json)


@dataclass(frozen=True)
class BenchLive:
    """Time of a call of Localizer.push in arrival order, on one core."""

    repeats: Number = 3
    """Passes over the drive: their median counts, and of each call its least time."""
    hours: Hours = 1.0
    """Length of the drive, h."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import live

        _at_least_one(repeats=self.repeats)
        _above_zero(hours=(self.hours,))
        _timed("live", lambda: live.run(self.repeats, (self.hours,)), self.json)


@dataclass(frozen=True)
class BenchReplay:
    """A log to metrics.json: times real time, stages and memory, on one core."""

    repeats: Number = 5
    """Timed runs, after one that warms up; the median counts."""
    hours: Annotated[tuple[float, ...], tyro.conf.arg(metavar="H [H ...]")] = (1.0,)
    """Lengths of the log, h: figures of each and how the time grows."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import replay

        _at_least_one(repeats=self.repeats)
        _above_zero(hours=self.hours)
        _timed("replay", lambda: replay.run(self.repeats, self.hours), self.json)


@dataclass(frozen=True)
class BenchMcap:
    """IMU messages/s read from MCAP, beside the mcap package's own decoders, on one core."""

    repeats: Number = 5
    """Timed calls of each row, after one that warms up; the median counts."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import mcap

        _at_least_one(repeats=self.repeats)
        _timed("mcap", lambda: mcap.run(self.repeats), self.json)


@dataclass(frozen=True)
class BenchGates:
    """Naive gates beside ours, on scenes in which a naive one fails: AR and largest errors."""

    drives: Number = 5
    """Simulated drives of each scene."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import gates

        _at_least_one(drives=self.drives)
        _printed("gates", lambda _: gates.run(self.drives), gates.table, self.json)


@dataclass(frozen=True)
class BenchFaults:
    """Errors, recovery and warnings for every fault that --inject knows, on simulated drives."""

    drives: Number = 4
    """Simulated drives; figures are the worst of them."""
    seed: Number = 6000
    """Seed of the first of them."""
    short: bool = False
    """One drive and the medium severity alone."""
    markdown: Annotated[Path | None, tyro.conf.arg(metavar="FILE.md", help_behavior_hint="(default: none)")] = None
    """Write the tables there as well."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import faults
        from replay.fault_tables import fault_tables, markdown
        from replay.table import output_console

        _at_least_one(drives=self.drives)
        if self.seed < 0:
            raise EgolocError(f"--seed: expected 0 or more, got {self.seed}")
        with stage("benchmark faults") as tell:
            found = faults.matrix_of(self.drives, self.seed, short=self.short, tell=tell)
        if self.markdown is not None:
            self.markdown.write_text(markdown(found))
        if self.json:
            print_json(faults.report(found))
        else:
            output_console().print(fault_tables(found))


@dataclass(frozen=True)
class BenchHidden:
    """How far off after GNSS has been hidden for a while, beside pyins and gtsam on the same data."""

    logs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="LOG...", help_behavior_hint="(default: simulated drives of three IMU grades)"),
    ] = ()
    """Recorded logs."""
    lengths: Annotated[tuple[float, ...], tyro.conf.arg(metavar="S [S ...]")] = (15.0, 60.0)
    """How long GNSS is hidden, s."""
    every: Annotated[float, tyro.conf.arg(metavar="S")] = 10.0
    """From the start of a stretch to that of the next, s."""
    begin: Annotated[tuple[float, ...], tyro.conf.arg(name="from", metavar="S [S ...]")] = (60.0,)
    """Earliest begin of a stretch, s after the first GNSS position; each number begins a window."""
    end: Annotated[
        tuple[float, ...],
        tyro.conf.arg(name="to", metavar="S [S ...]", help_behavior_hint="(default: the log's end)"),
    ] = ()
    """Latest end of a stretch, s after the first GNSS position; one for each --from."""
    peers: Annotated[
        tuple[Literal["pyins", "gtsam"], ...] | None,
        tyro.conf.arg(metavar="{pyins,gtsam}", help_behavior_hint="(default: those installed)"),
    ] = None
    """Which others are run, one or both."""
    halves: bool = False
    """Also rows of the drive's first and of its second half: importers calibrate on the first."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import hidden
        from replay.bench.hidden_table import hidden_table

        windows = hidden_windows(self.begin, self.end)
        work = lambda _: hidden.run(self.logs, self.lengths, self.every, windows, self.peers, self.halves)  # noqa: E731
        _printed("hidden", work, hidden_table, self.json)


@dataclass(frozen=True)
class BenchConsistency:
    """Whether the filter's sigmas are honest: NEES of simulated drives, and P over a day."""

    seeds: Number = 200
    """Simulated drives of each case."""
    config: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE.toml", help_behavior_hint="(default: the default configuration)")
    ] = None
    """How drives whose errors last are filtered."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import consistency
        from replay.config import load_config

        _at_least_one(seeds=self.seeds)
        config = None if self.config is None else load_config(self.config).fusion
        work = lambda tell: consistency.run(self.seeds, config=config, watch=tell)  # noqa: E731
        _printed("consistency", work, consistency.table, self.json)


@dataclass(frozen=True)
class BenchMaps:
    """Size of map files by kind and column, and how fast a large one opens and answers, on one core."""

    repeats: Number = 3
    """Passes over the places that are asked for; of each place its least time counts."""
    km: Annotated[float, tyro.conf.arg(metavar="KM")] = 1000.0
    """Streets of the large map, km."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import maps

        _at_least_one(repeats=self.repeats)
        _above_zero(km=(self.km,))
        _timed("maps", lambda: maps.run(self.repeats, self.km), self.json)


@dataclass(frozen=True)
class BenchSolver:
    """The pose solver beside sampling features at every candidate: time, memory, growth, on one core."""

    repeats: Number = 3
    """Timed turns of each row, after one that warms up; the median counts."""
    elements: Number = 500
    """Map elements."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import solver

        _at_least_one(repeats=self.repeats, elements=self.elements)
        _timed("solver", lambda: solver.run(self.repeats, self.elements), self.json)


BENCHMARKS = {
    "filter": BenchFilter,
    "live": BenchLive,
    "replay": BenchReplay,
    "mcap": BenchMcap,
    "maps": BenchMaps,
    "solver": BenchSolver,
    "gates": BenchGates,
    "faults": BenchFaults,
    "hidden": BenchHidden,
    "consistency": BenchConsistency,
}


def hidden_windows(begin: tuple[float, ...], end: tuple[float, ...]) -> list[tuple[float, float]]:
    """Windows in which stretches lie, s since the first position. Raises where the numbers make none."""
    if end and len(end) != len(begin):
        raise EgolocError(f"--to: expected {len(begin)} numbers, one for each of --from, got {len(end)}")
    windows = list(zip(begin, end or (math.inf,) * len(begin), strict=True))
    for first, last in windows:
        if not 0.0 <= first < last:
            raise EgolocError(f"--from, --to: expected 0 <= from < to, got {first:g} and {last:g}")
    return windows


def _at_least_one(**options: int) -> None:
    """Raise for an option, by its name, of which there are none."""
    for name, value in options.items():
        if value < 1:
            raise EgolocError(f"--{name}: expected 1 or more, got {value}")


def _above_zero(**options: tuple[float, ...]) -> None:
    """Raise for an option, by its name, without numbers or with one that is no length of time."""
    for name, values in options.items():
        if not values or not all(0.0 < value < math.inf for value in values):
            raise EgolocError(
                f"--{name}: expected numbers above 0, got {', '.join(f'{v:g}' for v in values) or 'none'}"
            )


def _timed(name: str, work: Callable[[], Any], as_json: bool) -> None:
    """A benchmark of speed."""
    from replay.table import bench_table

    _printed(name, lambda _: work(), bench_table, as_json)


def _printed(
    name: str, work: Callable[[Callable[[str], None]], Any], table: Callable[[Any], Any], as_json: bool
) -> None:
    """Run on one core, print the result as a table or as JSON. work: hears where it may tell what it is doing."""
    from replay.bench.measure import one_core
    from replay.table import output_console

    with stage(f"benchmark {name}") as tell, one_core():
        result = work(tell)
    if as_json:
        print_json(result)
    else:
        output_console().print(table(result))
