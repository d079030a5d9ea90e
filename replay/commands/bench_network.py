"""egoloc bench solver, network: what EgoVM costs."""

from dataclasses import dataclass

from replay.commands.bench_run import Number, at_least_one, printed, timed


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

        at_least_one(repeats=self.repeats, elements=self.elements)
        timed("solver", lambda: solver.run(self.repeats, self.elements), self.json)


@dataclass(frozen=True)
class BenchNetwork:
    """Networks by part: time of a frame, parameters, multiply-adds, memory of a training step, on all cores."""

    repeats: Number = 5
    """Timed frames of each mode, after two that warm up; the median counts."""
    paper: bool = True
    """Also a training step of the paper's sizes: a minute or more, and several GB."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import network
        from replay.table import bench_table

        at_least_one(repeats=self.repeats)
        printed("network", lambda _: network.run(self.repeats, self.paper), bench_table, self.json, cores="all")
