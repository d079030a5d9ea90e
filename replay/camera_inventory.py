"""What a log holds of cameras, and what was written of images."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from replay.lidar_inventory import with_timing


def file_cameras(path: Path, topics: Mapping[str, str], found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The topics of images of a log, JSON-ready, with counts and rates of those that ``file_inventory`` found."""
    from sensors.mcap.camera_summary import camera_topics

    return with_timing(camera_topics(path, topics.get("camera")), found)


def camera_text(camera: Mapping[str, Any]) -> str:
    """A topic of images of a file."""
    rate = "" if camera.get("rate_hz") is None else f" at {camera['rate_hz']:.1f} Hz"
    if camera["problem"]:
        return f"Camera {camera['name']}: its images cannot be used: {camera['problem']}."
    place = ", ".join(f"{value:.3g}" for value in camera["place"])
    lens = "no distortion" if camera["lens"] == "none" else f"lens {camera['lens']}"
    return (
        f"Camera {camera['camera']} ({camera['name']}): {camera.get('count', 0)} images{rate}, "
        f"{camera['width']} x {camera['height']} {camera['format']}, {lens}; at ({place}) m in body axes."
    )
