"""What commands print: tables for people, JSON for programs, a spinner while they work."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any


def print_json(content: Mapping[str, Any]) -> None:
    """One JSON object on standard output."""
    print(json.dumps(content, indent=1, allow_nan=False))


@contextmanager
def stage(text: str) -> Iterator[None]:
    """A spinner on standard error while the block runs; nothing where that is no terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(text):
        yield
