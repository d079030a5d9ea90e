"""Logs with values and stamps that no record would hold (messages edited before they are written), and their replay."""

import json
import shutil
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from replay.cli import main
from sensors.mcap.assembly import METADATA, Facts
from sensors.mcap.encode import Messages, messages_of
from sensors.mcap.writer import ChunkWriter
from sensors.records import Log

Edit = Callable[[Messages], Messages]
SECOND = 10**9


def write(path: Path, log: Log, edits: dict[str, Edit]) -> Path:
    """The log, each topic through its edit (the edit "*" goes over every topic)."""
    chosen = [edits.get("*", same)(edits.get(m.topic, same)(m)) for m in messages_of(log)]
    text = msgspec.json.encode(Facts(log.vehicle, log.map_frame))
    with path.open("wb") as stream:
        writer = ChunkWriter(stream, "lz4")
        writer.metadata(METADATA, {"json": text.decode(), "crc32": f"{zlib.crc32(text):08x}"})
        writer.messages(chosen)
        writer.finish()
    return path


def same(messages: Messages) -> Messages:
    return messages


def silent(messages: Messages) -> Messages:
    """A topic without messages."""
    fields = {path: v[:0] if isinstance(v, np.ndarray) else v for path, v in messages.fields.items()}
    return replace(messages, fields=fields, t_ns=messages.t_ns[:0], log_time=messages.log_time[:0])


def value(field: str, number: float, first: int = 0, last: int | None = None) -> Edit:
    """A number in a field of messages [first, last)."""

    def edit(messages: Messages) -> Messages:
        column = np.array(np.broadcast_to(messages.fields.get(field, 0.0), messages.t_ns.shape), np.float64)
        column[first:last] = number
        return replace(messages, fields={**messages.fields, field: column})

    return edit


def both(*edits: Edit) -> Edit:
    """One edit after the other."""

    def edit(messages: Messages) -> Messages:
        for one in edits:
            messages = one(messages)
        return messages

    return edit


def stamps(new: Callable[[NDArray[np.int64]], NDArray[np.int64]]) -> Edit:
    """Header stamps by a function of the old ones; log times stay."""

    def edit(messages: Messages) -> Messages:
        sec, nanosec = np.divmod(new(messages.t_ns.copy()), SECOND)
        return replace(messages, fields={**messages.fields, "header.stamp.sec": sec, "header.stamp.nanosec": nanosec})

    return edit


def moved(shift_ns: int, first: int = 0, last: int | None = None) -> Edit:
    """Header stamps of messages [first, last) moved."""

    def new(t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        t_ns[first:last] += shift_ns
        return t_ns

    return stamps(new)


def logged(new: Callable[[NDArray[np.int64]], NDArray[np.int64]]) -> Edit:
    """Log times by a function of the old ones; stamps stay."""
    return lambda messages: replace(messages, log_time=new(messages.log_time.copy()))


def imu_like(log: Log, **columns: Any) -> Log:
    """The log with other columns in its IMU record."""
    assert log.imu is not None
    return replace(log, imu=replace(log.imu, **columns))


class Replayed:
    """What a replay printed and wrote: exit code, output, error, metrics (empty where there is no run)."""

    def __init__(self, path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> None:
        out = path.parent.parent / "run"
        self.code = main(["replay", str(path), "--out", str(out), *options])
        printed = capsys.readouterr()
        self.text, self.error = " ".join(printed.out.split()), printed.err
        self.metrics: dict[str, Any] = {}
        if self.code == 0:
            self.metrics = json.loads((out / "metrics.json").read_text())
            shutil.rmtree(out)
        assert [p.name for p in out.parent.iterdir()] == ["logs"], "something half-written"

    def refused(self) -> str:
        """The one line of a replay that could not be."""
        assert self.code == 2
        assert self.error.startswith("egoloc: error: ")
        assert self.error.count("\n") == 1
        return self.error

    def left_out(self) -> dict[tuple[str, str], int]:
        """(source, reason) -> rows, of a replay that went through with nothing on standard error."""
        assert (self.code, self.error) == (0, "")
        found = {(row["source"], row["reason"]): row["count"] for row in self.metrics["left_out"]}
        for (source, reason), count in found.items():
            assert f"Left out: {f'{count} of ' if count else ''}{source}: {reason}." in self.text
        return found

    def warnings(self) -> list[str]:
        """Kinds of warnings, each of which stands in the table."""
        for entry in self.metrics["warnings"]:
            assert f"WARNING: {entry['text']}" in self.text
        return [entry["kind"] for entry in self.metrics["warnings"]]
