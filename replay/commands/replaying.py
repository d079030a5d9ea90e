"""egoloc replay, score and demo."""

import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import tyro

from replay.commands.output import print_json, stage
from sensors.errors import EgolocError

if TYPE_CHECKING:
    from replay.config import RunConfig


@dataclass(frozen=True)
class Replay:
    """Run a log through the filter and score it against its reference.

    Writes a run folder: config.toml, manifest.json, metrics.json, states.parquet and decisions.parquet.
    """

    logs: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="LOG [LOG ...]")]
    """MCAP logs. One log becomes the run folder RUN, several become RUN/<name of the log> each."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """The run folder to write; it must not exist yet."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """TOML with any of [topics], [vehicle], [map_frame], [fusion], [limits], [hide_gnss]; the rest has defaults."""
    limits: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Largest longitudinal, lateral and yaw error: paper (0.6 m, 0.3 m, 1 deg), highway (1.4 m, 0.57 m, 1.5 deg) or
    local-street (0.29 m, 0.29 m, 0.5 deg); default: the config's, else paper."""
    reference: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A trajectory to score against instead of the log's: TUM, CSV with named columns, or Applanix."""
    hide_gnss: Annotated[str | None, tyro.conf.arg(metavar="EVERY:LENGTH")] = None
    """Hide GNSS for LENGTH seconds every EVERY seconds and score against the hidden RTK-fixed fixes, as in 60:15.
    The first stretch starts EVERY seconds after the first fix; one that the log's end cuts off is not used."""
    overwrite: bool = False
    """Replace RUN if it is a run folder."""
    json: bool = False
    """Print metrics.json instead of the table; of several logs, one object with a key each."""

    def run(self, arguments: tuple[str, ...]) -> None:
        """Replay every log; arguments: the command line, for the manifest."""
        from replay.harness import replay_file
        from replay.store import check_free

        config, folders = self._settings(), self._folders()
        for folder in folders.values():
            check_free(folder, overwrite=self.overwrite)
        metrics = {}
        for log, folder in folders.items():
            with stage(f"replaying {log}"):
                done = replay_file(
                    log, folder, config, reference_file=self.reference, overwrite=self.overwrite, command=arguments
                )
            metrics[log.stem] = done.metrics
            if not self.json:
                _show(done.metrics, folder, heading=str(log) if len(folders) > 1 else None)
        if self.json:
            print_json(metrics if len(folders) > 1 else next(iter(metrics.values())))

    def _settings(self) -> "RunConfig":
        from replay.config import RunConfig, load_config, named_limits, parse_hide_gnss

        config = RunConfig() if self.config is None else load_config(self.config)
        if self.limits is not None:
            config = msgspec.structs.replace(config, limits=named_limits(self.limits))
        if self.hide_gnss is not None:
            config = msgspec.structs.replace(config, hide_gnss=parse_hide_gnss(self.hide_gnss))
        return config

    def _folders(self) -> dict[Path, Path]:
        """Log -> run folder."""
        if not self.logs:
            raise EgolocError("replay: expected at least one log")
        if len(self.logs) == 1:
            return {self.logs[0]: self.out}
        repeated = [stem for stem, n in Counter(log.stem for log in self.logs).items() if n > 1]
        if repeated:
            raise EgolocError(f"replay: expected logs of different names, got {repeated[0]!r} twice")
        if (self.out / "manifest.json").exists():
            raise EgolocError(f"{self.out}: is a run folder: choose another --out to hold the runs of several logs")
        return {log: self.out / log.stem for log in self.logs}


@dataclass(frozen=True)
class Score:
    """Compute the metrics of a run again from its tables, for instance with other limits; nothing is filtered."""

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """A run folder; its metrics.json is replaced."""
    limits: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Limits on the error: paper, highway or local-street (see replay); default: those of the run's config.toml."""
    json: bool = False
    """Print metrics.json instead of the table."""

    def run(self, _: tuple[str, ...]) -> None:
        from replay.config import load_config, named_limits
        from replay.scoring import score
        from replay.store import load_run, write_json

        run = load_run(self.folder)
        limits = (
            named_limits(self.limits) if self.limits is not None else load_config(self.folder / "config.toml").limits
        )
        metrics = score(run, limits)
        try:
            write_json(self.folder / "metrics.json", metrics)
        except OSError as error:
            raise EgolocError(f"{self.folder / 'metrics.json'}: cannot be written: {error.strerror}") from None
        if self.json:
            print_json(metrics)
        else:
            _show(metrics, self.folder)


@dataclass(frozen=True)
class Demo:
    """Simulate ten minutes of city, write them as an MCAP log, replay it and print the table. Needs no data."""

    out: Annotated[Path, tyro.conf.arg(metavar="RUN")] = Path("runs/demo")
    """The run folder; the log goes beside it as RUN.mcap. Both replace those of an earlier demo."""
    json: bool = False
    """Print metrics.json instead of the table."""

    def run(self, arguments: tuple[str, ...]) -> None:
        from replay.config import RunConfig
        from replay.harness import replay_file
        from replay.run_files import read_json
        from replay.store import check_free
        from sensors.mcap.io import write_log
        from sensors.simulate.drive import simulate
        from sensors.simulate.scenarios import load

        again = self.out.is_dir() and "demo" in read_json(self.out / "manifest.json").get("command", ())[1:2]
        check_free(self.out, overwrite=again)
        path = self.out.with_name(f"{self.out.name}.mcap")
        scenario = load("demo")
        with stage(f"simulating {scenario.duration_s:g} s of driving"):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_log(path, simulate(scenario.duration_s, scenario.seed, scenario))
        with stage(f"replaying {path}"):
            done = replay_file(path, self.out, RunConfig(), overwrite=again, command=arguments)
        if self.json:
            print_json(done.metrics)
        else:
            _show(done.metrics, self.out, heading=f"{scenario.doc}\n")


def _show(metrics: Mapping[str, Any], folder: Path, heading: str | None = None) -> None:
    from replay.table import print_run

    if heading:
        print(heading)
    print_run(metrics)
    print(f"Run: {folder}")
    sys.stdout.flush()
