"""A GIS's own names for kinds of elements, from a TOML file."""

from pathlib import Path

import msgspec

from sensors.errors import EgolocError
from sensors.maps.vector_map import Kind


class _Rules(msgspec.Struct, forbid_unknown_fields=True):
    kinds: dict[str, str]


def read_rules(path: Path) -> dict[str, Kind]:
    """A kind for ``value`` of any property, or for ``property=value``: the table [kinds] of a file.

    Raises EgolocError where it cannot be read or names a kind that there is not.
    """
    try:
        given = msgspec.toml.decode(path.read_bytes(), type=_Rules).kinds
    except OSError as error:
        raise EgolocError(f"{path}: cannot be read: {error.strerror}") from error
    except msgspec.MsgspecError as error:
        raise EgolocError(f"{path}: expected a table [kinds] of names: {error}") from error
    unknown = [name for name in given.values() if name.upper() not in Kind.__members__]
    if unknown:
        known = ", ".join(kind.name.lower() for kind in Kind)
        raise EgolocError(f"{path}: kinds: expected one of {known}, got {unknown[0]!r}")
    return {key: Kind[name.upper()] for key, name in given.items()}
