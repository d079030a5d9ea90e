"""What a log must hold to be replayed: an IMU, and positions while it runs."""

from datetime import UTC, datetime

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.records import Log

NO_POSITIONS = "expected GNSS fixes or pose fixes, found neither: nothing tells where the vehicle is"
SHOWN = 3
"""Reasons why rows were left out that an error repeats."""


def check_replayable(log: Log, where: str) -> None:
    """Raise EgolocError where nothing can be fused. where: the log's name in the message."""
    missing = what_is_missing(log)
    if missing is not None:
        raise EgolocError(f"{where}: {missing}{_left_out(log)}")


def what_is_missing(log: Log) -> str | None:
    """Why a log cannot be replayed; None where it can."""
    imu = log.imu
    if imu is None or len(imu) < 2:
        count = 0 if imu is None else len(imu)
        return f"expected IMU samples (sensor_msgs/msg/Imu), found {count or 'none'}"
    positions = [
        (name, record) for name, record in (("GNSS fixes", log.gnss), ("pose fixes", log.pose_fixes)) if record
    ]
    if not positions:
        return NO_POSITIONS
    first, last = int(imu.t_ns[0]), int(imu.t_ns[-1])
    if any(((record.t_ns >= first) & (record.t_ns <= last)).any() for _, record in positions):
        return None
    found = " and ".join(f"{name} {_span(int(record.t_ns[0]), int(record.t_ns[-1]))}" for name, record in positions)
    return f"expected positions while the IMU runs ({_span(first, last)}), found {found}"


def _span(first_ns: int, last_ns: int) -> str:
    start, end = (datetime.fromtimestamp(t / NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M:%S") for t in (first_ns, last_ns))
    return f"from {start} to {end}"


def _left_out(log: Log) -> str:
    """The commonest reasons why rows were left out, as the end of an error."""
    entries = sorted(log.left_out, key=lambda entry: -entry.count)
    texts = [f"{f'{row.count} of ' if row.count else ''}{row.source}: {row.reason}" for row in entries[:SHOWN]]
    more = f"; and {len(entries) - SHOWN} more" if len(entries) > SHOWN else ""
    return f"; left out: {'; '.join(texts)}{more}" if texts else ""
