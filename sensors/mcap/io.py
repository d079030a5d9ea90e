"""Logs to and from MCAP files with ROS 2 messages: read_pieces, read_log, write_log, describe."""

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from sensors.errors import EgolocError
from sensors.mcap.assembly import METADATA, Facts, sealed
from sensors.mcap.encode import messages_of
from sensors.mcap.frame_writer import FrameWriter
from sensors.mcap.reader import LogReader
from sensors.mcap.summary import LogSummary, TopicSummary, describe
from sensors.mcap.writer import ChunkWriter, Compression
from sensors.pieces import PIECE_S, join
from sensors.records import Frame, Log
from sensors.whole_file import whole_file

__all__ = ["LogSummary", "TopicSummary", "describe", "read_log", "read_pieces", "write_log"]

WHOLE_S = 1e9
"""No drive is as long, s."""


def read_log(path: str | os.PathLike[str], topics: Mapping[str, str] | None = None) -> Log:
    """The records of a log, whole: its one piece is as long as it takes, so that all of it is judged at once."""
    return join(read_pieces(path, topics, WHOLE_S))


def read_pieces(
    path: str | os.PathLike[str], topics: Mapping[str, str] | None = None, length_s: float = PIECE_S
) -> Iterator[Log]:
    """A log of any length as Logs over windows of stamps, in bounded memory; windows without rows are passed over.

    topics: sensor (imu, gnss, gnss_velocity, pose_fixes, wheel, reference, scene, mode) -> topic; the others are chosen
    by schema, tags by the names /scene and /drive_mode. length_s: length of a window, s.
    EgolocError where the file is no MCAP log, two topics could feed one sensor, or a named topic cannot feed its own:
    before the first piece where the summary tells, else as soon as it is known. What cannot be used (damaged chunks, a
    truncated end, bad rows) is left out and counted in Log.left_out of the piece that follows; what concerns the whole
    file (topics that feed nothing, a missing end) in the last one.

    The log's map frame and vehicle are those of the metadata record that the summary names or that stands before the
    first piece. In a log of more than one window:
    - A row is given out with its window if it comes at most 10 s of stamps later than the IMU's rows of that time (in
      chunks whose log times overlap: as far as the summary tells their order), else it is left out and counted.
    - A clock that is set in between is not judged by the whole log: stamps that jump away from their arrival by more
      than 10 s and do not come back for as long are followed, as soon as they go on increasing; where all sensors pause
      for an hour or more, or jump ahead that far, what follows is left out, not the smaller part.
    - Speeds of a GPSFix count as filled in from the first window on in which one is not zero.
    """
    return LogReader(path, topics, length_s).pieces()


def write_log(
    path: str | os.PathLike[str],
    log: Log | Iterable[Log],
    compression: Compression = "zstd",
    frames: Iterable[Frame] = (),
) -> None:
    """Write a log, or its pieces as they come, as MCAP, whole or not at all.

    arrival_ns becomes the log time, t_ns the header stamp. Messages are in order of log time as long as none arrives
    before the first of the piece before its own; then the file does not depend on how the log is cut.

    frames: in order of time; one is held at a time. Each sweep is a chunk of its own that stands before the first chunk
    of other messages that starts after its arrival (``sensors.mcap.frame_writer`` says which topics hold it).
    """
    if compression not in {"zstd", "lz4", "none"}:
        raise EgolocError(f"compression: expected zstd, lz4 or none, got {compression!r}")
    target = Path(path)
    pieces = iter([log] if isinstance(log, Log) else log)
    first = next(pieces, Log())
    with whole_file(target) as partial:
        target.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as stream:
            _write(ChunkWriter(stream, compression), first, pieces, target, frames)


def _write(writer: ChunkWriter, first: Log, rest: Iterator[Log], target: Path, frames: Iterable[Frame]) -> None:
    writer.metadata(METADATA, sealed(Facts(first.vehicle, first.map_frame)))
    waiting_frames = FrameWriter(writer, frames)
    writer.before_chunk = waiting_frames.write_until
    waiting = messages_of(first)
    for piece in rest:
        if (piece.vehicle, piece.map_frame) != (first.vehicle, first.map_frame):
            raise EgolocError(f"{target}: expected the same vehicle and map frame in all pieces of a log")
        following = messages_of(piece)
        if following:
            writer.messages(waiting, before=min(int(topic.log_time.min()) for topic in following))
            waiting = following
    writer.messages(waiting)
    waiting_frames.write_until(None)
    writer.finish()
