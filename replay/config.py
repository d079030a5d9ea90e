"""The whole configuration of a replay: read from TOML, written complete into the run folder."""

import tomllib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from fusion.config import FusionConfig
from sensors.bounds import Positive
from sensors.errors import EgolocError
from sensors.geodesy import MapFrame
from sensors.vehicle import Vehicle

S = TypeVar("S", bound=msgspec.Struct)


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Largest errors with which the vehicle still counts as localized."""

    lon_m: Positive = 0.6
    """Along the reference heading, m."""
    lat_m: Positive = 0.3
    """Left of the reference heading, m."""
    yaw_deg: Positive = 1.0
    """Yaw, deg."""


ESTIMATED = {
    "lever-arm": ("lever_arm",),
    "mounting": ("mounting",),
    "gyro": ("gyro",),
    "delays": ("gnss_delay", "pose_delay"),
    "gnss-delay": ("gnss_delay",),
    "pose-delay": ("pose_delay",),
}
"""What --estimate takes, and the switches of [fusion.estimate] that it stands for."""
SHORTEST_STRETCH_S = 0.1
"""Of hidden GNSS."""
LIMITS = {
    "paper": Limits(),
    "highway": Limits(1.40, 0.57, 1.5),
    "local-street": Limits(0.29, 0.29, 0.5),
}
"""Named profiles: the EgoVM paper's; highway and local street of Reid et al. 2019 (arXiv:1906.01061)."""


class HideGnss(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """GNSS hidden on purpose, so that the hidden fixes can serve as the reference."""

    every_s: Positive
    """A stretch starts every so often, s."""
    length_s: Positive
    """Length of a stretch, s."""


class RunConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that decides the outcome of a replay, apart from the log."""

    topics: dict[str, str] = {}
    """Sensor -> topic, where a log offers several (imu, gnss, gnss_velocity, pose_fixes, wheel, reference)."""
    vehicle: Vehicle | None = None
    """Instead of the log's own; in TOML a table or the path of a vehicle TOML."""
    map_frame: MapFrame | None = None
    """Instead of the log's own."""
    fusion: FusionConfig = FusionConfig()
    limits: Limits = Limits()
    """In TOML a table or a profile: paper, highway, local-street."""
    hide_gnss: HideGnss | None = None
    smooth: bool = False
    """Smooth the drive as well, backwards from its end: smoothed.parquet."""
    inject: tuple[str, ...] = ()
    """Faults put into every log: NAME[:SEVERITY][@BEGIN[+LENGTH]], s since the first IMU sample (docs/faults.md)."""
    seed: int = 0
    """For what is random in injected faults (nothing in a plain replay)."""


def load_config(path: Path) -> RunConfig:
    """The config in a TOML file; missing keys take their defaults, an unknown key is an error with its path."""
    raw = _read_toml(path)
    if isinstance(raw.get("vehicle"), str):
        raw["vehicle"] = msgspec.to_builtins(load_vehicle(path.parent / raw["vehicle"]))
    if isinstance(raw.get("limits"), str):
        raw["limits"] = msgspec.to_builtins(named_limits(raw["limits"], f"{path}: limits"))
    return _convert(raw, RunConfig, path)


def load_vehicle(path: Path) -> Vehicle:
    """A vehicle TOML: extrinsics and IMU datasheet."""
    return _convert(_read_toml(path), Vehicle, path)


def named_limits(name: str, where: str = "--limits") -> Limits:
    """One of the profiles."""
    if name not in LIMITS:
        raise EgolocError(f"{where}: expected one of {', '.join(LIMITS)}, got {name!r}")
    return LIMITS[name]


def parse_hide_gnss(text: str) -> HideGnss:
    """``EVERY:LENGTH`` in seconds, as on the command line."""
    try:
        every, length = (float(part) for part in text.split(":"))
    except ValueError:
        raise EgolocError(f"--hide-gnss: expected EVERY:LENGTH in seconds, as in 60:15, got {text!r}") from None
    return check_hide_gnss(HideGnss(every, length), "--hide-gnss")


def check_hide_gnss(hide: HideGnss, where: str) -> HideGnss:
    """Stretches must be long enough to hold a fix and leave GNSS between them."""
    if not 0 < hide.length_s < hide.every_s < float("inf"):
        raise EgolocError(f"{where}: expected 0 < LENGTH < EVERY, got {hide.every_s:g}:{hide.length_s:g}")
    if hide.length_s < SHORTEST_STRETCH_S:
        raise EgolocError(f"{where}: expected a LENGTH of at least {SHORTEST_STRETCH_S:g} s, got {hide.length_s:g}")
    return hide


def with_faults(config: RunConfig, specs: Sequence[str], where: str = "--inject") -> RunConfig:
    """The config with these faults, everything about them said. Raises EgolocError where they cannot be put in."""
    from sensors.simulate.faults.spec import parse

    injections = parse(specs, where)
    for one in injections:
        if config.hide_gnss is not None and any(record.startswith("gnss") for record in one.fault.acts):
            raise EgolocError(
                f"{where}: {one.fault.name}: expected no fault of GNSS with --hide-gnss: it is the reference"
            )
    return msgspec.structs.replace(config, inject=tuple(one.spec for one in injections))


def with_estimates(config: RunConfig, names: str) -> RunConfig:
    """The config with these of ESTIMATED, separated by commas, estimated along; others stay as they are."""
    chosen: dict[str, bool] = {}
    for name in names.split(","):
        if name not in ESTIMATED:
            raise EgolocError(f"--estimate: expected any of {', '.join(ESTIMATED)}, got {name!r}")
        chosen |= dict.fromkeys(ESTIMATED[name], True)
    estimate = msgspec.structs.replace(config.fusion.estimate, **chosen)
    return msgspec.structs.replace(config, fusion=msgspec.structs.replace(config.fusion, estimate=estimate))


def to_toml(config: msgspec.Struct) -> str:
    """A struct with every key written out; what is None is left away, as TOML has no null."""
    return "\n".join(_tables(msgspec.to_builtins(config), ())).lstrip("\n") + "\n"


def _tables(table: dict[str, Any], path: tuple[str, ...]) -> list[str]:
    present = {key: value for key, value in table.items() if value is not None}
    lines = [f"\n[{'.'.join(path)}]"] if path else []
    lines += [f"{_key(key)} = {_value(value)}" for key, value in present.items() if not isinstance(value, dict)]
    for key, value in present.items():
        if isinstance(value, dict):
            lines += _tables(value, (*path, _key(key)))
    return lines


def _key(key: str) -> str:
    bare = key.isascii() and key.replace("_", "a").replace("-", "a").isalnum()
    return key if bare else _value(key)


def _value(value: Any) -> str:
    if isinstance(value, str):  # a JSON string is a TOML basic string, but for DEL
        return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return repr(value)


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except ValueError as error:  # no TOML, no text, or no path
        raise EgolocError(f"{path}: expected TOML: {error}") from None


def _convert(raw: dict[str, Any], kind: type[S], path: Path) -> S:
    try:
        result = msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        raise EgolocError(f"{path}: {_explain(str(error), kind, raw)}") from None
    if isinstance(result, RunConfig):
        _check_run(result, path)
        return with_faults(result, result.inject, f"{path}: inject")  # type: ignore[return-value]
    return result


def _check_run(config: RunConfig, path: Path) -> None:
    """What no single key's type can say."""
    from sensors.mcap.topics import check_choice

    if config.hide_gnss is not None:
        check_hide_gnss(config.hide_gnss, f"{path}: hide_gnss")
    try:
        check_choice(config.topics)
    except EgolocError as error:
        raise EgolocError(f"{path}: {error}") from None


def _explain(message: str, kind: type[msgspec.Struct], raw: Mapping[str, Any]) -> str:
    """msgspec's ``Object contains unknown field `x` - at `$.a.b` `` as ``a.b: unknown key "x"; expected ...``."""
    what, _, where = message.partition(" - at ")
    place = where.strip("`").removeprefix("$").removeprefix(".")
    prefix = f"{place}: " if place else ""
    if what.startswith("Invalid enum value"):
        return f"{prefix}expected one of {', '.join(_choices(kind, place.split('.')))}, got {what.split(' ', 3)[3]}"
    if "unknown field" not in what:
        return prefix + what[0].lower() + what[1:] + ("" if "got" in what else _given(raw, place))
    key = what.split("`")[1]
    known = _keys(kind, place.split(".") if place else [])
    near = get_close_matches(key, known, 1)
    return f'{prefix}unknown key "{key}"; ' + (f'did you mean "{near[0]}"?' if near else f"expected {', '.join(known)}")


def _given(raw: Any, place: str) -> str:
    """``, got VALUE`` of the number at a place; nothing where there is none."""
    for step in place.replace("[", ".").replace("]", "").split("."):
        try:
            raw = raw[int(step)] if isinstance(raw, list) else raw[step]
        except (KeyError, IndexError, TypeError, ValueError):
            return ""
    return f", got {raw}" if isinstance(raw, int | float) and not isinstance(raw, bool) else ""


def _keys(kind: type[msgspec.Struct], place: list[str]) -> list[str]:
    """Field names of the struct at a place."""
    return [field.encode_name for field in msgspec.structs.fields(_struct(kind, place))]


def _choices(kind: type[msgspec.Struct], place: list[str]) -> list[str]:
    """Values that the Literal at a place allows."""
    return [str(choice) for choice in _options(_struct(kind, place[:-1]), place[-1])]


def _struct(kind: type[msgspec.Struct], place: list[str]) -> type[msgspec.Struct]:
    for name in place:
        kind = next(t for t in _options(kind, name) if isinstance(t, type) and issubclass(t, msgspec.Struct))
    return kind


def _options(kind: type[msgspec.Struct], name: str) -> tuple[Any, ...]:
    """Members of a field's union or Literal, or its one type."""
    annotation = next(field.type for field in msgspec.structs.fields(kind) if field.name == name)
    options: tuple[Any, ...] = getattr(annotation, "__args__", (annotation,))
    return options
