"""egoloc score and compare."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from replay.commands.output import print_json, show, stage


@dataclass(frozen=True)
class Score:
    """Compute the metrics of a run again from its tables, for instance with other limits; nothing is filtered.

    Of a campaign, those of every log and then of all.
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """A run folder; its metrics.json, segments.parquet and percentiles.parquet are replaced."""
    limits: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: those of the run's config.toml)")
    ] = None
    """Limits on the error: paper, highway or local-street (see replay)."""
    json: bool = False
    """Print metrics.json instead of the table."""

    def run(self, _: tuple[str, ...]) -> None:
        """Score again and replace the metrics."""
        from replay.config import named_limits
        from replay.rescoring import rescore

        limits = None if self.limits is None else named_limits(self.limits)
        with stage(f"scoring {self.folder}") as tell:
            metrics = rescore(self.folder, limits, tell)
        if self.json:
            print_json(metrics)
        else:
            show(metrics, self.folder)


@dataclass(frozen=True)
class Compare:
    """Print two runs, or two campaigns, side by side: overall, by scene tag and by drive mode, with intervals.

    Only minutes of the same logs that both evaluated count; the intervals come from resampling them in pairs.
    """

    a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="A")]
    """A run folder, or a campaign's."""
    b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="B")]
    """Another, of the same log or logs and with the same limits."""
    resamples: Annotated[int, tyro.conf.arg(metavar="N")] = 2000
    """Resamples of the pairs, for the intervals."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Seed of the resamples."""
    json: bool = False
    """Print every figure of every method as JSON instead of the table."""

    def run(self, _: tuple[str, ...]) -> None:
        """Compare and print."""
        from replay.compare import compare
        from replay.comparison import print_comparison

        with stage(f"comparing {self.a} and {self.b}"):
            found = compare(self.a, self.b, self.resamples, self.seed)
        if self.json:
            print_json(found)
        else:
            print_comparison(found)
