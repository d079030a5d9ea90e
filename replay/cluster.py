"""Replays on a Ray cluster: a task per log, whose run folder comes back as bytes, so that no disk need be shared."""

import logging
import os
import re
import socket
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from replay.batch import DEATHS, End, Job, Outcome, Report, Work, died, failure, replay_one
from replay.sources import LogSource, McapSource
from replay.store import StorageError, new_folder, versions
from sensors.errors import EgolocError

if TYPE_CHECKING:
    from ray import ObjectRef

LOCAL, AUTO = "local", "auto"
"""Instead of an address: a cluster of this machine, for as long as the command runs; one that runs here already."""
ANSWER_S = 5.0
"""So long may the machine of a cluster take to answer."""
AHEAD = 2
"""Tasks given out per core, so that none waits for the driver; their results must fit into memory."""
POLL_S = 1.0
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent to Ray's makers unasked
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",  # what it says of lost nodes would go to standard output, amid the results
}

ATTEMPTS = "RAY_NUM_REDIS_GET_RETRIES"
"""How often Ray tries to join: it reads this when it is imported."""


@dataclass(frozen=True, slots=True)
class Place:
    """What a node must have in common with this process."""

    folder: str
    """Where relative paths begin."""
    versions: dict[str, str]


@dataclass(frozen=True, slots=True)
class Parcel:
    """What a task returns: how it ended, and the files of the run folder by name."""

    end: End
    km: float = 0.0
    error: str = ""
    details: str = ""
    files: dict[str, bytes] | None = None


@contextmanager
def joined(address: str) -> Iterator[Any]:
    """Ray, connected for the block to the cluster at an address or to one of this machine.

    Ray's own messages are kept off the terminal. Raises EgolocError where there is no cluster.
    """
    ray = _imported(address)
    _check_answers(address)
    options = {"include_dashboard": False} if address == LOCAL else {}
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **options)
    except (ConnectionError, RuntimeError, ValueError) as error:
        why = "none runs on this machine" if address == AUTO else str(error).partition("\n")[0]
        raise EgolocError(f"--ray {address}: expected a Ray cluster: {why}") from None
    try:
        yield ray
    finally:
        ray.shutdown()


def _imported(address: str) -> Any:
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    try:
        with nullcontext() if address == LOCAL else _one_attempt():
            import ray
    except ImportError:
        raise EgolocError('--ray: expected Ray to be installed: pip install "egoloc[ray]"') from None
    return ray


@contextmanager
def _one_attempt() -> Iterator[None]:
    """Ray imported in the block joins at once or never: where something else listens, an attempt takes 40 s."""
    given = os.environ.get(ATTEMPTS)
    os.environ[ATTEMPTS] = given or "1"
    try:
        yield
    finally:
        if given is None:
            del os.environ[ATTEMPTS]


def _check_answers(address: str) -> None:
    """Raise unless something listens at HOST:PORT, for which Ray itself would wait many minutes."""
    if address in (LOCAL, AUTO):
        return
    if not re.fullmatch(r"[^/\s]+:\d{1,5}", address):
        raise EgolocError(f"--ray: expected HOST:PORT of a Ray cluster, {AUTO} or {LOCAL}, got {address!r}")
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_S).close()
    except OSError as error:
        why = error.strerror or error
        raise EgolocError(f"--ray {address}: nothing answers there, expected a Ray cluster: {why}") from None


def run(works: Sequence[Work], job: Job, report: Report, ray: Any) -> Generator[Outcome, None, None]:
    """Replay logs on the cluster that has been joined."""
    task = ray.remote(num_cpus=1, max_retries=DEATHS - 1)(_replay)
    shared, waiting = ray.put((job, Place(str(Path.cwd()), versions()))), list(reversed(works))
    running: dict[ObjectRef[Any], Work] = {}
    while waiting or running:
        room = AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1))) - len(running)
        for _ in range(min(room, len(waiting))):
            work = waiting.pop()
            running[task.remote(work.source, shared)] = work
        done, _ = ray.wait(list(running), num_returns=len(running), timeout=POLL_S)
        for reference in done or ():
            yield _received(ray, reference, running.pop(reference))


def _replay(source: LogSource, shared: tuple[Job, Place]) -> Parcel:
    """The task: a run folder as bytes."""
    job, place = shared
    error = _set_up(source, place)
    if error:
        return Parcel(End.FAILED, error=error, details=error)
    with TemporaryDirectory(prefix="egoloc-") as folder:
        out = Path(folder) / source.name
        outcome = replay_one(Work(source, out), job, lambda _: None)
        files = {path.name: path.read_bytes() for path in out.iterdir()} if outcome.end is End.DONE else None
        return Parcel(outcome.end, outcome.km, outcome.error, outcome.details, files)


def _set_up(source: LogSource, place: Place) -> str:
    """Make a worker like the driver; why that is not possible."""
    import pyarrow as pa

    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)
    with suppress(OSError):  # a node without that folder has no relative paths in it either
        os.chdir(place.folder)
    other = [
        f"{name} {found}, here {place.versions[name]}"
        for name, found in versions().items()
        if found != place.versions[name]
    ]
    if other:
        return f"{source.where}: node {socket.gethostname()} has {', '.join(other)}: expected the same versions"
    if isinstance(source, McapSource) and not source.path.exists():
        return f"{source.where}: no such file on node {socket.gethostname()}: expected it at the same path on all nodes"
    return ""


def _received(ray: Any, reference: Any, work: Work) -> Outcome:
    """The outcome of a task that ended; its run folder is written here, whole or not at all."""
    try:
        parcel: Parcel = ray.get(reference)
    except ray.exceptions.RayTaskError as error:  # what replay_one does not catch: no egoloc there, or of another kind
        return failure(work, f"{work.source.where}: {type(error.cause).__name__}: {error.cause}", str(error))
    except ray.exceptions.RayError as error:
        return replace(died(work), details=str(error))
    if parcel.files is not None:
        try:
            with new_folder(work.out, overwrite=True) as folder:
                for name, content in parcel.files.items():
                    (folder / name).write_bytes(content)
        except StorageError as error:
            return Outcome(work, End.STORAGE, error=str(error))
    return Outcome(work, parcel.end, parcel.km, parcel.error, parcel.details)
