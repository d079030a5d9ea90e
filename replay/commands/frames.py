"""egoloc frames."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from replay.commands.output import check_drawings, stage
from sensors.errors import EgolocError


@dataclass(frozen=True)
class Frames:
    """Show frames of a log: LiDAR points in the images that were taken at the same time."""

    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    """A log with images, and LiDAR sweeps."""
    png: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png", help_behavior_hint="(default: none)")] = None
    """Draw the first frame into a picture."""
    rrd: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd", help_behavior_hint="(default: none)")] = None
    """Write the frames as a recording for the rerun viewer."""
    at: Annotated[float, tyro.conf.arg(metavar="S")] = 0.0
    """Where to begin, s after the log's first frame."""
    count: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """How many frames the recording holds; all of them are in memory at once."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml", help_behavior_hint="(default: none)")] = None
    """A config whose [topics] choose between topics."""

    def run(self, _: tuple[str, ...]) -> None:
        """Read, draw, and say where."""
        from replay.chosen_frames import chosen_frames
        from replay.config import RunConfig, load_config

        if self.png is None and self.rrd is None:
            raise EgolocError("frames: expected --png FILE, --rrd FILE or both")
        if not self.at >= 0.0 or self.count < 1:
            raise EgolocError(
                f"frames: expected --at of 0 or more and --count of 1 or more, got {self.at} and {self.count}"
            )
        check_drawings((self.png, self.rrd), (self.log, self.config))
        config = RunConfig() if self.config is None else load_config(self.config)
        with stage(f"reading {self.log}"):
            chosen = chosen_frames(self.log, config.topics, self.at, self.count)
        with stage("drawing"):
            if self.png is not None:
                from replay.frame_picture import draw_frame

                draw_frame(chosen[0], self.png)
            if self.rrd is not None:
                from replay.frame_viewer import write_frames

                write_frames(chosen, self.rrd)
        if self.png is not None:
            print(f"Picture: {self.png}")
        if self.rrd is not None:
            print(f"Recording: {self.rrd}")
