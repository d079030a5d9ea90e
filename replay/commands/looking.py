"""egoloc view and bench."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from replay.commands.output import print_json, stage
from sensors.errors import EgolocError

SHOWN = 10
"""Logs of a campaign that a message names."""


@dataclass(frozen=True)
class View:
    """Show a run, or two runs on one timeline, in rerun.

    Writes RUN/run.rrd, or of two runs RUN_and_RUN_B.rrd beside RUN.
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """A run folder."""
    other: Annotated[
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="RUN_B", help_behavior_hint="(default: none)")
    ] = None
    """A second run of the same log, to compare by eye."""
    rrd: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd", help_behavior_hint="(default: in or beside RUN)")] = (
        None
    )
    """Where to write the recording."""
    no_open: bool = False
    """Only write the recording."""

    def run(self, _: tuple[str, ...]) -> None:
        """Write the recording and open it where there is a display."""
        from replay.viewer import open_viewer, write_recording

        for folder in filter(None, (self.folder, self.other)):
            check_no_campaign(folder)
        with stage("drawing"):
            rrd = write_recording(self.folder, self.rrd, self.other)
        print(f"Recording: {rrd}")
        if not self.no_open and not open_viewer(rrd):
            print(f"No display here. On a machine with one: rerun {rrd}")


@dataclass(frozen=True)
class Bench:
    """Measure speed side by side with other libraries, or whether the filter's sigmas are honest, on one core."""

    name: tyro.conf.Positional[Literal["filter", "replay", "mcap", "consistency"]]
    """filter: IMU steps/s; replay: an hour of log to metrics.json; mcap: messages/s; consistency: NEES of drives."""
    repeats: int = 5
    """Timed calls of each row, after one that warms up; the median counts."""
    hours: tuple[float, ...] = (1.0,)
    """Lengths of the log, h (replay only): figures of each and how the time grows."""
    seeds: int = 200
    """Simulated drives of each case (consistency only)."""
    config: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE.toml", help_behavior_hint="(default: the default configuration)")
    ] = None
    """How drives whose errors last are filtered (consistency only)."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run one benchmark."""
        from replay.bench.measure import one_core

        bench = import_module(f"replay.bench.{self.name}")
        with stage(f"benchmark {self.name}") as tell, one_core():
            result = bench.run(**self._options(tell))
        if self.json:
            print_json(result)
            return
        from replay.table import bench_table, output_console

        output_console().print(bench.table(result) if self.name == "consistency" else bench_table(result))

    def _options(self, tell: Callable[[str], None]) -> dict[str, Any]:
        """What the benchmark is told."""
        if self.name != "consistency":
            return {"repeats": self.repeats} | ({"hours": self.hours} if self.name == "replay" else {})
        from replay.config import load_config

        if self.seeds < 1:
            raise EgolocError(f"--seeds: expected 1 or more, got {self.seeds}")
        config = None if self.config is None else load_config(self.config).fusion
        return {"seeds": self.seeds, "config": config, "watch": tell}


def check_no_campaign(folder: Path) -> None:
    """Raise where a folder holds the runs of several logs."""
    from replay.campaign_folder import is_campaign, log_names

    if not is_campaign(folder):
        return
    names = [name for name in log_names(folder) if (folder / name).is_dir()]
    if not names:
        raise EgolocError(f"{folder}: expected the run of one log, got a campaign without any finished log")
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    shown = ", ".join(names[:SHOWN])
    raise EgolocError(f"{folder}: expected the run of one log, as in {folder / names[0]}; there are {shown}{more}")
