"""What commands print: tables for people, JSON for programs, a spinner while they work."""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sensors.errors import EgolocError

if TYPE_CHECKING:
    from replay.campaign import Campaign

SHOWN = 10
"""Logs that failed whose errors are printed; all are in metrics.json."""


def print_json(content: Mapping[str, Any]) -> None:
    """One JSON object on standard output."""
    print(json.dumps(content, indent=1, allow_nan=False))


def show(metrics: Mapping[str, Any], folder: Path, heading: str | None = None) -> None:
    """The table of a run, and where the run is."""
    from replay.table import print_run

    if heading:
        print(heading)
    print_run(metrics)
    print(f"Run: {folder}")
    sys.stdout.flush()


def show_campaign(campaign: "Campaign", folder: Path, *, as_json: bool, paper: bool = False) -> int:
    """The table of a campaign, then the logs that failed; returns the exit code: 1 if any did.

    paper: the EgoVM paper's figures beside its own come last.
    """
    if as_json:
        print_json(campaign.metrics or {"logs": campaign.logs})
    elif campaign.metrics is not None:
        show(campaign.metrics, folder)
        if paper:
            from replay.paper import paper_table
            from replay.table import output_console

            console = output_console()
            console.print("", paper_table(campaign.metrics, console.width), sep="\n")
    sys.stdout.flush()
    failed = campaign.logs["failed"]
    for entry in failed[:SHOWN]:
        print(f"FAILED: {entry['error']}", file=sys.stderr)
    if failed:
        more = f", {len(failed) - SHOWN} more than shown" if len(failed) > SHOWN else ""
        where = folder / "LOG.error.txt"
        print(f"{len(failed)} of {campaign.logs['total']} logs failed{more}: see {where}", file=sys.stderr)
    return 1 if failed else 0


def check_drawings(drawings: Sequence[Path | None], others: Sequence[Path | None]) -> None:
    """Raise where a picture or recording cannot be written, or would take the place of another file of the command."""
    taken = [path.resolve() for path in others if path is not None]
    for path in drawings:
        if path is None:
            continue
        if path.resolve() in taken:
            raise EgolocError(f"{path}: expected a file of its own to draw into, got another of this command")
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise EgolocError(f"{path}: cannot be written: expected a file in a folder that exists")
        taken.append(path.resolve())


@contextmanager
def stage(text: str) -> Iterator[Callable[[str], None]]:
    """A spinner on standard error while the block runs; nothing where that is no terminal.

    Yields a function that adds to the text.
    """
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    with console.status(text) as status:
        yield lambda more: status.update(f"{text}: {more}")
