"""egoloc view."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from replay.commands.output import stage
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
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[RUN_B]", help_behavior_hint="(default: none)")
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
