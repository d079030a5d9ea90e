"""egoloc replay."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import tyro

from replay.commands.output import print_json, show, show_campaign, stage
from sensors.errors import EgolocError

if TYPE_CHECKING:
    from replay.batch import Job
    from replay.config import RunConfig
    from replay.sources import LogSource


@dataclass(frozen=True)
class Replay:
    """Run logs through the filter and score them against their references.

    Writes a run folder: config.toml, manifest.json, metrics.json and Parquet tables. Of several logs, a run folder each
    and the metrics of all; a log that fails is told at the end, and the exit code is 1.

    Drives that are simulated on the way: scenario:NAME[,drives=N][,seed=S][,length_km=L][,duration_s=T][,network=K].
    """

    logs: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="LOG [LOG ...]", help_behavior_hint="(required)")
    ]
    """MCAP files, or scenario:NAME. One log becomes the run folder RUN, several become RUN/<name of the log> each."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """The run folder to write; it must not exist yet."""
    config: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE.toml", help_behavior_hint="(default: none, as if empty)")
    ] = None
    """TOML with what differs from the defaults; config.toml in a run folder lists every table, key and value."""
    limits: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: the config's, else paper)")
    ] = None
    """Largest lon, lat, yaw error: paper 0.6 m, 0.3 m, 1 deg; highway 1.4, 0.57, 1.5; local-street 0.29, 0.29, 0.5."""
    reference: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: the log's)")] = None
    """A trajectory to score against: TUM, CSV with named columns, Applanix, or smoothed.parquet of a run."""
    hide_gnss: Annotated[
        str | None, tyro.conf.arg(metavar="EVERY:LENGTH", help_behavior_hint="(default: hide nothing)")
    ] = None
    """Hide GNSS for LENGTH s every EVERY s, as in 60:15, and score against the RTK-fixed fixes that were hidden."""
    order: Annotated[
        Literal["stamp", "arrival"] | None,
        tyro.conf.arg(metavar="{stamp,arrival}", help_behavior_hint="(default: the config's, else stamp)"),
    ] = None
    """Apply measurements by when they were true, or as they came: late ones by rewinding, states as known then."""
    estimate: Annotated[str | None, tyro.conf.arg(metavar="NAMES", help_behavior_hint="(default: the config's)")] = None
    """Estimate these along the way: lever-arm, mounting, gyro, delays (or gnss-delay, pose-delay), with commas."""
    inject: Annotated[
        tuple[str, ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(metavar="SPEC", help_behavior_hint="(repeatable; default severity medium, begin 60)"),
    ] = ()
    """Make sensors fail: NAME[:mild|medium|severe][@BEGIN[+LENGTH]], in s, with commas. An unknown NAME lists all."""
    smooth: bool = False
    """Smooth each drive as well, backwards from its end: one more row; smoothed.parquet, which --reference reads."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: one per core)")] = None
    """Logs replayed at a time, each in a process of its own."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS", help_behavior_hint="(default: this machine)")] = None
    """Replay on a Ray cluster: its HOST:PORT, auto, or local for one that is started here. Needs egoloc[ray]."""
    resume: bool = False
    """Go on with a replay that was stopped: finished logs stay, the others run. Logs and settings must be the same."""
    states_hz: Annotated[float | None, tyro.conf.arg(metavar="HZ", help_behavior_hint="(default: all)")] = None
    """States written, 1/s (0: none). All are scored in any case."""
    decisions: Literal["all", "rejected", "none"] = "all"
    """Decisions on measurements written. All are counted in any case."""
    overwrite: bool = False
    """Replace RUN if it is a run folder or a campaign's."""
    json: bool = False
    """Print metrics.json instead of the table."""

    def run(self, arguments: tuple[str, ...]) -> int:
        """Replay every log; arguments: the command line, for the manifest."""
        from replay.batch import Job
        from replay.sources import parse

        sources = [source for text in self.logs for source in parse(text)]
        self._check(sources)
        # a run that was resumed is the same run
        command = tuple(argument for argument in arguments if argument != "--resume")
        job = Job(self._settings(), self._keep(), self.reference, command)
        if len(sources) == 1:
            return self._one(sources[0], job)
        return self._many(sources, job)

    def _check(self, sources: Sequence["LogSource"]) -> None:
        """What no single option can tell."""
        if not sources:
            raise EgolocError("replay: expected at least one log")
        if self.workers is not None and self.workers < 1:
            raise EgolocError(f"--workers: expected 1 or more, got {self.workers}")
        if self.workers is not None and self.ray is not None:
            raise EgolocError("--workers and --ray: expected one of them: on a cluster every core is used")
        if self.resume and self.overwrite:
            raise EgolocError("--resume and --overwrite: expected one of them")

    def _settings(self) -> "RunConfig":
        from replay.config import RunConfig, load_config, named_limits, parse_hide_gnss, with_estimates, with_faults

        config = RunConfig() if self.config is None else load_config(self.config)
        if self.limits is not None:
            config = msgspec.structs.replace(config, limits=named_limits(self.limits))
        if self.order is not None:
            fusion = msgspec.structs.replace(config.fusion, order=self.order)
            config = msgspec.structs.replace(config, fusion=fusion)
        if self.estimate is not None:
            config = with_estimates(config, self.estimate)
        if self.hide_gnss is not None:
            config = msgspec.structs.replace(config, hide_gnss=parse_hide_gnss(self.hide_gnss))
        if self.smooth:
            config = msgspec.structs.replace(config, smooth=True)
        if self.reference is not None and config.hide_gnss is not None:
            raise EgolocError("--hide-gnss scores against the hidden fixes: leave out --reference")
        return with_faults(config, self.inject or config.inject)

    def _keep(self) -> Any:
        from replay.store import Keep

        if self.states_hz is not None and not 0 <= self.states_hz < float("inf"):
            raise EgolocError(f"--states-hz: expected 0 or more, got {self.states_hz:g}")
        return Keep(self.states_hz, self.decisions)

    def _one(self, source: "LogSource", job: "Job") -> int:
        """A log becomes the run folder."""
        from replay.single import resumed, run_single

        metrics = resumed(source, self.out, job) if self.resume else None
        if metrics is None:
            with stage(f"replaying {source.where}") as tell:
                metrics = run_single(source, self.out, job, tell, ray=self.ray, overwrite=self.overwrite)
        if self.json:
            print_json(metrics)
        else:
            show(metrics, self.out)
        return 0

    def _many(self, sources: Sequence["LogSource"], job: "Job") -> int:
        """Each log becomes a run folder within RUN."""
        from replay.campaign import backend_of, run_campaign
        from replay.store import StorageError

        backend, go_on = backend_of(len(sources), self.workers, self.ray), "the same command with --resume goes on"
        try:
            done = run_campaign(sources, self.out, job, backend, resume=self.resume, overwrite=self.overwrite)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(go_on) from None
        except StorageError as error:
            raise StorageError(f"{error}; with that mended, {go_on}") from None
        return show_campaign(done, self.out, as_json=self.json)
