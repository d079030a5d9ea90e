"""Logs whose rows come late, and in which order a live system sees them."""

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from fusion.config import FusionConfig
from fusion.filter import Measurement
from fusion.run import Session
from fusion.state import Core
from sensors.records import Imu, Log

MEASURED = ("gnss", "gnss_velocity", "pose_fixes", "wheel")
LATE = FusionConfig(order="arrival")

Latency = Callable[[NDArray[np.int64]], NDArray[np.int64]]
"""From the times (N,) at which rows were true to what passes before they arrive, ns."""


def arriving(log: Log, latency: Latency, names: tuple[str, ...] = MEASURED) -> Log:
    """The log with these arrivals; all others come when they are true."""
    delay_s = {"gnss": log.vehicle.gnss_delay_s, "gnss_velocity": log.vehicle.gnss_velocity_delay_s}
    found = {}
    for name in (*MEASURED, "imu"):
        record = getattr(log, name)
        if record is not None:
            true_ns = record.t_ns - round(delay_s.get(name, 0.0) * 1e9)
            found[name] = replace(record, arrival_ns=true_ns + (latency(true_ns) if name in names else 0))
    return replace(log, **found)


def at_once(log: Log) -> Log:
    """The log in which everything arrives when it is true."""
    return arriving(log, np.zeros_like)


def scattered(log: Log, seed: int, longest_s: float = 0.9, names: tuple[str, ...] = MEASURED) -> Log:
    """Latencies drawn for each row, out of order within each sensor; none in the first three seconds and the last."""
    assert log.imu is not None
    begin, end = log.imu.t_ns[0] + 3 * 10**9, log.imu.t_ns[-1] - 10**9
    rng = np.random.default_rng(seed)

    def latency(t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        late = rng.integers(0, round(longest_s * 1e9), len(t_ns))
        return np.where((t_ns < begin) | (t_ns > end), 0, late)

    return arriving(log, latency, names)


def records_by_arrival(log: Log) -> list[Imu | Measurement]:
    """Rows one by one as they arrive; of what arrives together measurements come first, by stamp."""
    rows = []
    for k, name in enumerate((*MEASURED, "imu")):
        record = getattr(log, name)
        if record is not None:
            rows += [(int(record.arrival_ns[i]), name == "imu", int(record.t_ns[i]), k, i) for i in range(len(record))]
    names = (*MEASURED, "imu")
    return [getattr(log, names[k])[i : i + 1] for *_, k, i in sorted(rows)]


def core_after(log: Log, config: FusionConfig) -> Core:
    """The filter's memory at the end of the log."""
    session = Session(log.vehicle, log.map_frame, config)
    session.push(log)
    session.finish()
    core = session._navigator.core
    assert core is not None
    return core


def in_stamp_order(config: FusionConfig) -> FusionConfig:
    """The same configuration in stamp order."""
    return msgspec.structs.replace(config, order="stamp")


def assert_same_state(one: Core, other: Core) -> None:
    """Bit for bit, all that goes into what comes next."""
    for name in ("clock", "nav", "P", "last", "span", "acc", "earth", "quietest", "doubt", "doubt_clock"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
