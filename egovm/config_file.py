"""Configs as TOML files, complete and read back strictly.

Where a config says None (no camera), the file says "none": TOML has no such value.
"""

import json
import tomllib
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from sensors.errors import EgolocError

T = TypeVar("T")


def read_toml(path: Path, kind: type[T], what: str) -> T:
    """A config of a kind. what: what the file is, for the message where there is none."""
    if not path.is_file():
        raise EgolocError(f"{path}: expected {what}, found no file")
    try:
        return msgspec.convert(_none(tomllib.loads(path.read_text())), kind)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, msgspec.ValidationError) as error:
        raise EgolocError(f"{path}: {error}") from None


def config_toml(config: msgspec.Struct) -> str:
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
