"""egoloc demo: the main job without any data."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from replay.commands.output import print_json, show, show_campaign, stage
from sensors.errors import EgolocError

CAMPAIGN = "scenario:road-test,drives=10,length_km=20"
OUT, CAMPAIGN_OUT = Path("runs/demo"), Path("runs/road-test-demo")


@dataclass(frozen=True)
class Demo:
    """Simulate ten minutes of city, write them as an MCAP log, replay it and print the table. Needs no data.

    With --campaign: replay 200 km of the simulated road test, and print its table beside the EgoVM paper's.
    """

    out: Annotated[
        Path | None, tyro.conf.arg(metavar="RUN", help_behavior_hint=f"(default: {OUT}, of a campaign {CAMPAIGN_OUT})")
    ] = None
    """The run folder; the log goes beside it as RUN.mcap. Those of an earlier demo are replaced."""
    campaign: bool = False
    """Ten drives of 20 km with sensors that fail as real ones do (scenario road-test)."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: one per core)")] = None
    """Drives replayed at a time (campaign only)."""
    json: bool = False
    """Print metrics.json instead of the table."""

    def run(self, arguments: tuple[str, ...]) -> int:
        """Simulate, replay, print."""
        if self.campaign:
            return self._campaign(arguments)
        if self.workers is not None:
            raise EgolocError("demo: --workers: expected --campaign with it: one log is replayed by one process")
        return self._drive(arguments)

    def _drive(self, arguments: tuple[str, ...]) -> int:
        from replay.config import RunConfig
        from replay.harness import replay_source
        from replay.sources import log_path
        from replay.store import check_free
        from sensors.mcap.io import write_log
        from sensors.simulate.drive import simulate_pieces
        from sensors.simulate.scenarios import load

        out = self.out or OUT
        again = _is_demo(out)
        check_free(out, overwrite=again)
        path = out.with_name(f"{out.name}.mcap")
        scenario = load("demo")
        with stage(f"simulating {scenario.duration_s:g} s of driving"):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_log(path, simulate_pieces(scenario.duration_s, scenario.seed, scenario))
        with stage(f"replaying {path}"):
            metrics = replay_source(log_path(path), out, RunConfig(), overwrite=again, command=arguments)
        if self.json:
            print_json(metrics)
        else:
            show(metrics, out, heading=f"{scenario.doc}\n")
        return 0

    def _campaign(self, arguments: tuple[str, ...]) -> int:
        from replay.batch import Job
        from replay.campaign import backend_of, run_campaign
        from replay.config import RunConfig
        from replay.sources import parse
        from replay.store import Keep

        if self.workers is not None and self.workers < 1:
            raise EgolocError(f"--workers: expected 1 or more, got {self.workers}")
        out, sources = self.out or CAMPAIGN_OUT, parse(CAMPAIGN)
        job = Job(RunConfig(), Keep(), command=arguments)
        backend = backend_of(len(sources), self.workers)
        done = run_campaign(sources, out, job, backend, overwrite=_is_demo(out))
        return show_campaign(done, out, as_json=self.json, paper=True)


def _is_demo(out: Path) -> bool:
    """Whether a folder is that of an earlier demo."""
    from replay.run_files import read_json

    manifest = out / "manifest.json"
    return manifest.is_file() and "demo" in read_json(manifest).get("command", ())[1:2]
