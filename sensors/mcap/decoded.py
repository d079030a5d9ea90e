"""What the rows of a topic say, before it is judged which of them a record can hold."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.clock import NS_PER_S
from sensors.mcap.columns import Topic

Mask = NDArray[np.bool_]

LATE_NS = NS_PER_S
"""A message this much behind the newest stamp came late and is put in order; further back its stamp is wrong."""
NO_LOG_TIME = "log time is beyond int64"


@dataclass(frozen=True, eq=False)
class Decoded:
    """What the rows of a topic say: columns of a record (t_ns and arrival_ns too), each (N, ...).

    valid: reason -> (N,) rows that pass it; late: messages that came a little late are put in order.
    """

    record: Callable[..., Any]
    columns: Mapping[str, NDArray[Any]]
    valid: Mapping[str, Mask]
    late: bool


def stamps(topic: Topic) -> tuple[NDArray[np.int64], Mask]:
    """(N,) header stamps, ns, and which of them have whole nanoseconds below a second."""
    nanosec = topic.integers("nanosec")
    return topic.integers("sec") * NS_PER_S + nanosec, (nanosec >= 0) & (nanosec < NS_PER_S)


def build(
    record: Callable[..., Any], topic: Topic, columns: dict[str, Any], valid: dict[str, Mask], *, late: bool = True
) -> Decoded:
    """Add the times, and what they and the frame say of the rows."""
    t_ns, whole = stamps(topic)
    arrival = topic.log_time()
    valid |= {"header.stamp.nanosec is not below 1e9": whole, NO_LOG_TIME: arrival >= 0}
    if any(texts != topic.first for _, texts in topic.texts):
        valid["header.frame_id is not that of the first message"] = topic.in_first_frame()
    return Decoded(record, {"t_ns": t_ns, "arrival_ns": arrival, **columns}, valid, late)


def in_order(decoded: Decoded) -> tuple[Decoded, NDArray[np.intp] | None]:
    """The rows in the order in which they are judged, and which those are; None where they stay as they were read.

    They go by stamp, where a stamp too far behind keeps its place (and is left out as going back).
    """
    t_ns = decoded.columns["t_ns"]
    if not decoded.late or not (t_ns[1:] < t_ns[:-1]).any():
        return decoded, None
    newest = np.maximum.accumulate(t_ns)
    order = np.argsort(np.where(newest - t_ns > LATE_NS, newest, t_ns), kind="stable")
    columns = {name: column[order] for name, column in decoded.columns.items()}
    return replace(decoded, columns=columns, valid={why: mask[order] for why, mask in decoded.valid.items()}), order
