"""What a log holds, and what a replay would make of it."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from rich import box
from rich.table import Table

from replay.camera_inventory import camera_text, file_cameras
from replay.lidar_inventory import file_lidars, frames_text, lidar_text
from replay.plausibility import ImuWatch
from replay.references import GAP_NS, GAP_PERIODS
from replay.requirements import Contents
from replay.table import output_console
from sensors.clock import NS_PER_S
from sensors.pieces import SENSORS, summed
from sensors.records import GnssStatus, LeftOut, Log, Tags, Trajectory
from sensors.steps import Steps
from sensors.vehicle import Vehicle

if TYPE_CHECKING:
    from sensors.mcap.io import TopicSummary


class Inventory:
    """What the pieces of a drive hold, counted as they come."""

    def __init__(self) -> None:
        self._steps: dict[str, Steps] = {sensor: Steps() for sensor in SENSORS}
        self._status = np.zeros(len(GnssStatus), np.int64)
        self._tags = {"scene": _TagTimes(), "mode": _TagTimes()}
        self._contents = Contents()
        self._imu: ImuWatch | None = None
        self._headings = self._two_modes = 0
        self._first = Log()
        self._left_out: list[LeftOut] = []

    def add(self, piece: Log) -> None:
        """The next piece."""
        if self._imu is None:
            self._first, self._imu = Log(vehicle=piece.vehicle, map_frame=piece.map_frame), _imu_watch(piece)
        for sensor in SENSORS:
            record = getattr(piece, sensor)
            if record is not None:
                self._steps[sensor].add(record.t_ns)
        if piece.imu is not None:
            self._imu.add(piece.imu)
        if piece.gnss is not None:
            self._status += np.bincount(piece.gnss.status, minlength=len(GnssStatus))
        if piece.pose_fixes is not None:
            self._two_modes += int((piece.pose_fixes.weights[:, 1] > 0.0).sum())
        if piece.reference is not None:
            self._headings += _headings(piece.reference)
        self._tags["scene"].add(piece.scene)
        self._tags["mode"].add(piece.mode)
        self._contents.add(piece)
        self._left_out = list(summed((*self._left_out, *piece.left_out)))

    def watch(self, pieces: Iterable[Log]) -> Iterator[Log]:
        """The pieces, counted on their way."""
        for piece in pieces:
            self.add(piece)
            yield piece

    def found(self, name: str) -> dict[str, Any]:
        """Sensors with rates and gaps, tags, vehicle, map frame, what was left out, remarks on a replay; JSON-ready.

        name: of the log.
        """
        present = {sensor: steps for sensor, steps in self._steps.items() if steps.count}
        first = min((steps.first_ns for steps in present.values() if steps.first_ns is not None), default=None)
        last = max((steps.last_ns for steps in present.values() if steps.last_ns is not None), default=None)
        start = None if first is None else datetime.fromtimestamp(first / NS_PER_S, UTC)
        return {
            "log": name,
            "start_utc": None if start is None else start.isoformat(timespec="milliseconds"),
            "duration_s": 0.0 if first is None or last is None else (last - first) / NS_PER_S,
            "sensors": {sensor: timing(steps, regular=sensor not in self._tags) for sensor, steps in present.items()},
            "gnss_status": {s.name.lower(): int(n) for s, n in zip(GnssStatus, self._status, strict=True) if n},
            "two_modes": self._two_modes,
            **{f"{kind}_s": {} if last is None else times.until(last) for kind, times in self._tags.items()},
            "vehicle": msgspec.to_builtins(self._first.vehicle),
            "map_frame": msgspec.to_builtins(self._first.map_frame),
            "left_out": [msgspec.to_builtins(row) for row in self._left_out],
            "remarks": list(self._remarks()),
        }

    def _remarks(self) -> Iterator[str]:
        """What a replay would do with this log, or why it cannot, and what is odd about its IMU."""
        missing = self._contents.missing()
        if missing is not None or self._imu is None:
            yield f"It cannot be replayed: {missing}."
            return
        for _, finding in self._imu.findings():
            yield f"WARNING: {finding}"
        counts = {sensor: steps.count for sensor, steps in self._steps.items()}
        if (counts["pose_fixes"] or counts["reference"]) and self._first.map_frame is None:
            yield "Map coordinates without a map frame: a replay needs [map_frame] in its config."
        if self._first.vehicle == Vehicle():
            yield "Nothing is known of the vehicle: lever arms of zero and the default IMU are taken."
        if counts["reference"]:
            heading = 2 * self._headings >= counts["reference"]
            yield "A replay is scored against its reference" + (
                "." if heading else ", in position only: it has no heading."
            )
        elif self._status[GnssStatus.FIXED]:
            yield "No reference: a replay is scored with --reference FILE, or with --hide-gnss against its fixed fixes."
        else:
            yield "No reference: a replay is scored only with --reference FILE."


@dataclass(slots=True)
class _TagTimes:
    """For how long each tag held, ns; since: when the text that holds now began."""

    ns: Counter[str] = field(default_factory=Counter)
    since: int | None = None
    text: str = ""

    def add(self, tags: Tags | None) -> None:
        if tags is not None:
            for t_ns, text in zip(tags.t_ns.tolist(), tags.text.tolist(), strict=True):
                self._hold(t_ns)
                self.since, self.text = t_ns, text

    def _hold(self, t_ns: int) -> None:
        if self.since is not None:
            for tag in {tag.strip() for tag in self.text.split(",")} - {""}:
                self.ns[tag] += t_ns - self.since

    def until(self, end_ns: int) -> dict[str, float]:
        """Tag -> seconds, where the last text holds until the end."""
        times = _TagTimes(Counter(self.ns), self.since, self.text)
        times._hold(end_ns)
        return {tag: ns / NS_PER_S for tag, ns in sorted(times.ns.items())}


def _imu_watch(piece: Log) -> ImuWatch:
    return ImuWatch(land_vehicle=piece.vehicle.land_vehicle)


def _headings(reference: Trajectory) -> int:
    """Rows with an attitude."""
    return int(np.isfinite(reference.q_map_body[:, 3]).sum())


def inventory(log: Log | Iterable[Log], name: str) -> dict[str, Any]:
    """The inventory of a log or of its pieces."""
    counted = Inventory()
    for piece in [log] if isinstance(log, Log) else log:
        counted.add(piece)
    return counted.found(name)


def file_inventory(path: Path, topics: Mapping[str, str]) -> dict[str, Any]:
    """The inventory of an MCAP file of any length, with its topics and the state of the file; it is read once.

    topics: sensor -> topic, as chosen.
    """
    from sensors.mcap.io import describe

    counted = Inventory()
    summary = describe(path, topics, visit=counted.add)
    found = counted.found(str(path))
    if summary.conflict:
        known = Log(vehicle=summary.vehicle, map_frame=summary.map_frame, left_out=summary.left_out)
        found = inventory(known, str(path)) | {"remarks": [f"Not to be replayed as it is: {summary.conflict}."]}
    found["topics"] = [_topic(topic) for topic in summary.topics]
    found["lidars"] = file_lidars(path, topics, found["topics"])
    found["cameras"] = file_cameras(path, topics, found["topics"])
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


def timing(steps: Steps, *, regular: bool) -> dict[str, Any]:
    """Count, median rate, span, and pauses too long to be bridged, of a sensor with rows; tags are not regular."""
    assert steps.first_ns is not None
    assert steps.last_ns is not None
    gap_ns = int(np.clip(GAP_PERIODS * (steps.median_ns() or 0.0), *GAP_NS))
    gaps = steps.above(gap_ns) if regular else 0
    return {
        "count": steps.count,
        "rate_hz": steps.rate_hz() if regular else None,
        "span_s": (steps.last_ns - steps.first_ns) / NS_PER_S,
        "gaps": gaps,
        "longest_gap_s": (steps.longest_ns or 0) / NS_PER_S if gaps else None,
    }


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
    if found["two_modes"]:
        console.print(f"Pose fixes: {found['two_modes']} tell two modes of their posterior")
    for lidar in found.get("lidars", ()):
        console.print(lidar_text(lidar))
    for camera in found.get("cameras", ()):
        console.print(camera_text(camera))
    if found.get("frames"):
        console.print(frames_text(found["frames"]))
    for kind, label in (("scene_s", "Scene"), ("mode_s", "Drive mode")):
        if found[kind]:
            console.print(f"{label}: {_tag_text(found[kind])}")
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


def _tag_text(times: Mapping[str, float]) -> str:
    return ", ".join(f"{tag} {seconds:.1f} s" for tag, seconds in times.items())


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
