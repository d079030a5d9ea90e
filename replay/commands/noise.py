"""egoloc allan and noise: how noisy an IMU is, and how noisy GNSS and pose fixes are."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from replay.commands.output import print_json, stage

ALLAN_OUT = Path("runs/allan")


@dataclass(frozen=True)
class Allan:
    """Noise figures of an IMU, by overlapping Allan deviation over the longest stretch of a log at rest.

    Prints angle and velocity random walk, bias instability and drift of each axis, and the vehicle table to paste into
    a config. Hours at rest, engine off, are what it takes for the drifts; a minute shows the random walks.
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


@dataclass(frozen=True)
class Noise:
    """Noise of GNSS and pose fixes: how long their errors last, and how much larger or smaller they are than stated.

    First what the run's innovations say; then its log is filtered again and again, to find the noise under which they
    are most likely, with 95 % intervals. Prints the lines to paste into a config.
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """A run folder of one log, with all decisions."""
    log: Annotated[
        str | None, tyro.conf.arg(metavar="LOG", help_behavior_hint="(default: the one that the run was made of)")
    ] = None
    """Its log, where that has moved."""
    duration_s: Annotated[float, tyro.conf.arg(metavar="S")] = 1800.0
    """Filter so much of the log, from its start, s."""
    json: bool = False
    """Print JSON instead of the tables."""

    def run(self, _: tuple[str, ...]) -> None:
        """Judge, search, print."""
        from replay.commands.looking import check_no_campaign
        from replay.noise import facts, noise_of_run
        from replay.noise_table import print_noise

        check_no_campaign(self.folder)
        with stage(f"noise of {self.folder}") as tell:
            found = noise_of_run(self.folder, self.log, self.duration_s, tell)
        if self.json:
            print_json(facts(found))
        else:
            print_noise(found)
