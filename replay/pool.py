"""Replays in processes of this machine. A worker that is killed costs only the log it was at, which runs again."""

import os
import signal
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import active_children, get_context
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from multiprocessing.process import BaseProcess
from threading import Thread

from replay.batch import DEATHS, Job, Outcome, Report, Work, died, replay_one
from replay.store import clear_leftovers

POLL_S = 0.2
"""How often kilometres are counted."""
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
"""Parallel work goes by log: threads within one would only get in each other's way."""


def run(works: Sequence[Work], job: Job, report: Report, workers: int) -> Generator[Outcome, None, None]:
    """Replay logs in spawned processes, at most `workers` at a time."""
    waiting, deaths = deque(works), Counter[str]()
    slots = [Slot() for _ in range(min(workers, len(works)))]
    running: dict[Future[Outcome], tuple[Slot, Work]] = {}
    try:
        while waiting or running:
            busy = {slot for slot, _ in running.values()}
            for slot in (slot for slot in slots if slot not in busy):
                if waiting:
                    work = waiting.popleft()
                    running[slot.submit(work, job)] = slot, work
            done, _ = wait(running, POLL_S, FIRST_COMPLETED)
            report(sum(slot.km() for slot, _ in running.values()))
            for future in done:
                slot, work = running.pop(future)
                try:
                    yield future.result()
                except BrokenProcessPool:
                    how = slot.restart()
                    clear_leftovers(work.out)
                    deaths[work.source.name] += 1
                    if deaths[work.source.name] < DEATHS:
                        waiting.appendleft(work)
                    else:
                        yield died(work, how)
    finally:
        for slot in slots:
            slot.stop()


class Slot:
    """Place of one worker: a pool of one process, so that a death is that of the log in work and of no other.

    The leash is a pipe: kilometres come through it, and a worker ends at once when this end closes, be it that the work
    is called off or that this process is gone, however it went.
    """

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        context = get_context("spawn")
        self._km = 0.0
        self._process: BaseProcess | None = None
        self._leash, self._far_end = context.Pipe()
        self._pool = ProcessPoolExecutor(1, context, initializer=_begin, initargs=(self._far_end,))

    def submit(self, work: Work, job: Job) -> Future[Outcome]:
        """Give the idle worker a log."""
        self._km = 0.0
        try:
            return self._submit(work, job)
        except BrokenProcessPool:  # it died while it was idle
            self.restart()
            return self._submit(work, job)

    def _submit(self, work: Work, job: Job) -> Future[Outcome]:
        before = set(active_children())
        with _as_child_environment():
            future = self._pool.submit(_replay, work, job)
        self._process = next(iter(set(active_children()) - before), self._process)
        return future

    def km(self) -> float:
        """How far the log in work has come."""
        with suppress(EOFError, OSError):
            while self._leash.poll():
                self._km = self._leash.recv()
        return self._km

    def restart(self) -> str:
        """A new worker in place of one that died; how that went."""
        self.stop()
        code = None if self._process is None else self._process.exitcode
        self._start()
        return exit_text(code)

    def stop(self) -> None:
        """End the worker, whatever it does."""
        self._leash.close()
        self._far_end.close()
        self._pool.shutdown(cancel_futures=True)


def exit_text(code: int | None) -> str:
    """An exit code in words, as SIGKILL for -9."""
    if code is None or code >= 0:
        return "" if code is None else f"exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return f"{name}: out of memory?" if name == "SIGKILL" else name


@contextmanager
def _as_child_environment() -> Iterator[None]:
    """What a process that is spawned in the block inherits: one thread each, and no Ctrl-C of its own."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


_leashes: list[Connection] = []
"""In a worker: its end of the pipe."""


def _begin(leash: Connection) -> None:
    """Set a worker up."""
    import pyarrow as pa

    _leashes.append(leash)
    Thread(target=_follow, args=(leash,), daemon=True).start()
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)


def _follow(leash: Connection) -> None:
    wait_for([leash])  # nothing is ever sent this way: it closed
    os._exit(1)


def _replay(work: Work, job: Job) -> Outcome:
    return replay_one(work, job, _leashes[0].send)
