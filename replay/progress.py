"""How far a campaign has come: a bar over kilometres on a terminal, and one line at the end anywhere."""

import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

from replay.batch import End, Outcome
from replay.sources import LogSource

if TYPE_CHECKING:
    import rich.progress

BAR_WIDTH = 20
"""Columns; the kilometres stand beside it, on terminals of 80."""


class Progress:
    """Counts what has been replayed since it was entered; shows it where standard error is a terminal."""

    def __init__(self, sources: Sequence[LogSource]) -> None:
        """sources: the logs that are to be replayed."""
        lengths = [source.length_km for source in sources]
        known = [length for length in lengths if length is not None]
        self._total_km = sum(known) if len(known) == len(lengths) else None
        self._logs, self._km, self._done, self._failed = len(sources), 0.0, 0, 0
        self._start = time.monotonic()
        self._bar, self._task = _bar()

    def __enter__(self) -> Self:
        self._start = time.monotonic()
        self._bar.start()
        self.running(0.0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
        print(self.line(), file=sys.stderr)

    def running(self, km: float) -> None:
        """Show it. km: how far the logs in work have come."""
        so_far = self._km + km
        of = "" if self._total_km is None else f" of {self._total_km:,.0f}"
        failed = f", [red]{self._failed} failed[/]" if self._failed else ""
        speed = so_far / max(time.monotonic() - self._start, 1e-9)
        ended = self._done + self._failed
        text = f"{so_far:,.1f}{of} km, {ended} of {self._logs} logs, {speed:.2f} km/s{failed}"
        by_km = self._total_km is not None
        total, completed = (self._total_km, so_far) if by_km else (float(self._logs), float(ended))
        self._bar.update(self._task, total=total, completed=completed, text=text)

    def ended(self, outcome: Outcome) -> None:
        """Count a log."""
        self._km += outcome.km
        self._done += outcome.end is End.DONE
        self._failed += outcome.end is End.FAILED

    def line(self) -> str:
        """What has been done."""
        seconds = time.monotonic() - self._start
        failed = f", {self._failed} failed" if self._failed else ""
        speed = f" ({self._km / seconds:.2f} km/s)" if seconds > 0 else ""
        return f"Replayed {self._done} of {self._logs} logs{failed}: {self._km:,.1f} km in {seconds:,.1f} s{speed}"


def _bar() -> tuple["rich.progress.Progress", "rich.progress.TaskID"]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    columns = (BarColumn(BAR_WIDTH), TextColumn("{task.fields[text]}"), TimeRemainingColumn())
    bar = Bar(*columns, console=console, transient=True, disable=not console.is_terminal)
    return bar, bar.add_task("", total=None, text="")
