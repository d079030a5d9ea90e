"""Logs to and from MCAP files with ROS 2 messages: read_log, write_log, describe."""

import os
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import msgspec

from sensors.errors import EgolocError
from sensors.mcap.assembly import METADATA, Facts, assemble
from sensors.mcap.encode import messages_of
from sensors.mcap.gather import Gatherer
from sensors.mcap.sections import open_container
from sensors.mcap.summary import LogSummary, TopicSummary, describe
from sensors.mcap.topics import assign, check_choice, check_conflicts, wanted_by
from sensors.mcap.writer import ChunkWriter, Compression
from sensors.records import Log

__all__ = ["LogSummary", "TopicSummary", "describe", "read_log", "write_log"]


def read_log(path: str | os.PathLike[str], topics: Mapping[str, str] | None = None) -> Log:
    """The records of a log.

    topics: sensor (imu, gnss, gnss_velocity, pose_fixes, wheel, reference) -> topic; the others are chosen by schema.
    EgolocError where the file is no MCAP log, two topics could feed one sensor, or a named topic cannot feed its own.
    What cannot be used (damaged chunks, a truncated end, bad rows) is left out and counted in Log.left_out.
    """
    chosen = dict(topics or {})
    check_choice(chosen)
    source = open_container(path)
    gatherer = Gatherer(wanted_by(chosen))
    gatherer.read(source)
    roles = assign(gatherer.topics, chosen, gatherer.definitions, source.path)
    check_conflicts(roles, source.path)
    return assemble(source, gatherer, roles)


def write_log(path: str | os.PathLike[str], log: Log, compression: Compression = "zstd") -> None:
    """Write a log as MCAP, whole or not at all; arrival_ns becomes the log time, t_ns the header stamp."""
    if compression not in {"zstd", "lz4", "none"}:
        raise EgolocError(f"compression: expected zstd, lz4 or none, got {compression!r}")
    target = Path(path)
    messages = messages_of(log)
    text = msgspec.json.encode(Facts(log.vehicle, log.map_frame))
    partial = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as stream:
            writer = ChunkWriter(stream, compression)
            writer.metadata(METADATA, {"json": text.decode(), "crc32": f"{zlib.crc32(text):08x}"})
            writer.messages(messages)
            writer.finish()
        partial.replace(target)
    except OSError as error:
        raise EgolocError(f"{target}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):  # where nothing could be written there is nothing to clear away
            partial.unlink(missing_ok=True)
