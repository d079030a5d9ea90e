"""One log of many: replayed wherever a worker runs, its failure told instead of raised."""

import traceback
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from replay.config import RunConfig
from replay.sources import LogSource
from replay.store import Keep
from sensors.errors import EgolocError

DEATHS = 3
"""So many workers may die at a log before it counts as failed."""

Report = Callable[[float], None]
"""Is told the kilometres that the logs in work have come so far."""


@dataclass(frozen=True, slots=True)
class Work:
    """A log, and the run folder that it is to become."""

    source: LogSource
    out: Path


@dataclass(frozen=True, slots=True)
class Job:
    """What is the same for all logs."""

    config: RunConfig
    keep: Keep
    reference_file: Path | None = None
    command: tuple[str, ...] = ()


class End(Enum):
    """How work on a log ended."""

    DONE = "done"
    FAILED = "failed"
    STORAGE = "storage"
    """The run folder could not be written: neither would the next."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The end of a log. error: one line; details: what is worth keeping of it, a traceback where it was a bug."""

    work: Work
    end: End
    km: float = 0.0
    error: str = ""
    details: str = ""


Backend = Callable[[Sequence[Work], Job, Report], Generator[Outcome, None, None]]
"""Replays logs in any order; its outcomes come as they end. Closing it ends what is in work."""


def replay_one(work: Work, job: Job, report: Report) -> Outcome:
    """Replay a log into its run folder, whole or not at all."""
    from replay.harness import replay_source
    from replay.store import StorageError

    km = 0.0

    def note(so_far: float) -> None:
        nonlocal km
        km = so_far
        report(so_far)

    try:
        replay_source(
            work.source,
            work.out,
            job.config,
            reference_file=job.reference_file,
            overwrite=True,
            command=job.command,
            keep=job.keep,
            progress=note,
        )
    except StorageError as error:
        return Outcome(work, End.STORAGE, km, str(error))
    except EgolocError as error:
        return failure(work, str(error))
    except MemoryError:
        return failure(work, f"{work.source.where}: not enough memory")
    except Exception as error:
        text = f"{work.source.where}: {type(error).__name__}: {error}"
        return failure(work, text, traceback.format_exc())
    return Outcome(work, End.DONE, km)


def failure(work: Work, error: str, details: str = "") -> Outcome:
    """A log that failed, with its error in one line."""
    line = " ".join(error.split())
    return Outcome(work, End.FAILED, error=line, details=details or line)


def died(work: Work, how: str = "") -> Outcome:
    """A log at which workers die; how: what is known of the last death."""
    return failure(work, f"{work.source.where}: its worker died {DEATHS} times{f' ({how})' if how else ''}")


def in_process(works: Sequence[Work], job: Job, report: Report) -> Generator[Outcome, None, None]:
    """A backend that replays one log after the other, here."""
    for work in works:
        yield replay_one(work, job, report)
