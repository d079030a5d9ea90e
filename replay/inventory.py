"""What a log holds, and what a replay would make of it."""

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.table import Table

from replay.plausibility import imu_findings
from replay.references import gap_ns, has_heading
from replay.requirements import what_is_missing
from replay.table import output_console
from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.records import GnssStatus, Log
from sensors.vehicle import Vehicle

if TYPE_CHECKING:
    from sensors.mcap.io import TopicSummary

SENSORS = ("imu", "gnss", "gnss_velocity", "pose_fixes", "wheel", "reference")


def inventory(log: Log, name: str) -> dict[str, Any]:
    """Sensors with rates and gaps, vehicle, map frame, what was left out, and remarks on a replay; JSON-ready."""
    records = {sensor: getattr(log, sensor) for sensor in SENSORS}
    present = {sensor: record.t_ns for sensor, record in records.items() if record is not None and len(record)}
    found: dict[str, Any] = {
        "log": name,
        "start_utc": None,
        "duration_s": 0.0,
        "sensors": {sensor: timing(t_ns) for sensor, t_ns in present.items()},
        "gnss_status": _statuses(log),
        "vehicle": msgspec.to_builtins(log.vehicle),
        "map_frame": msgspec.to_builtins(log.map_frame),
        "left_out": [{"source": row.source, "reason": row.reason, "count": row.count} for row in log.left_out],
        "remarks": list(remarks(log)),
    }
    if present:
        start, end = min(int(t[0]) for t in present.values()), max(int(t[-1]) for t in present.values())
        found["start_utc"] = datetime.fromtimestamp(start / NS_PER_S, UTC).isoformat(timespec="milliseconds")
        found["duration_s"] = (end - start) / NS_PER_S
    return found


def file_inventory(path: Path, topics: Mapping[str, str]) -> dict[str, Any]:
    """The inventory of an MCAP file, with its topics and the state of the file. topics: sensor -> topic, as chosen."""
    from sensors.mcap.io import describe, read_log

    summary = describe(path, topics)
    try:
        found = inventory(read_log(path, topics), str(path))
    except EgolocError as error:  # two topics for one sensor
        known = Log(vehicle=summary.vehicle, map_frame=summary.map_frame, left_out=summary.left_out)
        found = inventory(known, str(path)) | {"remarks": [f"Not to be replayed as it is: {error}."]}
    found["topics"] = [_topic(topic) for topic in summary.topics]
    found["file"] = {
        "bytes": summary.size_bytes,
        "complete": summary.complete,
        "indexed": summary.indexed,
        "chunks": summary.chunks,
        "compressions": list(summary.compressions),
    }
    return found


def _topic(topic: "TopicSummary") -> dict[str, Any]:
    """A topic; numbers that are not known are None."""
    span = None if topic.first_ns is None or topic.last_ns is None else (topic.last_ns - topic.first_ns) / NS_PER_S
    return {
        "name": topic.name,
        "schema": topic.schema,
        "count": topic.count,
        "rate_hz": _finite(topic.median_rate_hz),
        "span_s": span,
        "longest_gap_s": _finite(topic.longest_gap_s),
        "sensors": list(topic.sensors),
        "note": topic.note,
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def timing(t_ns: NDArray[np.int64]) -> dict[str, Any]:
    """Count, median rate, span, and pauses too long to be bridged."""
    steps = np.diff(t_ns)
    gaps = steps[steps > gap_ns(t_ns)]
    return {
        "count": len(t_ns),
        "rate_hz": float(NS_PER_S / np.median(steps)) if len(steps) else None,
        "span_s": float((t_ns[-1] - t_ns[0]) / NS_PER_S),
        "gaps": len(gaps),
        "longest_gap_s": float(gaps.max() / NS_PER_S) if len(gaps) else None,
    }


def remarks(log: Log) -> Iterator[str]:
    """What a replay would do with this log, or why it cannot, and what is odd about its IMU."""
    missing = what_is_missing(log)
    if missing is not None or log.imu is None:
        yield f"It cannot be replayed: {missing}."
        return
    for _, finding in imu_findings(log.imu, land_vehicle=log.vehicle.land_vehicle):
        yield f"WARNING: {finding}"
    mapped = log.pose_fixes is not None or log.reference is not None
    if mapped and log.map_frame is None:
        yield "Map coordinates without a map frame: a replay needs [map_frame] in its config."
    if log.vehicle == Vehicle():
        yield "Nothing is known of the vehicle: lever arms of zero and the default IMU are taken."
    if log.reference is not None and len(log.reference):
        yield "A replay is scored against its reference" + (
            "." if has_heading(log.reference) else ", in position only: it has no heading."
        )
    elif log.gnss is not None and (log.gnss.status == GnssStatus.FIXED).any():
        yield "No reference: a replay is scored with --reference FILE, or with --hide-gnss against its fixed fixes."
    else:
        yield "No reference: a replay is scored only with --reference FILE."


def print_inventory(found: Mapping[str, Any]) -> None:
    """The inventory for people."""
    console = output_console()
    start = f", from {found['start_utc']}" if found["start_utc"] else ""
    console.print(f"{found['log']}: {found['duration_s']:.1f} s{start}")
    if "topics" in found:
        console.print(_topic_table(found["topics"]), "")
    console.print(_sensor_table(found["sensors"]), "")
    if found["gnss_status"]:
        console.print("GNSS: " + ", ".join(f"{n} {status}" for status, n in found["gnss_status"].items()))
    console.print(_frame_text(found["map_frame"]))
    console.print(_vehicle_text(found["vehicle"]))
    for row in found["left_out"]:
        count = f"{row['count']} of " if row["count"] else ""
        console.print(f"Left out: {count}{row['source']}: {row['reason']}.")
    for remark in found["remarks"]:
        console.print(remark)


def _topic_table(topics: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for header in ("topic", "schema"):
        table.add_column(header, overflow="fold")
    for header in ("messages", "rate Hz", "gap s"):
        table.add_column(header, justify="right", no_wrap=True)
    table.add_column("feeds", overflow="fold")
    for topic in topics:
        rate, gap = ("-" if topic[key] is None else f"{topic[key]:.2f}" for key in ("rate_hz", "longest_gap_s"))
        feeds = ", ".join(topic["sensors"]) or f"nothing: {topic['note']}"
        schema = topic["schema"].rpartition("/")[2]
        table.add_row(topic["name"], schema, str(topic["count"]), rate, gap, feeds)
    return table


def _sensor_table(sensors: Mapping[str, Mapping[str, Any]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, header_style="bold")
    table.add_column("sensor")
    for header in ("count", "rate Hz", "span s", "gaps", "longest s"):
        table.add_column(header, justify="right")
    for name, t in sensors.items():
        rate, longest = ("-" if t[key] is None else f"{t[key]:.2f}" for key in ("rate_hz", "longest_gap_s"))
        table.add_row(name, str(t["count"]), rate, f"{t['span_s']:.1f}", str(t["gaps"]), longest)
    return table


def _statuses(log: Log) -> dict[str, int]:
    if log.gnss is None:
        return {}
    counts = np.bincount(log.gnss.status, minlength=len(GnssStatus))
    return {status.name.lower(): int(n) for status, n in zip(GnssStatus, counts, strict=True) if n}


def _frame_text(frame: Mapping[str, Any] | None) -> str:
    if frame is None:
        return "Map frame: none."
    origin = ", ".join(f"{value:.10g}" for value in frame["origin"])
    if frame["kind"] == "enu":
        return f"Map frame: ENU plane at {origin} (deg, deg, m)."
    return f"Map frame: UTM zone {frame['zone']}{' south' if frame['south'] else ''}, less {origin} m."


def _vehicle_text(vehicle: Mapping[str, Any]) -> str:
    antenna = ", ".join(f"{value:g}" for value in vehicle["gnss_lever_arm"])
    delay = f", GNSS delay {vehicle['gnss_delay_s']:g} s" if vehicle["gnss_delay_s"] else ""
    return f"Vehicle: IMU {vehicle['imu']['name']}; antenna at ({antenna}) m in body axes{delay}."
