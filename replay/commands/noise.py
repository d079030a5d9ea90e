"""egoloc allan: how noisy an IMU is."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from replay.commands.output import print_json, stage

ALLAN_OUT = Path("runs/allan")


@dataclass(frozen=True)
class Allan:
    """Noise figures of an IMU, by overlapping Allan deviation over the longest stretch of a log at rest.

    Prints angle and velocity random walk, bias instability and drift of each axis, and the vehicle table to paste into a
    config. Hours at rest, engine off, are what it takes for the drifts; a minute shows the random walks.
    """

    log: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="LOG")]
    """An MCAP log, or scenario:static for a simulated one."""
    from_s: Annotated[
        float | None, tyro.conf.arg(name="from", metavar="S", help_behavior_hint="(default: the log's first sample)")
    ] = None
    """Look for rest from here on, s after the first IMU sample."""
    to_s: Annotated[
        float | None, tyro.conf.arg(name="to", metavar="S", help_behavior_hint="(default: the log's end)")
    ] = None
    """Look for rest up to here, s after the first IMU sample."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = ALLAN_OUT
    """A folder for allan.png, allan.json and vehicle.toml; those of an earlier analysis are replaced."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml", help_behavior_hint="(default: none)")] = None
    """A config whose [topics] choose between topics."""
    json: bool = False
    """Print JSON instead of the table."""

    def run(self, _: tuple[str, ...]) -> None:
        """Analyse, draw, print."""
        from replay.allan import analyse, check_folder, vehicle_toml
        from replay.allan_table import print_analysis
        from replay.config import RunConfig, load_config
        from replay.sources import parse
        from replay.store import storage, write_json
        from sensors.errors import EgolocError

        sources = parse(self.log)
        if len(sources) != 1:
            raise EgolocError(f"{self.log}: expected one drive, got {len(sources)}")
        check_folder(self.out)
        config = RunConfig() if self.config is None else load_config(self.config)
        with stage(f"reading {self.log}") as tell:
            analysis = analyse(sources[0], config, self.from_s, self.to_s)
            tell("drawing")
            from replay.allan_plot import draw

            with storage(self.out):
                self.out.mkdir(parents=True, exist_ok=True)
                draw(analysis, self.out / "allan.png")
                write_json(self.out / "allan.json", analysis.facts)
                (self.out / "vehicle.toml").write_text(vehicle_toml(analysis))
        if self.json:
            print_json(analysis.facts)
        else:
            print_analysis(analysis, self.out)
