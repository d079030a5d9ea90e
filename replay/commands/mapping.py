"""egoloc map info."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from replay.commands.output import print_json, stage
from sensors.errors import EgolocError


@dataclass(frozen=True)
class MapInfo:
    """Say what is in a map, how large it is, and where along it a vehicle would not be localized well."""

    map: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MAP")]
    """A map file."""
    route: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE|LOG", help_behavior_hint="(default: the lines of the map)")
    ] = None
    """Where it is judged: a trajectory (TUM, CSV, Applanix) or the reference of a log (.mcap), in the map's frame or
    one that converts into it."""
    limits: Annotated[str, tyro.conf.arg(metavar="NAME")] = "paper"
    """Errors that count as localized: paper, highway, local-street; degenerate is a sigma beyond a third of them."""
    png: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png", help_behavior_hint="(default: none)")] = None
    """Draw the map and what is predicted along it."""
    rrd: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd", help_behavior_hint="(default: none)")] = None
    """Write the same as a recording for rerun."""
    json: bool = False
    """Print JSON."""

    def run(self, _: tuple[str, ...]) -> None:
        """Judge the map, draw it, and say what was found."""
        from replay.config import named_limits
        from replay.map_info import judged_map, map_info
        from sensors.maps.map_file import open_map

        limits = named_limits(self.limits)
        self._check_targets()
        with open_map(self.map) as opened:
            with stage(f"judging {self.map}"):
                route, found = judged_map(opened, self.route)
                info = map_info(opened, route, found, self.route, limits)
            if self.png is not None:
                from replay.map_picture import draw

                with stage(f"drawing {self.png}"):
                    draw(opened, route, found, info, self.png)
            if self.rrd is not None:
                from replay.map_viewer import write_map_recording

                with stage(f"drawing {self.rrd}"):
                    write_map_recording(opened, route, found, info, self.rrd)
        if self.json:
            print_json(info)
            return
        from replay.map_table import info_tables
        from replay.table import output_console

        output_console().print(info_tables(info))

    def _check_targets(self) -> None:
        """What is drawn replaces a file of that name: it must not be a map or a log."""
        for option, path, suffix in (("--png", self.png, ".png"), ("--rrd", self.rrd, ".rrd")):
            if path is not None and path.suffix.lower() != suffix:
                raise EgolocError(f"{option}: expected a file name that ends in {suffix}, got {path}")
