"""Where a replay's logs come from: MCAP files, or drives of a scenario that are simulated where they are replayed."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

from replay.config import RunConfig
from sensors.records import Log


class LogSource(Protocol):
    """One drive to replay. Sources are small and pickle: workers open them."""

    @property
    def name(self) -> str:
        """Name of its run folder within a campaign."""

    @property
    def where(self) -> str:
        """How messages about it begin: the path of a log, or the scenario and seed."""

    @property
    def length_km(self) -> float | None:
        """How far it goes, where that is known beforehand."""

    def pieces(self, config: RunConfig) -> Iterator[Log]:
        """The drive, piece by piece (sensors/pieces.py). Raises EgolocError where it cannot be read."""

    def facts(self) -> dict[str, Any]:
        """What the manifest says of it: path, bytes and sha256 of a file; scenario, seed, length of a drive."""


def check_unique(sources: list[LogSource]) -> dict[str, LogSource]:
    """Name -> source; raises EgolocError for two of the same name."""
    raise NotImplementedError


def parse(text: str) -> list[LogSource]:
    """One LOG argument of the command line: a path, or ``scenario:NAME[,drives=N][,seed=S][,length_km=L]``."""
    raise NotImplementedError


def log_path(path: Path) -> LogSource:
    """An MCAP file."""
    raise NotImplementedError
