"""egoloc view and bench."""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

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
    """Measure speed side by side with other libraries, in one run on one core; or what becomes of failing sensors."""

    name: tyro.conf.Positional[Literal["filter", "live", "replay", "mcap", "gates", "faults"]]
    """filter: IMU steps/s; live: time of a push; replay: an hour of log to metrics.json; mcap: messages/s; gates: naive
    gates beside ours; faults: errors, recovery and warnings for every fault that --inject knows."""
    repeats: int = 5
    """Timed calls of each row, after one that warms up; the median counts. Of gates: drives of each scene."""
    hours: tuple[float, ...] = (1.0,)
    """Lengths of the log, h (replay: figures of each and how the time grows; live: the first)."""
    drives: int = 4
    """Simulated drives (faults only); figures are the worst of them."""
    seed: int = 6000
    """Seed of the first of them (faults only)."""
    short: bool = False
    """One drive and the medium severity alone (faults only)."""
    markdown: Annotated[Path | None, tyro.conf.arg(metavar="FILE.md", help_behavior_hint="(default: none)")] = None
    """Write the tables there as well (faults only)."""
    """Simulated drives (faults only); figures are the worst of them."""
    seed: int = 6000
    """Seed of the first of them (faults only)."""
    short: bool = False
    """One drive and the medium severity alone (faults only)."""
    markdown: Annotated[Path | None, tyro.conf.arg(metavar="FILE.md", help_behavior_hint="(default: none)")] = None
    """Write the tables there as well (faults only)."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run one benchmark."""
        if self.name == "faults":
            self._faults()
            return
        from replay.bench.measure import one_core

        options = {"hours": self.hours} if self.name in ("replay", "live") else {}
        bench = import_module(f"replay.bench.{self.name}")
        with stage(f"benchmark {self.name}"), one_core():
            result = bench.run(repeats=self.repeats, **options)
        if self.json:
            print_json(result)
            return
        from replay.table import bench_table, output_console

        output_console().print(bench.table(result) if self.name == "gates" else bench_table(result))

    def _faults(self) -> None:
        from replay.bench import faults
        from replay.fault_tables import fault_tables, markdown
        from replay.table import output_console

        if self.drives < 1 or self.seed < 0:
            raise EgolocError(f"bench: --drives, --seed: expected 1 or more, 0 or more, got {self.drives}, {self.seed}")
        with stage("benchmark faults") as tell:
            found = faults.matrix_of(self.drives, self.seed, short=self.short, tell=tell)
        if self.markdown is not None:
            self.markdown.write_text(markdown(found))
        if self.json:
            print_json(faults.report(found))
        else:
            output_console().print(fault_tables(found))


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
