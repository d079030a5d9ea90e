"""Weights of a network: a safetensors file, and beside it the config that they belong to, as TOML.

Where the config says None (no camera), the file says "none": TOML has no such value.
"""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from egovm.config import NetworkConfig
from sensors.errors import EgolocError


def save_weights(network: nn.Module, config: NetworkConfig, path: Path) -> None:
    """Write path (.safetensors) and the config beside it (.toml), each under its name only once it is complete."""
    _check_name(path)
    state = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    _replaced(path.with_suffix(".toml"), lambda to: to.write_text(config_toml(config)))
    _replaced(path, lambda to: save_file(state, to))


def _replaced(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under another name, then give it its own."""
    unfinished = path.with_name(f".{path.name}.unfinished")
    try:
        write(unfinished)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def read_config(path: Path) -> NetworkConfig:
    """The config that lies beside weights, or a config file itself (.toml)."""
    beside = path.with_suffix(".toml")
    if not beside.is_file():
        raise EgolocError(f"{beside}: expected the network's config, found no file")
    try:
        return msgspec.convert(_none(tomllib.loads(beside.read_text())), NetworkConfig)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, msgspec.ValidationError) as error:
        raise EgolocError(f"{beside}: {error}") from None


def load_weights(network: nn.Module, path: Path) -> None:
    """Put weights into a network of the same config. Raises EgolocError where names or shapes differ."""
    _check_name(path)
    if not path.is_file():
        raise EgolocError(f"{path}: expected weights of a network, found no file")
    try:
        given = load_file(path)
    except (SafetensorError, OSError) as error:
        raise EgolocError(f"{path}: expected a safetensors file: {error}") from None
    _check_state(path, given, network.state_dict())
    network.load_state_dict(given)


def config_toml(config: NetworkConfig) -> str:
    """All of a config as TOML."""
    return "\n".join(_table(msgspec.to_builtins(config), ()))


def _table(values: dict[str, Any], name: tuple[str, ...]) -> list[str]:
    """Lines of a table and of those in it; JSON's scalars and arrays are TOML's."""
    plain = {key: value for key, value in values.items() if not isinstance(value, dict)}
    lines = [f"[{'.'.join(name)}]"] if name else []
    lines += [f"{key} = {json.dumps('none' if value is None else value)}" for key, value in plain.items()]
    lines.append("")
    for key, value in values.items():
        if isinstance(value, dict):
            lines += _table(value, (*name, key))
    return lines


def _none(values: dict[str, Any]) -> dict[str, Any]:
    """The same with None for "none"."""
    return {
        key: _none(value) if isinstance(value, dict) else None if value == "none" else value
        for key, value in values.items()
    }


def _check_name(path: Path) -> None:
    if path.suffix != ".safetensors":
        raise EgolocError(f"{path}: expected a name that ends in .safetensors")


def _check_state(path: Path, given: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """Raise for the first weight that is missing, unknown or of another shape."""
    for name in sorted(given.keys() ^ wanted.keys()):
        raise EgolocError(f"{path}: {name}: " + ("not in this network" if name in given else "expected, found none"))
    for name, value in given.items():
        if value.shape != wanted[name].shape:
            shape = tuple(wanted[name].shape)
            raise EgolocError(f"{path}: {name}: expected shape {shape}, got {tuple(value.shape)}")
