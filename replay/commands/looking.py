"""egoloc view and bench."""

import math
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
    """Measure side by side with other libraries, in one run on one core."""

    name: tyro.conf.Positional[Literal["filter", "replay", "mcap", "hidden"]]
    """filter: IMU steps/s of the filter; replay: an hour of log to metrics.json; mcap: IMU messages/s read; hidden: how
    far off after GNSS has been hidden for a while."""
    logs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="LOG...", help_behavior_hint="(default: simulated drives of three IMU grades)"),
    ] = ()
    """Recorded logs (hidden only)."""
    repeats: int = 5
    """Timed calls of each row, after one that warms up; the median counts (not for hidden)."""
    hours: tuple[float, ...] = (1.0,)
    """Lengths of the log, h (replay only): figures of each and how the time grows."""
    lengths: tuple[float, ...] = (15.0, 60.0)
    """How long GNSS is hidden, s (hidden only)."""
    every: float = 10.0
    """From the start of a stretch to that of the next, s (hidden only)."""
    begin: Annotated[tuple[float, ...], tyro.conf.arg(name="from")] = (60.0,)
    """Stretches begin so long after the first GNSS position at least; several make as many windows, s (hidden only)."""
    end: Annotated[tuple[float, ...], tyro.conf.arg(name="to", help_behavior_hint="(default: the log's end)")] = ()
    """They end so long after it at most, one number for each --from, s (hidden only)."""
    peers: Annotated[
        tuple[Literal["pyins", "gtsam"], ...] | None, tyro.conf.arg(help_behavior_hint="(default: those installed)")
    ] = None
    """Which others are run (hidden only)."""
    halves: bool = False
    """Rows of the drive's first and second half as well: importers calibrate on the first (hidden only)."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Run one benchmark."""
        from replay.bench.measure import one_core

        if self.logs and self.name != "hidden":
            raise EgolocError(f"bench {self.name}: expected no log, got {self.logs[0]}")
        with stage(f"benchmark {self.name}"), one_core():
            result = import_module(f"replay.bench.{self.name}").run(**self._options())
        if self.json:
            print_json(result)
            return
        from replay.bench.hidden_table import hidden_table
        from replay.table import bench_table, output_console

        output_console().print(hidden_table(result) if self.name == "hidden" else bench_table(result))

    def _options(self) -> dict[str, Any]:
        if self.name == "hidden":
            windows = hidden_windows(self.begin, self.end)
            names = ("logs", "lengths", "every", "peers", "halves")
            return {"windows": windows, **{name: getattr(self, name) for name in names}}
        return {"repeats": self.repeats} | ({"hours": self.hours} if self.name == "replay" else {})


def hidden_windows(begin: tuple[float, ...], end: tuple[float, ...]) -> list[tuple[float, float]]:
    """Windows in which stretches lie, s since the first position. Raises where the numbers make none."""
    if end and len(end) != len(begin):
        raise EgolocError(f"--to: expected {len(begin)} numbers, one for each of --from, got {len(end)}")
    windows = list(zip(begin, end or (math.inf,) * len(begin), strict=True))
    for first, last in windows:
        if not 0.0 <= first < last:
            raise EgolocError(f"--from, --to: expected 0 <= from < to, got {first:g} and {last:g}")
    return windows


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
