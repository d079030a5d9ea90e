"""Where a replay's logs come from: MCAP files, or drives of a scenario that are simulated where they are replayed."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import msgspec

from replay.config import RunConfig
from sensors.errors import EgolocError
from sensors.records import Log

if TYPE_CHECKING:
    from sensors.simulate.scenarios import Scenario

SCENARIO = "scenario:"
LONGEST_KM, LONGEST_S = 1e6, 7 * 86_400.0
"""Of a simulated drive: as far and as long as the simulator goes."""
LONGEST_NAME = 200
"""Characters: file systems allow 255 for a name with what is added to it."""
BESIDE = {"config.toml", "manifest.json", "metrics.json", "segments.parquet", "percentiles.parquet", "report.html"}
"""What stands beside the folders of a campaign's logs."""
ERROR = ".error.txt"
"""Ends the name of the file with the error of a log that failed."""
RECORDING = ".rrd"
"""Ends the names of recordings, which may stand anywhere."""


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


@dataclass(frozen=True, slots=True)
class McapSource:
    """A recorded log."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.stem

    @property
    def where(self) -> str:
        return str(self.path)

    @property
    def length_km(self) -> None:
        return None

    def pieces(self, config: RunConfig) -> Iterator[Log]:
        from sensors.mcap.io import read_pieces

        return read_pieces(self.path, config.topics)

    def facts(self) -> dict[str, Any]:
        from replay.store import file_hash

        digest = file_hash(self.path)
        return {"path": str(self.path), "bytes": self.path.stat().st_size, "sha256": digest}


class Drives(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What stands behind the name in ``scenario:NAME,drives=N,seed=S,...``; None: as the scenario says."""

    drives: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 1
    """How many, with seeds that follow each other."""
    seed: Annotated[int, msgspec.Meta(ge=0)] | None = None
    """Seed of the first."""
    length_km: Annotated[float, msgspec.Meta(gt=0, le=LONGEST_KM)] | None = None
    """Of each, km."""
    duration_s: Annotated[float, msgspec.Meta(ge=1, le=LONGEST_S)] | None = None
    """Of each, s."""
    network: Annotated[int, msgspec.Meta(ge=0)] | None = None
    """Seed of the roads that they share."""


EXPECTED = {
    "drives": "a number from 1 to 1,000,000",
    "seed": "a number from 0 on",
    "length_km": f"kilometres, more than 0 and at most {LONGEST_KM:,.0f}",
    "duration_s": f"seconds, from 1 to a week ({LONGEST_S:,.0f})",
    "network": "a number from 0 on",
}
"""Keys of Drives, and what messages say of their values."""


@dataclass(frozen=True, slots=True)
class ScenarioSource:
    """A drive of a scenario, simulated wherever its pieces are asked for."""

    scenario: "Scenario"
    """Complete, so that no file of it is needed there: its seed and length are those of this drive."""

    @property
    def name(self) -> str:
        return f"{self.scenario.name}-{self.scenario.seed:06d}"

    @property
    def where(self) -> str:
        return f"{SCENARIO}{self.scenario.name},seed={self.scenario.seed}"

    @property
    def length_km(self) -> float | None:
        return self.scenario.length_km if self.scenario.duration_s is None else None

    def pieces(self, config: RunConfig) -> Iterator[Log]:
        from sensors.simulate.drive import simulate_pieces

        return simulate_pieces(self.scenario.duration_s, self.scenario.seed, self.scenario)

    def facts(self) -> dict[str, Any]:
        from replay.config import to_toml

        scenario = self.scenario
        digest = hashlib.sha256(to_toml(scenario).encode()).hexdigest()
        return {"scenario": scenario.name, "seed": scenario.seed, "length_km": self.length_km, "sha256": digest}


def parse(text: str) -> list[LogSource]:
    """One LOG argument of the command line: a path, or ``scenario:NAME[,drives=N][,seed=S][,length_km=L]``."""
    if text.startswith(SCENARIO):
        return list(_drives(text))
    return [log_path(Path(text))]


def _drives(text: str) -> Iterator[ScenarioSource]:
    from sensors.simulate.scenarios import load

    name, *options = text.removeprefix(SCENARIO).split(",")
    asked = _options(text, options)
    if not name:
        raise EgolocError(f"{text}: expected the name or the TOML file of a scenario after {SCENARIO}")
    scenario = as_long_as(load(name), asked.length_km, asked.duration_s)
    if asked.network is not None:
        if scenario.network is None:
            raise EgolocError(f"{text}: network: expected a scenario with a network of roads, {name} has none")
        scenario = msgspec.structs.replace(scenario, network_seed=asked.network)
    seed = scenario.seed if asked.seed is None else asked.seed
    for drive in range(asked.drives):
        yield ScenarioSource(msgspec.structs.replace(scenario, seed=seed + drive))


def as_long_as(scenario: "Scenario", length_km: float | None, duration_s: float | None) -> "Scenario":
    """The scenario with another length, km or s; of both, what ends first; of none, its own."""
    if length_km is None and duration_s is None:
        return scenario
    return msgspec.structs.replace(scenario, length_km=length_km, duration_s=duration_s)


def _options(text: str, options: list[str]) -> Drives:
    """The KEY=VALUE parts of a scenario reference."""
    given: dict[str, str] = {}
    for option in options:
        key, equals, value = option.partition("=")
        if not equals or key not in EXPECTED:
            raise EgolocError(
                f"{text}: expected {', '.join(f'{key}=' for key in EXPECTED)} after the name, got {option!r}"
            )
        if key in given:
            raise EgolocError(f"{text}: {key}: expected one value, got {given[key]!r} and {value!r}")
        given[key] = value
    try:
        return msgspec.convert(given, Drives, strict=False)
    except msgspec.ValidationError as error:
        key = str(error).partition("$.")[2].strip("`")
        raise EgolocError(f"{text}: {key}: expected {EXPECTED[key]}, got {given[key]!r}") from None


def log_path(path: Path) -> LogSource:
    """An MCAP file."""
    if path.is_dir():
        raise EgolocError(f"{path}: expected an MCAP log, got a folder: name its logs, as in {path / '*.mcap'}")
    return McapSource(path)


def check_unique(sources: Sequence[LogSource]) -> dict[str, LogSource]:
    """Name -> source; raises EgolocError for two of the same name."""
    found: dict[str, LogSource] = {}
    for source in sources:
        if source.name in found:
            raise EgolocError(
                f"expected logs of different names, got {source.name!r} twice: "
                f"{found[source.name].where} and {source.where}"
            )
        if not _names_a_folder(source.name):
            raise EgolocError(f"{source.where}: {source.name!r} cannot be the name of a run folder: rename the log")
        found[source.name] = source
    return found


def _names_a_folder(name: str) -> bool:
    """Whether the run folder of a log may be called so, within that of a campaign."""
    return (
        0 < len(name) <= LONGEST_NAME
        and name not in BESIDE
        and name[0] != "."
        and not name.endswith((ERROR, RECORDING))
    )
