"""Many logs, one folder: a run folder per log, and at the end the metrics of all, merged from the logs' sums.

RUN/config.toml and manifest.json are written first, metrics.json last. What is there after a kill is whole: run folders
come by a rename. Resuming takes those over that are readable and of the same log, and runs the others.
"""

import hashlib
import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from replay.batch import Backend, End, Job, Outcome, Work, in_process
from replay.campaign_folder import KIND, campaign_folder, check_place, error_file
from replay.config import to_toml
from replay.finished import reference_facts, why_not_finished
from replay.metrics import metrics_of
from replay.progress import Progress
from replay.sources import LogSource, check_unique
from replay.store import StorageError, check_free, storage, versions, write_json
from replay.sums import Sums, merge


@dataclass(frozen=True, slots=True)
class Campaign:
    """What came of it. metrics: None where every log failed; logs: total, done, and log and error of each failed."""

    metrics: dict[str, Any] | None
    logs: dict[str, Any]


@contextmanager
def backend_of(logs: int, workers: int | None = None, ray: str | None = None) -> Iterator[Backend]:
    """What replays so many logs: a Ray cluster by its address, workers of this machine, or this process.

    workers: None for as many as there are cores. A cluster is joined for the time of the block.
    """
    if ray is not None:
        from replay import cluster

        with cluster.joined(ray) as api:
            yield partial(cluster.run, ray=api)
        return
    count = min(workers or available_cores(), logs)
    if count == 1:
        yield in_process
        return
    from replay import pool

    yield partial(pool.run, workers=count)


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_campaign(
    sources: Sequence[LogSource],
    out: Path,
    job: Job,
    backend: AbstractContextManager[Backend],
    *,
    resume: bool = False,
    overwrite: bool = False,
) -> Campaign:
    """Replay logs into out/<name> each and merge what they add up to.

    A log that fails is told in metrics.json and <name>.error.txt. Raises StorageError where the folder cannot be
    written, EgolocError where it is not free; what is finished by then stays. backend: entered before anything is
    written or replaced.
    """
    named = check_unique(sources)
    manifest = _manifest(list(named.values()), job)
    check_place(out, resume=resume, overwrite=overwrite)
    with backend as replay, campaign_folder(out, manifest, job.config, resume=resume, overwrite=overwrite) as begun:
        job = replace(job, command=tuple(begun["command"]))
        left = _left(list(named.values()), out, job)
        with storage(out):  # there are metrics of all logs or none
            (out / "metrics.json").unlink(missing_ok=True)
        failed = _run([Work(source, out / source.name) for source in left], out, job, replay)
        with storage(out):
            return _merged(out, list(named), failed)


def _manifest(sources: Sequence[LogSource], job: Job) -> dict[str, Any]:
    """What a campaign is; each log's run folder says more of it."""
    return {
        "kind": KIND,
        "logs": [{"name": source.name, "where": source.where} for source in sources],
        "reference_file": reference_facts(job.reference_file),
        "keep": msgspec.to_builtins(job.keep),
        "config_sha256": hashlib.sha256(to_toml(job.config).encode()).hexdigest(),
        "versions": versions(),
        "inject": list(job.config.inject),
        "seed": job.config.seed,
        "command": list(job.command),
    }


def _left(sources: Sequence[LogSource], out: Path, job: Job) -> list[LogSource]:
    """The logs without a finished run; what stands in their place is removed."""
    with ThreadPoolExecutor() as pool:
        reasons = list(pool.map(lambda source: why_not_finished(out / source.name, source, job), sources))
    left = [source for source, reason in zip(sources, reasons, strict=True) if reason is not None]
    for source in left:
        if (out / source.name).exists():
            check_free(out / source.name, overwrite=True)
            shutil.rmtree(out / source.name)
    return left


def _run(works: Sequence[Work], out: Path, job: Job, backend: Backend) -> dict[str, Outcome]:
    """Replay; name -> outcome of the logs that failed."""
    failed: dict[str, Outcome] = {}
    if not works:
        return failed
    with Progress([work.source for work in works]) as progress, closing(backend(works, job, progress.running)) as ends:
        for outcome in ends:
            if outcome.end is End.STORAGE:
                raise StorageError(outcome.error)
            progress.ended(outcome)
            name = outcome.work.source.name
            with storage(out):
                if outcome.end is End.FAILED:
                    failed[name] = outcome
                    error_file(out, name).write_text(outcome.details.rstrip() + "\n")
                else:
                    error_file(out, name).unlink(missing_ok=True)
    return failed


def _merged(out: Path, names: Sequence[str], failed: dict[str, Outcome]) -> Campaign:
    """segments.parquet, percentiles.parquet and, last, metrics.json of all logs that did not fail."""
    done = [name for name in names if name not in failed]
    errors = [{"log": name, "error": failed[name].error} for name in names if name in failed]
    logs = {"total": len(names), "done": len(done), "failed": errors}
    if not done:
        return Campaign(None, logs)
    whole = merge((name, Sums.from_parquet(out / name)) for name in done)
    whole.to_parquet(out)
    metrics = metrics_of(whole, logs=logs)
    write_json(out / "metrics.json", metrics)
    return Campaign(metrics, logs)
