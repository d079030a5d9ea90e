"""Rows of a benchmark: repeats of a call after one that warms up, as median, least and most."""

import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

import numpy as np


def times(work: Callable[[], object], repeats: int) -> list[float]:
    """Seconds of each call after one that warms up."""
    work()
    found = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return found


@contextmanager
def one_core() -> Iterator[None]:
    """Keep the process and its threads on one core, where the system lets it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def row(name: str, metric: str, values: Sequence[float]) -> dict[str, Any]:
    """One line of the report."""
    array = np.asarray(values, np.float64)
    low, middle, high = float(array.min()), float(np.median(array)), float(array.max())
    return {"name": name, "metric": metric, "median": middle, "min": low, "max": high}


def rate(name: str, metric: str, count: int, seconds: Sequence[float]) -> dict[str, Any]:
    """Things per second."""
    return row(name, metric, [count / s for s in seconds])


def conditions(packages: Sequence[str], **facts: object) -> dict[str, Any]:
    """What the figures depend on."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    machine = {
        "cores": cores,
        "machine": platform.machine(),
        "processor": processor(),
        "python": platform.python_version(),
    }
    return {**facts, **machine, **{name: version(name) for name in packages}}


def processor() -> str:
    """Model name where the system tells it."""
    try:
        with open("/proc/cpuinfo") as lines:
            return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()
