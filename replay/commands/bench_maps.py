"""egoloc bench maps, imports, lidar: what maps and the simulated world cost."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from replay.commands.bench_run import Number, above_zero, at_least_one, timed


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

        at_least_one(repeats=self.repeats)
        above_zero(km=(self.km,))
        timed("maps", lambda: maps.run(self.repeats, self.km), self.json)


@dataclass(frozen=True)
class BenchImports:
    """Time to import maps of other formats, their size, and how exactly they come back, on one core."""

    sources: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SRC...")]
    """Maps of any format that egoloc map import knows."""
    repeats: Number = 5
    """Timed imports of each, after one that warms up; the median counts."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import imports

        at_least_one(repeats=self.repeats, sources=len(self.sources))
        timed("imports", lambda: imports.run(self.sources, self.repeats), self.json)


@dataclass(frozen=True)
class BenchLidar:
    """Time and returns of the simulated LiDAR's sweeps, and what the world around costs, on one core."""

    repeats: Number = 3
    """Timed calls at each place, of which the least time counts."""
    sweeps: Number = 20
    """Places."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run the benchmark."""
        from replay.bench import lidar

        at_least_one(repeats=self.repeats, sweeps=self.sweeps)
        timed("lidar", lambda: lidar.run(self.repeats, self.sweeps), self.json)
