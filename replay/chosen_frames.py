"""Frames of a log that somebody wants to see, each with the vehicle's motion around it."""

from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from sensors.clock import NS_PER_S
from sensors.errors import EgolocError
from sensors.frames import Frame
from sensors.mcap.frames import read_frames
from sensors.mcap.io import read_pieces
from sensors.mcap.topics import CAMERA, FRAMES, LIDAR
from sensors.motion import Motion, Standing, along, span_of
from sensors.pieces import joined
from sensors.records import Trajectory
from sensors.vehicle import Vector3

AROUND_NS = 2 * NS_PER_S
"""The reference is looked at for so long before and after the frames."""


class ChosenFrame(NamedTuple):
    """A frame; at_s: s since the log's first; motion: around it, Standing where the log has no reference for it."""

    frame: Frame
    at_s: float
    motion: Motion


def chosen_frames(path: Path, topics: Mapping[str, str], at_s: float, count: int) -> list[ChosenFrame]:
    """The first frames with an image from at_s after the log's first frame on.

    topics: sensor -> topic, as in a config. EgolocError where there are none, or at_s lies behind the last.
    """
    lidar, camera = topics.get(LIDAR), topics.get(CAMERA)
    first = next(read_frames(path, lidar, cameras=camera), None)
    if first is None:
        raise EgolocError(f"{path}: expected a log with frames, got none")
    begin_ns = first.t_ns + round(at_s * NS_PER_S)
    rest = read_frames(path, lidar, begin_ns, cameras=camera)
    frames = list(islice((frame for frame in rest if frame.images), count))
    if not frames:
        raise EgolocError(f"{path}: expected a frame with images from {at_s:g} s on, got none")
    motion = _motion(path, topics, frames)
    return [
        ChosenFrame(
            frame, (frame.t_ns - first.t_ns) / NS_PER_S, motion if motion.covers(*span_of(frame)) else Standing()
        )
        for frame in frames
    ]


def _motion(path: Path, topics: Mapping[str, str], frames: list[Frame]) -> Motion:
    """The motion along the log's reference near some frames."""
    begin_ns, end_ns = frames[0].t_ns - AROUND_NS, frames[-1].t_ns + AROUND_NS
    near: list[Trajectory] = []
    arm: Vector3 = (0.0, 0.0, 0.0)
    for reference, arm in _references(path, topics):  # noqa: B007 (the last one serves for all)
        rows = reference[(reference.t_ns >= begin_ns) & (reference.t_ns <= end_ns)]
        near += [rows] if len(rows) else []
        if len(reference) and reference.t_ns[-1] > end_ns:
            break
    try:
        return along(joined(near), arm) if near else Standing()
    except EgolocError:  # too few of them have an attitude
        return Standing()


def _references(path: Path, topics: Mapping[str, str]) -> Iterator[tuple[Trajectory, Vector3]]:
    columns = {sensor: topic for sensor, topic in topics.items() if sensor not in FRAMES}
    for piece in read_pieces(path, columns):
        if piece.reference is not None:
            yield piece.reference, piece.vehicle.reference_lever_arm
