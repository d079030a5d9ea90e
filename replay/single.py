"""One log, one run folder."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from replay.batch import End, Job, Work
from replay.campaign_folder import is_campaign
from replay.finished import why_not_finished
from replay.run_files import read_json
from replay.sources import LogSource
from replay.store import StorageError, check_free, clear_leftovers
from sensors.errors import EgolocError


def run_single(
    source: LogSource,
    out: Path,
    job: Job,
    tell: Callable[[str], None],
    *,
    ray: str | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Replay a log into a run folder and return its metrics.

    tell: hears how far it has come; ray: address of a cluster, None: in this process.
    """
    if ray is not None:
        return _on_cluster(source, out, job, ray, overwrite=overwrite)
    from replay.harness import replay_source

    return replay_source(
        source,
        out,
        job.config,
        reference_file=job.reference_file,
        overwrite=overwrite,
        command=job.command,
        keep=job.keep,
        progress=lambda km: tell(f"{km:,.1f} km"),
    )


def resumed(source: LogSource, out: Path, job: Job) -> dict[str, Any] | None:
    """The metrics of the finished run of just this log; None: there is no run yet."""
    clear_leftovers(out)
    if not out.exists():
        return None
    if is_campaign(out):
        raise EgolocError(f"{out}: --resume: expected the run of one log, got a campaign: name all of its logs")
    reason = why_not_finished(out, source, job)
    if reason is not None:
        raise EgolocError(f"--resume: {reason}: choose another --out or replace it with --overwrite")
    return read_json(out / "metrics.json")


def _on_cluster(source: LogSource, out: Path, job: Job, address: str, *, overwrite: bool) -> dict[str, Any]:
    from replay.campaign import backend_of

    check_free(out, overwrite=overwrite)
    with backend_of(1, ray=address) as replay, closing(replay([Work(source, out)], job, lambda _: None)) as ends:
        outcome = next(ends)
    if outcome.end is End.STORAGE:
        raise StorageError(outcome.error)
    if outcome.end is End.FAILED:
        raise EgolocError(outcome.error)
    return read_json(out / "metrics.json")
