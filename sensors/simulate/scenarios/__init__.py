"""Scenario files: a named drive in TOML, shipped with the package or the user's own."""

from importlib.resources import files
from pathlib import Path
from typing import Annotated

import msgspec

from sensors.bounds import Positive
from sensors.errors import EgolocError
from sensors.simulate.drive import DriveConfig


class Scenario(DriveConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A drive with a name; ``simulate(scenario.duration_s, scenario.seed, scenario)`` makes its log."""

    name: str
    """How it is called on the command line."""
    doc: str
    """One line: what it is for."""
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Seed of everything random in it."""
    duration_s: Positive | None = None
    """Longest drive, s; with neither this nor length_km: ten minutes."""


def names() -> list[str]:
    """Scenarios that come with the package."""
    return sorted(f.name.removesuffix(".toml") for f in files(__name__).iterdir() if f.name.endswith(".toml"))


def load(name_or_path: str | Path) -> Scenario:
    """An embedded scenario by name, or one from a TOML file."""
    if isinstance(name_or_path, str) and name_or_path in names():
        return _decode(name_or_path, files(__name__).joinpath(f"{name_or_path}.toml").read_bytes())
    path = Path(name_or_path)
    if path.suffix != ".toml":
        raise EgolocError(f"{name_or_path}: expected a .toml file or one of the scenarios {', '.join(names())}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise EgolocError(f"{path}: cannot read the scenario: {error.strerror}") from error
    return _beside(path, _decode(str(path), content))


def _beside(path: Path, scenario: Scenario) -> Scenario:
    """A relative path of a trajectory is meant from the scenario's folder."""
    if scenario.trajectory is None:
        return scenario
    file = str(path.parent / scenario.trajectory.file)
    return msgspec.structs.replace(scenario, trajectory=msgspec.structs.replace(scenario.trajectory, file=file))


def _decode(source: str, content: bytes) -> Scenario:
    try:
        return msgspec.toml.decode(content, type=Scenario)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise EgolocError(f"{source}: {error}") from error
