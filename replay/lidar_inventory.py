"""What a log holds of LiDAR frames, counted on the way or looked up in a file."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sensors.records import Frame
from sensors.steps import Steps


class FrameCount:
    """Frames, counted on their way."""

    def __init__(self) -> None:
        self._steps = Steps()
        self._points: list[int] = []
        self._images: Counter[str] = Counter()

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames, counted."""
        for frame in frames:
            self._steps.add(np.array([frame.t_ns]))
            lidars = [len(sweep) for sweep in frame.sweeps]
            self._points += [0] * (len(lidars) - len(self._points))
            for number, count in enumerate(lidars):
                self._points[number] += count
            self._images.update(image.name for image in frame.images)
            yield frame

    def found(self) -> dict[str, Any] | None:
        """Frames, rate, mean points of each LiDAR, images of each camera. JSON-ready; None without frames."""
        count = self._steps.count
        if not count:
            return None
        return {
            "frames": count,
            "rate_hz": self._steps.rate_hz(),
            "points": [round(n / count) for n in self._points],
            "images": dict(self._images),
        }


def file_lidars(path: Path, topics: Mapping[str, str], found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The LiDAR topics of a log, JSON-ready, with counts and rates of its topics as ``file_inventory`` found them."""
    from sensors.mcap.lidar_summary import lidar_topics

    return with_timing(lidar_topics(path, topics.get("lidar")), found)


def with_timing(summaries: Iterable[Any], found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Summaries of topics (structs with a name), JSON-ready, each with what was found of its messages."""
    by_name = {topic["name"]: topic for topic in found}
    told = []
    for each in summaries:
        timing = {key: by_name[each.name][key] for key in ("count", "rate_hz")} if each.name in by_name else {}
        told.append(msgspec.to_builtins(each) | timing)
    return told


def frames_text(frames: Mapping[str, Any]) -> str:
    """What was written of frames."""
    rate = "" if frames["rate_hz"] is None else f" at {frames['rate_hz']:.1f} Hz"
    found = f"{frames['frames']} frames{rate}"
    told = []
    if frames["points"]:
        told.append(f"LiDAR: {found}, points in each: {' and '.join(str(n) for n in frames['points'])}.")
    if frames["images"]:
        cameras = ", ".join(f"{count} of {name}" for name, count in frames["images"].items())
        told.append(f"Cameras: {found}, images: {cameras}.")
    return " ".join(told) or f"{found}, all empty."


def lidar_text(lidar: Mapping[str, Any]) -> str:
    """A LiDAR topic of a file."""
    rate = "" if lidar.get("rate_hz") is None else f" at {lidar['rate_hz']:.1f} Hz"
    if lidar["points"] is None:
        return f"LiDAR {lidar['name']}: it cannot be read: {lidar['problem']}."
    place = "no /tf_static says where it sits, it is taken to be base_link"
    if lidar["place"] is not None:
        place = f"at ({', '.join(f'{value:g}' for value in lidar['place'])}) m in body axes"
    kind = ", compensated" if lidar["compensated"] else ""
    return (
        f"LiDAR {lidar['name']}: {lidar.get('count', 0)} sweeps{rate}, about {lidar['points']} points each{kind}; "
        f"{place}; fields {', '.join(lidar['fields'])}."
    )
